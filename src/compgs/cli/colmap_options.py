"""The options of commands whose work COLMAP does."""

from dataclasses import dataclass
from typing import Annotated

from tyro.conf import arg

from compgs.cli.command import NO_DEFAULT
from compgs.cli.usage import check_range


@dataclass(frozen=True, kw_only=True)
class ColmapOptions:
    """How COLMAP finds features, and with what."""

    feature_size: Annotated[int, arg(metavar="PIXELS")] = 1600
    """Larger photographs are shrunk to this length of their longer side to find features."""

    threads: Annotated[int | None, arg(metavar="N", help_behavior_hint=NO_DEFAULT)] = None
    """Threads to use; all cores by default."""

    seed: Annotated[int, arg(metavar="N")] = 0
    """Seed of everything random."""

    def check_colmap_options(self) -> None:
        """Raises UsageError for a number that is out of range."""
        check_range("--seed", self.seed, 0, 2**31 - 1)
        if self.threads is not None:
            check_range("--threads", self.threads, 1, 1024)
