"""Compact3D (Navaneet et al., ECCV 2024): colors, harmonics, scales and rotations are entries of four codebooks, which
are learned while the splats are trained; a penalty on opacities makes splats superfluous.

    plain 3DGS ──► penalty, pruning ──► codes instead of values, splats move on ──► labels stay, codes go on ──► file
    0 to 1/2       1/2 to 2/3           1/2 to 5/6                                  to the end

`docs/methods/compact3d.md` says what is as published, and the law of bytes.
"""

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Annotated

from compgs.config import Config, Range, Share
from compgs.methods.method import PACKED_SUFFIX, SPLAT_SETTINGS, Method, write_itself

if TYPE_CHECKING:
    from compgs.devices import Device
    from compgs.formats.packed import Packed
    from compgs.methods.parts.content import Content
    from compgs.model.splats import SplatModel
    from compgs.scene.views import Scene
    from compgs.training.run.run import Run

NAME = "compact3d"


@dataclass(frozen=True)
class Compact3DSection:
    """Codebooks and penalty; "Ref." marks values of the authors' released configuration, where the paper has others."""

    # codes of each of: colors of degree 0, scales, rotations (Ref.; up to 32 768 in the paper)
    codebook: Annotated[int, Range(1, 1 << 16)] = 4096
    # codes of the harmonics above (Ref.; 4 096 in the paper)
    harmonics_codebook: Annotated[int, Range(1, 1 << 16)] = 512
    # of the file, that codebooks may take: the numbers of codes are halved until they do; 1: as they are
    codebook_share: Annotated[float, Range(0, 1, above=True)] = 1.0
    # of the steps: codes take the place of values (Ref.: 15 000 of 30 000; 20 000 in the paper)
    start: Share = 0.5
    # of the steps: from here on labels stay (25 000 of 30 000)
    stop: Share = 5 / 6
    # of the steps between two assignments of labels (100 of 30 000); `hooks.LEAST_EVERY` steps at least
    every: Annotated[float, Range(0, 1, above=True)] = 1 / 300
    # rounds of k-means in each of them
    rounds: Annotated[int, Range(1, 1000)] = 1
    # in the first one
    first_rounds: Annotated[int, Range(1, 1000)] = 10
    # weight of the mean opacity of the splats there are when it begins (1e-7 of the sum, of 3.3 million)
    opacity_weight: Annotated[float, Range(0, 1e6)] = 0.33
    # of the steps: first and last of the penalty, and of pruning splats that are transparent (15 000 to 20 000)
    opacity_steps: Annotated[tuple[float, float], Range(0, 1)] = (0.5, 2 / 3)
    # of the steps between two prunings (1 000)
    prune_every: Annotated[float, Range(0, 1, above=True)] = 1 / 30
    # positions of 16 bits an axis and opacities of 8 (the paper's BitQ) in place of single precision
    bit_quantized: bool = False


@dataclass(frozen=True)
class Compact3DConfig(Config):
    """Settings of plain 3DGS, and of this method."""

    compact3d: Compact3DSection = field(default_factory=Compact3DSection)


def train(
    scene: "Scene", config: Compact3DConfig, run: "Run", start: "SplatModel | None" = None
) -> "Content":
    """The content of the file. Raises as `compgs.train` does."""
    from compgs.methods.compact3d.hooks import LearnedCodebooks
    from compgs.methods.parts.content import Content
    from compgs.training.splats.phases import Phase, train_phases

    trainer = train_phases(
        scene, (Phase(config, lambda: LearnedCodebooks(config.compact3d, config.training)),), run
    )
    assert isinstance(trainer.hooks, LearnedCodebooks)
    packed = trainer.hooks.content(trainer)
    return Content(packed, scene.background, open_file, ("raw",), run.device)


def open_file(packed: "Packed", device: "Device", background: tuple[float, float, float]) -> "SplatModel":
    from compgs.formats.packed import splat_model
    from compgs.methods.compact3d.files import splats_of

    return splat_model(packed, splats_of(packed), device, background)


COMPACT3D = Method(
    name=NAME,
    description="plain 3DGS, codebooks learned while training",
    reference="Navaneet et al., CompGS: Smaller and Faster Gaussian Splatting with Vector Quantization, ECCV 2024",
    suffix=PACKED_SUFFIX,
    uses=(*SPLAT_SETTINGS, NAME),
    train=train,
    write=write_itself,
    open=open_file,
    settings=Compact3DConfig,
    presets={
        "scaled": {NAME: {"codebook_share": 0.1}},
        "bitq": {NAME: {"codebook_share": 0.1, "bit_quantized": True}},
    },
)
