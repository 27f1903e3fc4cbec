"""LightGaussian (Fan et al., NeurIPS 2024): the splats that matter least go, harmonics are distilled to fewer, and the
colors of most splats share a codebook.

    plain 3DGS ──► prune two of three ──► settle ──► degree 3 teaches degree 2 ──► codebook for most ──► DEFLATE
    the run                               1/6 more   1/6 more

`docs/methods/lightgaussian.md` says what is as published, and the law of bytes.
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

NAME = "lightgaussian"


@dataclass(frozen=True)
class LightGaussianSection:
    """Pruning, distillation and codebook, as released."""

    # of the splats: those of least significance go
    prune: Annotated[float, Range(0, 1, below=True)] = 0.66
    # of a splat's volume, in its significance
    volume_power: Annotated[float, Range(0, 10)] = 0.1
    # steps after pruning, of the run's, which they follow (5 000 after 30 000)
    settled: Annotated[float, Range(0, 10)] = 1 / 6
    # by which learning rates have fallen at their end (0.95 each 400 of 5 000 steps)
    settled_slowing: Annotated[float, Range(0, 1, above=True)] = 0.95 ** (5000 / 400)
    # degree of the harmonics at the end
    degree: Annotated[int, Range(0, 3)] = 2
    # steps of distillation, of the run's (5 000)
    distilled: Annotated[float, Range(0, 10)] = 1 / 6
    # by which learning rates have fallen at their end (0.90 each 500 of 5 000 steps)
    distilled_slowing: Annotated[float, Range(0, 1, above=True)] = 0.90 ** (5000 / 500)
    # scene extents: standard deviation of a camera's way aside, along each axis, in two of three steps of distillation
    # (0.05 units; published scenes have extents of about 5)
    jitter: Annotated[float, Range(0, 10)] = 0.01
    # of the splats: those of least significance have colors of the codebook
    coded: Share = 0.6
    # its entries
    codebook: Annotated[int, Range(1, 1 << 16)] = 8192
    # of the file, that it may take: the number of entries is halved until it does; 1: as it is
    codebook_share: Annotated[float, Range(0, 1, above=True)] = 1.0
    # of moving averages
    codebook_steps: Annotated[int, Range(0, 1_000_000)] = 1000
    # splats in each of them, at most
    codebook_batch: Annotated[int, Range(1, 1 << 30)] = 80_000
    # of what a code has seen so far, a step
    decay: Annotated[float, Range(0, 1, below=True)] = 0.8
    # of the codes that are nearest to least, so many begin again in each step
    reseeded: Annotated[int, Range(0, 1 << 16)] = 10


@dataclass(frozen=True)
class LightGaussianConfig(Config):
    """Settings of plain 3DGS, and of this method."""

    lightgaussian: LightGaussianSection = field(default_factory=LightGaussianSection)


def train(
    scene: "Scene", config: LightGaussianConfig, run: "Run", start: "SplatModel | None" = None
) -> "Content":
    """The content of the file. Raises as `compgs.train` does."""
    from compgs.methods.lightgaussian.hooks import Distilled, Pruned, content
    from compgs.methods.parts.content import Content
    from compgs.training.splats.phases import Phase, fine_tuning, train_phases

    section, steps = config.lightgaussian, config.training.steps
    settled, distilled = (
        fine_tuning(config, max(1, round(share * steps))) for share in (section.settled, section.distilled)
    )
    phases = (
        Phase(config),
        Phase(settled, lambda: Pruned(section)),
        Phase(distilled, lambda: Distilled(section, config.training.seed)),
    )
    trainer = train_phases(scene, phases, run, start)
    return Content(content(trainer, config), scene.background, open_file, ("raw", "deflate"), run.device)


def open_file(packed: "Packed", device: "Device", background: tuple[float, float, float]) -> "SplatModel":
    from compgs.formats.packed import splat_model
    from compgs.methods.lightgaussian.files import splats_of

    return splat_model(packed, splats_of(packed), device, background)


LIGHTGAUSSIAN = Method(
    name=NAME,
    description="plain 3DGS, pruned by significance, harmonics distilled, a codebook of colors",
    reference="Fan et al., LightGaussian, NeurIPS 2024",
    suffix=PACKED_SUFFIX,
    uses=(*SPLAT_SETTINGS, NAME),
    train=train,
    write=write_itself,
    open=open_file,
    settings=LightGaussianConfig,
    presets={"scaled": {NAME: {"codebook_share": 0.1}}},
    from_splats=True,
)
