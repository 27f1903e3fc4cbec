"""Settings of c3dgs."""

from dataclasses import dataclass, field
from typing import Annotated

from compgs.config import Config, Range

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
