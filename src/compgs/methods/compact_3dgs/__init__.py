"""Compact 3D Gaussian Representation (Lee et al., CVPR 2024): masks, color from a hash grid, residual codebooks.

    masks ──────────────────► which splats there are
    position, direction ──hash grid, network──► color     scale, rotation ──6 stages of 64 codes──► indices

What is as published, what is not and why: docs/methods/compact-3dgs.md.
"""

from typing import TYPE_CHECKING

from compgs.methods.compact_3dgs.settings import SCALED, CompactConfig
from compgs.methods.method import PACKED_SUFFIX, SPLAT_SETTINGS, Method, write_itself

if TYPE_CHECKING:
    from compgs.model.splats import SplatModel
    from compgs.published.parts.content import Content
    from compgs.scene.views import Scene
    from compgs.training.run.run import Run


def train(scene: "Scene", config: CompactConfig, run: "Run", start: "SplatModel | None" = None) -> "Content":
    """Raises as `compgs.train` does."""
    from compgs.methods.compact_3dgs.hooks import train_compact

    return train_compact(scene, config, run)


COMPACT_3DGS = Method(
    name="compact-3dgs",
    description="3DGS with learned masks, color from a hash grid, residual codebooks of scales and rotations",
    reference="Lee et al., Compact 3D Gaussian Representation for Radiance Field, CVPR 2024",
    suffix=PACKED_SUFFIX,
    uses=(*SPLAT_SETTINGS, "compact"),
    train=train,
    write=write_itself,
    settings=CompactConfig,
    presets={"scaled": {"compact": SCALED}},
)
