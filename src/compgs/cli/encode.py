"""`compgs encode`: the file of a finished run."""

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import FlagCreatePairsOff, Positional, arg

from compgs.cli.command import ComputingCommand
from compgs.cli.console import duration, print_components, say, size
from compgs.cli.run_folder import CHECKPOINT_NAME, file_name
from compgs.errors import CheckpointError
from compgs.outputs import check_output_file


@dataclass(frozen=True, kw_only=True)
class Encode(ComputingCommand):
    """Write the .cgs file of a run that has been trained.

    Example

    compgs encode runs/garden -o garden.cgs
    """

    folder: Annotated[Positional[Path], arg(metavar="RUN")]
    """Folder of the run."""

    output: Annotated[
        Path | None, arg(aliases=["-o"], metavar="FILE", help_behavior_hint="(default: RUN/RUN.cgs)")
    ] = None
    """The file to write."""

    geometry: Literal["octree", "tmc3"] = "octree"
    """Anchor positions by the octree coder (smaller), or by G-PCC as in the paper: then `tmc3` must be on PATH, also
    where the file is decoded."""

    overwrite: FlagCreatePairsOff[bool] = False
    """Replace a file that is there already."""

    def run(self) -> None:
        if not self.folder.is_dir():
            raise CheckpointError(
                f"{self.folder}: there is no such folder; give the folder that `compgs train -o` wrote"
            )
        path = self.output or self.folder / file_name(self.folder)
        check_output_file(path, overwrite=self.overwrite)
        if not (self.folder / CHECKPOINT_NAME).is_file():
            raise CheckpointError(
                f"{self.folder}: has no {CHECKPOINT_NAME}; give the folder that `compgs train -o` wrote"
            )
        self.prepare()
        from compgs.codec import encode
        from compgs.codec.reader import file_info
        from compgs.training import load_run

        model = load_run(self.folder)
        path.parent.mkdir(parents=True, exist_ok=True)
        start = time.perf_counter()
        encoded = encode(model, path, overwrite=self.overwrite, geometry=self.geometry)
        say(f"{path}: {size(encoded.bytes)}, encoded in {duration(time.perf_counter() - start)}")
        sections = file_info(path.read_bytes()).sections
        print_components({s.name: s.bytes for s in sections}, encoded.anchors, encoded.coupled)
