"""Compact3D (Navaneet et al., ECCV 2024): colors, harmonics, scales and rotations are entries of four codebooks, which
are learned while the splats are trained; a penalty on opacities makes splats superfluous.

    plain 3DGS ──► penalty, pruning ──► codes instead of values, splats move on ──► labels stay, codes go on ──► file
    0 to 1/2       1/2 to 2/3           1/2 to 5/6                                  to the end

`docs/methods/compact3d.md` says what is as published, and the law of bytes.
"""

from typing import TYPE_CHECKING

from compgs.methods.compact3d.settings import NAME, Compact3DConfig
from compgs.methods.method import PACKED_SUFFIX, SPLAT_SETTINGS, Method, write_itself

if TYPE_CHECKING:
    from compgs.model.splats import SplatModel
    from compgs.published.parts.content import Content
    from compgs.scene.views import Scene
    from compgs.training.run.run import Run


def train(
    scene: "Scene", config: Compact3DConfig, run: "Run", start: "SplatModel | None" = None
) -> "Content":
    """The content of the file. Raises as `compgs.train` does."""
    from compgs.methods.compact3d.hooks import LearnedCodebooks
    from compgs.published.compact3d import opened
    from compgs.published.parts.content import Content
    from compgs.training.splats.phases import Phase, train_phases

    trainer = train_phases(
        scene, (Phase(config, lambda: LearnedCodebooks(config.compact3d, config.training)),), run
    )
    assert isinstance(trainer.hooks, LearnedCodebooks)
    packed = trainer.hooks.content(trainer)
    return Content(packed, scene.background, opened, ("raw",), run.device)


COMPACT3D = Method(
    name=NAME,
    description="plain 3DGS, codebooks learned while training",
    reference="Navaneet et al., CompGS: Smaller and Faster Gaussian Splatting with Vector Quantization, ECCV 2024",
    suffix=PACKED_SUFFIX,
    uses=(*SPLAT_SETTINGS, NAME),
    train=train,
    write=write_itself,
    settings=Compact3DConfig,
    presets={
        "scaled": {NAME: {"codebook_share": 0.1}},
        "bitq": {NAME: {"codebook_share": 0.1, "bit_quantized": True}},
    },
)
