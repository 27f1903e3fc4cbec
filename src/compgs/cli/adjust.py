"""`compgs adjust`: a capture with cameras -> the same with cameras that fit its photographs better."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import FlagCreatePairsOff, Positional, arg

from compgs.cli.colmap_options import ColmapOptions
from compgs.cli.command import Command
from compgs.cli.console import say, warn
from compgs.cli.reconstruct import MOST_NAMES, stages_shown
from compgs.cli.usage import settings_of_options
from compgs.words import duration

if TYPE_CHECKING:
    from compgs.reconstruct import Adjusted


@dataclass(frozen=True, kw_only=True)
class Adjust(Command, ColmapOptions):
    """Make the cameras of a COLMAP capture fit its photographs better (bundle adjustment), and write it anew.

    Worth trying on captures from elsewhere whose scenes stay soft: a camera that is off by a third of a pixel costs
    detail everywhere. Photographs are linked, not copied. COLMAP does the work (the extra `reconstruct`).

    Examples

    compgs adjust scenes/truck -o scenes/truck_adjusted

    compgs train scenes/truck_adjusted -o runs/truck
    """

    capture: Annotated[Positional[Path], arg(metavar="SCENE")]
    """Folder of a capture with images/ and sparse/0."""

    output: Annotated[Path, arg(aliases=["-o"], metavar="ADJUSTED")]
    """Folder for the capture with its new cameras and points, and adjustment.json."""

    features: Annotated[int, arg(metavar="N")] = 6000
    """Most features of a photograph."""

    overwrite: FlagCreatePairsOff[bool] = False
    """Replace a capture that is in ADJUSTED already."""

    def run(self) -> None:
        from compgs.reconstruct import AdjustOptions, adjust

        self.check_colmap_options()
        options = AdjustOptions(self.features, self.feature_size, self.threads, self.seed)
        with settings_of_options(), stages_shown() as progress:
            result = adjust(self.capture, self.output, options, overwrite=self.overwrite, progress=progress)
        show(result)


def show(result: "Adjusted") -> None:
    """A few lines for people."""
    say(
        f"{result.scene}: {result.photographs} photographs, {result.points:,} points, {duration(result.seconds)}"
    )
    say(
        f"features are {result.error_before:.2f} pixels from where their points are seen, now "
        f"{result.error_after:.2f}; common to parts of a photograph {result.shift_before:.2f}, now "
        f"{result.shift_after:.2f}"
    )
    if result.seldom_seen:
        names = ", ".join(result.seldom_seen[:MOST_NAMES])
        more = ", ..." if len(result.seldom_seen) > MOST_NAMES else ""
        warn(f"too few common points to say where these were taken: {names}{more}")
    say(f"next: compgs train {result.scene}")
