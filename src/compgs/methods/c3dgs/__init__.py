"""c3dgs (Niedermayr et al., CVPR 2024): colors and shapes that matter keep entries of their own, the others share those
of two codebooks; all is then trained as 8 bits will show it.

    plain 3DGS ──► sensitivity ──► weighted codebooks ──► fine-tuning, rounded ──► Morton order, DEFLATE
    the run                                               1/6 more steps

`docs/methods/c3dgs.md` says what is as published, and the law of bytes.
"""

from typing import TYPE_CHECKING

from compgs.methods.c3dgs.settings import NAME, C3DGSConfig
from compgs.methods.method import PACKED_SUFFIX, SPLAT_SETTINGS, Method, write_itself

if TYPE_CHECKING:
    from compgs.model.splats import SplatModel
    from compgs.published.parts.content import Content
    from compgs.scene.views import Scene
    from compgs.training.run.run import Run


def train(scene: "Scene", config: C3DGSConfig, run: "Run", start: "SplatModel | None" = None) -> "Content":
    """The content of the file. Raises as `compgs.train` does."""
    from compgs.methods.c3dgs.hooks import SharedEntries
    from compgs.published.c3dgs import opened
    from compgs.published.parts.content import Content
    from compgs.training.splats.phases import Phase, fine_tuning, train_phases

    steps = max(1, round(config.c3dgs.tuned * config.training.steps))
    tuned = Phase(fine_tuning(config, steps), lambda: SharedEntries(config))
    trainer = train_phases(scene, (Phase(config), tuned), run, start)
    assert isinstance(trainer.hooks, SharedEntries)
    return Content(trainer.hooks.content(trainer), scene.background, opened, ("raw", "deflate"), run.device)


C3DGS = Method(
    name=NAME,
    description="plain 3DGS, codebooks by sensitivity, trained for 8 bits",
    reference="Niedermayr et al., Compressed 3D Gaussian Splatting for Accelerated Novel View Synthesis, CVPR 2024",
    suffix=PACKED_SUFFIX,
    uses=(*SPLAT_SETTINGS, NAME),
    train=train,
    write=write_itself,
    settings=C3DGSConfig,
    presets={"scaled": {NAME: {"codebook_share": 0.1}}},
    from_splats=True,
)
