"""Which methods there are. Whoever adds one adds it here."""

from compgs.methods import hybrid, splats
from compgs.methods.c3dgs import C3DGS
from compgs.methods.compact3d import COMPACT3D
from compgs.methods.compact_3dgs import COMPACT_3DGS
from compgs.methods.cosa import COSA
from compgs.methods.eagles import EAGLES
from compgs.methods.lightgaussian import LIGHTGAUSSIAN
from compgs.methods.method import Method
from compgs.methods.pruned import PRUNED_SOG, PRUNED_SPZ
from compgs.methods.scaffold_gs import SCAFFOLD_GS

METHODS: dict[str, Method] = {
    method.name: method
    for method in (
        hybrid.COMPGS,
        splats.PLAIN,
        splats.SPZ,
        splats.SOG,
        PRUNED_SPZ,
        PRUNED_SOG,
        COMPACT3D,
        C3DGS,
        LIGHTGAUSSIAN,
        EAGLES,
        COMPACT_3DGS,
        SCAFFOLD_GS,
        COSA,
    )
}
