"""c3dgs (Niedermayr et al., CVPR 2024): colors and shapes that matter keep entries of their own, the others share those
of two codebooks; all is then trained as 8 bits will show it.

    plain 3DGS ──► sensitivity ──► weighted codebooks ──► fine-tuning, rounded ──► Morton order, DEFLATE
    the run                                               1/6 more steps

`docs/methods/c3dgs.md` says what is as published, and the law of bytes.
"""

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Annotated

from compgs.config import Config, Range
from compgs.methods.method import PACKED_SUFFIX, SPLAT_SETTINGS, Method, write_itself

if TYPE_CHECKING:
    from compgs.devices import Device
    from compgs.formats.packed import Packed
    from compgs.methods.parts.content import Content
    from compgs.model.splats import SplatModel
    from compgs.scene.views import Scene
    from compgs.training.run.run import Run

NAME = "c3dgs"


@dataclass(frozen=True)
class C3DGSSection:
    """Codebooks and fine-tuning, as released."""

    # entries of each of the two codebooks, beside those of single splats
    codebook: Annotated[int, Range(1, 1 << 16)] = 4096
    # of the file, that codebooks may take: the number of entries is halved until they do; 1: as it is
    codebook_share: Annotated[float, Range(0, 1, above=True)] = 1.0
    # over the number of splats: a sensitivity of the color above it asks for an entry of its own (6e-7, of 3.2 million)
    color_threshold: Annotated[float, Range(0, 1e9)] = 1.9
    # of the shape (3e-6)
    shape_threshold: Annotated[float, Range(0, 1e9)] = 9.6
    # factor of both thresholds: a larger one leaves fewer entries of their own, and a smaller file
    threshold: Annotated[float, Range(0, 1e9)] = 1.0
    # of moving averages, for colors and for shapes
    color_steps: Annotated[int, Range(0, 1_000_000)] = 100
    shape_steps: Annotated[int, Range(0, 1_000_000)] = 800
    # splats in each of them, at most
    color_batch: Annotated[int, Range(1, 1 << 30)] = 1 << 18
    shape_batch: Annotated[int, Range(1, 1 << 30)] = 1 << 20
    # of what a code has seen so far, a step
    decay: Annotated[float, Range(0, 1, below=True)] = 0.8
    # steps of fine-tuning, of the run's, which they follow (5 000 after 30 000)
    tuned: Annotated[float, Range(0, 10)] = 1 / 6


@dataclass(frozen=True)
class C3DGSConfig(Config):
    """Settings of plain 3DGS, and of this method."""

    c3dgs: C3DGSSection = field(default_factory=C3DGSSection)


def train(scene: "Scene", config: C3DGSConfig, run: "Run", start: "SplatModel | None" = None) -> "Content":
    """The content of the file. Raises as `compgs.train` does."""
    from compgs.methods.c3dgs.hooks import SharedEntries
    from compgs.methods.parts.content import Content
    from compgs.training.splats.phases import Phase, fine_tuning, train_phases

    steps = max(1, round(config.c3dgs.tuned * config.training.steps))
    tuned = Phase(fine_tuning(config, steps), lambda: SharedEntries(config))
    trainer = train_phases(scene, (Phase(config), tuned), run, start)
    assert isinstance(trainer.hooks, SharedEntries)
    return Content(
        trainer.hooks.content(trainer), scene.background, open_file, ("raw", "deflate"), run.device
    )


def open_file(packed: "Packed", device: "Device", background: tuple[float, float, float]) -> "SplatModel":
    from compgs.formats.packed import splat_model
    from compgs.methods.c3dgs.files import splats_of

    return splat_model(packed, splats_of(packed), device, background)


C3DGS = Method(
    name=NAME,
    description="plain 3DGS, codebooks by sensitivity, trained for 8 bits",
    reference="Niedermayr et al., Compressed 3D Gaussian Splatting for Accelerated Novel View Synthesis, CVPR 2024",
    suffix=PACKED_SUFFIX,
    uses=(*SPLAT_SETTINGS, NAME),
    train=train,
    write=write_itself,
    open=open_file,
    settings=C3DGSConfig,
    presets={"scaled": {NAME: {"codebook_share": 0.1}}},
    from_splats=True,
)
