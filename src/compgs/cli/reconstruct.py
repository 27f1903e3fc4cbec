"""`compgs reconstruct`: photographs or a video without poses -> a scene."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeRemainingColumn
from tyro.conf import FlagCreatePairsOff, Positional, arg

from compgs.cli.colmap_options import ColmapOptions
from compgs.cli.command import Command
from compgs.cli.console import console, say, warn
from compgs.cli.progress import LINE_SECONDS, counting_lines
from compgs.cli.usage import settings_of_options
from compgs.words import duration

if TYPE_CHECKING:
    from compgs.reconstruct import Reconstruction
    from compgs.reconstruct.mapping import Progress as StageProgress

ENOUGH_JOINED = 0.75  # of the photographs: if fewer have a pose, something went wrong
MOST_NAMES = 5  # of photographs without a pose, that are listed


@dataclass(frozen=True, kw_only=True)
class Reconstruct(Command, ColmapOptions):
    """Find the poses of photographs, or of a video's frames, and write a scene that `compgs train` reads.

    Photographs should overlap by two thirds, be sharp, and show something with texture that stands still; 30 to 300
    of them, from all sides that are to be seen. COLMAP does the work (the extra `reconstruct`).

    Examples

    compgs reconstruct photos -o scenes/garden

    compgs reconstruct walk.mp4 --frames 200 -o scenes/walk

    compgs train scenes/garden -o runs/garden
    """

    photographs: Annotated[Positional[Path], arg(metavar="PHOTOS")]
    """Folder of photographs (folders inside it count, too), or a video."""

    output: Annotated[Path, arg(aliases=["-o"], metavar="SCENE")]
    """Folder for the scene: images/, sparse/0, reconstruction.json and reconstruction.png."""

    matching: Literal["auto", "exhaustive", "sequential", "retrieval"] = "auto"
    """Which photographs are compared: each with each, each with its neighbours by name, as in a video, or each with
    neighbours by name and with those that look alike. By default sequential for videos, and retrieval for more than 60
    photographs."""

    overlap: Annotated[int, arg(metavar="N")] = 10
    """Neighbours on each side in sequential matching."""

    camera: Literal["auto", "one", "folder", "each"] = "auto"
    """Which photographs share a lens: all, those of a folder, none; by default all if sizes and headers agree."""

    lens: Annotated[str, arg(metavar="MODEL")] = "auto"
    """COLMAP's model of the lens: SIMPLE_RADIAL, OPENCV, OPENCV_FISHEYE, PINHOLE, ..."""

    frames: Annotated[int, arg(metavar="N")] = 120
    """Frames to take from a video: the sharpest of each of N stretches."""

    features: Annotated[int, arg(metavar="N")] = 4096
    """Most features of a photograph; more help with fine texture, and take longer."""

    undistort: FlagCreatePairsOff[bool] = False
    """Write images without lens distortion, for other programs; `compgs train` undistorts as it reads."""

    overwrite: FlagCreatePairsOff[bool] = False
    """Replace a scene that is in SCENE already."""

    def run(self) -> None:
        from compgs.reconstruct import ReconstructOptions, reconstruct

        self.check_colmap_options()
        options = ReconstructOptions(
            matching=self.matching,
            overlap=self.overlap,
            shared=self.camera,
            lens=self.lens,
            frames=self.frames,
            features=self.features,
            feature_size=self.feature_size,
            undistort=self.undistort,
            threads=self.threads,
            seed=self.seed,
        )
        with settings_of_options(), stages_shown() as progress:
            result = reconstruct(
                self.photographs, self.output, options, overwrite=self.overwrite, progress=progress
            )
        show(result)


def show(result: "Reconstruction") -> None:
    """A few lines for people."""
    times = ", ".join(f"{stage} {duration(seconds)}" for stage, seconds in result.seconds.items())
    say(
        f"{result.scene}: {result.registered} of {result.photographs} photographs have a pose, "
        f"{result.points:,} points, reprojection error {result.reprojection_error:.2f} pixels"
    )
    say(f"{result.lens}, {result.matching} matching; {times}")
    if result.masks and result.masks_kept:
        say(
            f"masks of {result.masks} photographs are in {result.scene / 'masks'}; poses were found without them"
        )
    elif result.masks:
        say(f"note: masks of {result.masks} photographs are left out: --undistort makes other pixels")
    if result.missing:
        names = ", ".join(result.missing[:MOST_NAMES]) + (", ..." if len(result.missing) > MOST_NAMES else "")
        say(f"note: without a pose: {names}")
    if result.missing and result.models > 1:
        say(f"note: {result.models} parts could not be joined; the largest is the scene")
    if result.registered < ENOUGH_JOINED * result.photographs:
        warn(
            f"only {result.registered} of {result.photographs} photographs have a pose: the scene shows no more than "
            f"what these saw. {remedy(result.matching)}"
        )
    say(f"{result.scene / 'reconstruction.png'} shows cameras and points; next: compgs train {result.scene}")


def remedy(matching: str) -> str:
    """What lets COLMAP join more photographs, after it has compared them in this way."""
    search = "--features 8192" if matching == "exhaustive" else "--matching exhaustive and --features 8192"
    return f"{search} may join more, and more photographs between those that lie far apart surely will"


@contextmanager
def stages_shown() -> "Iterator[StageProgress]":
    """A bar, or lines, for each stage in turn."""
    if not console.is_terminal:
        lines: dict[str, Callable[[int, int], None]] = {}

        def write(stage: str, done: int, total: int) -> None:
            if stage not in lines:
                say(f"{stage}: {total} to do; a line every {LINE_SECONDS:.0f} seconds")
                lines[stage] = counting_lines(stage)
            lines[stage](done, total)

        yield write
        return
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console) as bars:
        tasks: dict[str, TaskID] = {}

        def show(stage: str, done: int, total: int) -> None:
            if stage not in tasks:
                tasks[stage] = bars.add_task(stage, total=total)
            bars.update(tasks[stage], completed=done, total=total)

        yield show
