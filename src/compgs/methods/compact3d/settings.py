"""Settings of Compact3D."""

from dataclasses import dataclass, field
from typing import Annotated

from compgs.config import Config, Range, Share

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
