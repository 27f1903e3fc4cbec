"""Settings of LightGaussian."""

from dataclasses import dataclass, field
from typing import Annotated

from compgs.config import Config, Range, Share

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
