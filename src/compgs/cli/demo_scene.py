"""`compgs demo-scene`: a scene to try the program on."""

import secrets
import shutil
from dataclasses import dataclass
from fnmatch import fnmatch
from pathlib import Path
from typing import Annotated

from tyro.conf import FlagCreatePairsOff, Positional, arg

from compgs.cli.command import Command
from compgs.cli.console import say
from compgs.cli.progress import counting
from compgs.cli.usage import check_range
from compgs.errors import OutputError
from compgs.occupied import occupied
from compgs.outputs import LOCK_NAME, check_output_folder


@dataclass(frozen=True, kw_only=True)
class DemoScene(Command):
    """Make a scene to try the program on: ray-traced objects, written as a COLMAP data set.

    Example

    compgs demo-scene scenes/demo
    """

    folder: Annotated[Positional[Path], arg(metavar="FOLDER")]
    """Folder for the scene."""

    views: Annotated[int, arg(metavar="N")] = 40
    """Number of views."""

    width: Annotated[int, arg(metavar="PIXELS")] = 320
    """Width of the images."""

    height: Annotated[int, arg(metavar="PIXELS")] = 240
    """Height of the images."""

    seed: Annotated[int, arg(metavar="N")] = 0
    """Seed of everything random."""

    overwrite: FlagCreatePairsOff[bool] = False
    """Replace a scene that is in FOLDER already."""

    def run(self) -> None:
        check_range("--views", self.views, 2, 10_000)
        check_range("--width", self.width, 16, 8192)
        check_range("--height", self.height, 16, 8192)
        check_range("--seed", self.seed, 0, 2**31 - 1)
        check_output_folder(self.folder, overwrite=self.overwrite)
        if self.overwrite:
            check_only_a_scene(self.folder)
        from compgs.scene.generated import generate_scene

        # What is in the folder stays until the new scene is complete.
        hidden = self.folder.absolute().with_name(f".{self.folder.absolute().name}.{secrets.token_hex(8)}")
        target = hidden.with_suffix(".new")
        with occupied(self.folder), counting("ray tracing") as progress:
            generate_scene(
                target,
                views=self.views,
                width=self.width,
                height=self.height,
                seed=self.seed,
                progress=progress,
            )
            self.folder.rename(hidden)
            target.rename(self.folder)
            shutil.rmtree(hidden)
        say(f"{self.folder}: {self.views} views, {self.width} x {self.height}, in COLMAP's layout")


def check_only_a_scene(folder: Path) -> None:
    """Raises OutputError if a folder that is to be replaced holds anything else than a generated scene."""
    from compgs.scene.doubt import GENERATED

    parts = [path for path in folder.glob("*") if path.name in ("images", "sparse", GENERATED, LOCK_NAME)]
    others = [path for path in folder.glob("*") if path not in parts]
    others += [path for path in (folder / "images").glob("*") if not fnmatch(path.name, "view_*.png")]
    if others:
        raise OutputError(
            f"{others[0]}: not part of a generated scene, so {folder} is not replaced; choose another folder"
        )
