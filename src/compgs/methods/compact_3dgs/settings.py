"""Settings of Compact 3D Gaussian Representation."""

from dataclasses import dataclass, field
from typing import Annotated

from compgs.config import Config, LearningRate, Positive, Range, Share, SplatConfig
from compgs.published.compact_3dgs import MOST_FEATURES, MOST_LEVELS, MOST_TABLE_BITS


@dataclass(frozen=True)
class CompactSection:
    """Settings of the authors' release; schedules as fractions of its 30 000 steps."""

    # weight of the mean mask in the loss: the rate
    mask_weight: Annotated[float, Range(0, 1e3)] = 5e-4
    mask_lr: LearningRate = 0.01
    # masks at or below it hide their splats, which are then removed
    mask_threshold: Annotated[float, Range(0, 1, above=True, below=True)] = 0.01
    # of the steps between two removals, once growth has ended (1 000 of 30 000)
    mask_every: Annotated[float, Range(0, 1, above=True)] = 1 / 30
    # levels of the hash grid
    grid_levels: Annotated[int, Range(1, MOST_LEVELS)] = 16
    # numbers of an entry
    grid_features: Annotated[int, Range(1, MOST_FEATURES)] = 2
    # cells an axis of the coarsest level, and how many times more each finer one has
    grid_base: Annotated[int, Range(1, 1 << 10)] = 16
    grid_growth: Annotated[float, Range(1, 4)] = 1.447
    # log2 of the entries that a level may have
    grid_bits: Annotated[int, Range(4, MOST_TABLE_BITS)] = 19
    # of grid and network; a third of it from each of `color_lr_falls` on
    color_lr: LearningRate = 0.01
    color_lr_falls: Annotated[tuple[float, ...], Range(0, 1)] = (1 / 6, 1 / 2, 5 / 6)
    # of the steps: codebooks of scales and rotations begin
    codes_start: Share = 29 / 30
    # codebooks one after the other, and codes of each
    code_stages: Annotated[int, Range(1, 16)] = 6
    codes: Annotated[int, Range(2, 1 << 12)] = 64
    # of the codes
    codes_lr: Positive = 1e-4


def _splats() -> SplatConfig:
    return SplatConfig(harmonics=0)


@dataclass(frozen=True)
class CompactConfig(Config):
    """Splats have no harmonics: the network is their color."""

    splats: SplatConfig = field(default_factory=_splats)
    compact: CompactSection = field(default_factory=CompactSection)


# For small scenes and short runs: a grid of 0.1 MB, not of 25 MB, and masks that can get from 1 to the threshold (560
# steps away at the published rate) in the time there is.
SCALED = {"grid_bits": 11, "mask_lr": 0.1}
