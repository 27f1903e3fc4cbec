"""`compgs encode`: the file of a finished run, or a smaller one from a file."""

import shlex
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import FlagCreatePairsOff, Positional, arg

from compgs.cli.command import DecodingCommand, ReadingOptions, allow_tmc3
from compgs.cli.console import print_reduction, say
from compgs.cli.inputs import check_bitstream, read_bitstream
from compgs.cli.of_a_tile import cut
from compgs.cli.progress import counting
from compgs.cli.run_folder import CHECKPOINT_NAME, SETTINGS_NAME, SceneSource, file_name, load_settings
from compgs.cli.scenes import read_scene
from compgs.cli.sizes import parse_cameras
from compgs.cli.usage import UsageError, settings_of_options
from compgs.errors import CheckpointError
from compgs.outputs import check_output_file, write_bytes
from compgs.words import duration, size

if TYPE_CHECKING:
    from compgs.cameras import Camera
    from compgs.scene.views import View


@dataclass(frozen=True, kw_only=True)
class Encode(DecodingCommand, ReadingOptions):
    """Write the .cgs file of a run that has been trained, or a smaller file from a .cgs file, without training.

    Smaller: --drop leaves out the coupled primitives that contribute least to images, --coarser rounds the anchors'
    covariances to coarser steps. What that loses is shown: the new renderings against the old ones, from the views
    that a scene was trained on or, where no scene is known, from cameras around it; and with a scene both files
    against its held-out photographs. Give -r and the like as in training.

    Examples

    compgs encode runs/garden -o garden.cgs

    compgs encode garden.cgs -o small.cgs --drop 0.2 --coarser 2

    compgs encode garden.cgs -o small.cgs --drop 0.2 --scene scenes/garden -r 4
    """

    source: Annotated[Positional[Path], arg(metavar="RUN|FILE")]
    """Folder of the run, or a .cgs file."""

    output: Annotated[
        Path | None,
        arg(aliases=["-o"], metavar="FILE", help_behavior_hint="(default for a run: RUN/RUN.cgs)"),
    ] = None
    """The file to write."""

    drop: Annotated[float, arg(metavar="SHARE")] = 0.0
    """Share of the coupled primitives to leave out, 0 up to below 1; anchors that have none left go too."""

    coarser: Annotated[float, arg(metavar="FACTOR")] = 1.0
    """Factor on the step of the anchors' covariances, 1 to 64."""

    scene: Annotated[
        Path | None,
        arg(metavar="SCENE", help_behavior_hint="(default for a run: its own, where it still is)"),
    ] = None
    """Scene whose training views measure the contribution of a primitive, and whose held-out views measure the loss."""

    cameras: Annotated[str | None, arg(metavar="N|none", help_behavior_hint="(default: the run's, 12)")] = (
        None
    )
    """Cameras that the file keeps, to look from: the first N of those that stand for all training views."""

    geometry: Literal["octree", "tmc3"] = "octree"
    """Anchor positions by the octree coder (smaller), or by G-PCC as in the paper: then `tmc3` must be on PATH, also
    where the file is decoded."""

    overwrite: FlagCreatePairsOff[bool] = False
    """Replace a file that is there already."""

    def run(self) -> None:
        path = self.check()
        if self.source.is_dir():
            self.prepare_training("encode")
        else:
            self.prepare("decode")
        start = time.perf_counter()
        data = self.encoded_run() if self.source.is_dir() else read_bitstream(self.source)
        if self.reduces:
            data = self.reduced(data)
        if self.source.is_file() and self.cameras is not None:
            data = with_fewer_viewpoints(data, parse_cameras(self.cameras))
        write_bytes(path, data)
        say(f"{path}: {size(len(data))}, written after {duration(time.perf_counter() - start)}")
        say(f"what takes how many bytes: compgs info {shlex.quote(str(path))}")

    @property
    def reduces(self) -> bool:
        return self.drop != 0.0 or self.coarser != 1.0

    def check(self) -> Path:
        """The file to write. Raises what can be said before anything is computed."""
        self.check_reading()
        if self.geometry == "tmc3":
            from compgs.codec.tmc3 import find_program

            find_program()
            allow_tmc3()  # what is written is read again
        if self.reduces:
            from compgs.evaluation.reduction import check_reduction

            with settings_of_options():
                check_reduction(self.drop, self.coarser)
        if self.source.is_dir():
            path = self.output or self.source / file_name(self.source)
            check_output_file(path, overwrite=self.overwrite)
            if not (self.source / CHECKPOINT_NAME).is_file():
                raise CheckpointError(
                    f"{self.source}: has no {CHECKPOINT_NAME}; give the folder that `compgs train -o` wrote"
                )
            return path
        if not self.source.exists():
            raise CheckpointError(
                f"{self.source}: there is no such folder or file; give the folder that `compgs train -o` wrote, "
                "or a .cgs file"
            )
        check_bitstream(self.source)
        if not self.reduces and self.cameras is None:
            raise UsageError(
                f"{self.source} is a .cgs file already; give --drop or --coarser for a smaller one"
            )
        if self.output is None:
            raise UsageError("no file to write was given: name it with -o")
        check_output_file(self.output, overwrite=self.overwrite)
        return self.output

    def encoded_run(self) -> bytes:
        from compgs.codec.encoder import encoded
        from compgs.training import load_run

        viewpoints = None if self.cameras is None else parse_cameras(self.cameras)
        model = load_run(self.source)
        if (self.source / SETTINGS_NAME).is_file():  # a run that began in Python has none, and is of no tile
            cut(model, load_settings(self.source))
        return encoded(model, self.geometry, viewpoints=viewpoints)[0]

    def reduced(self, data: bytes) -> bytes:
        from compgs.evaluation.reduction import reduce_file

        cameras, held_out, where = self.judges(data)
        say(f"contributions and loss, measured from: {where}")
        with counting("looking at cameras") as progress:
            data, reduction = reduce_file(
                data,
                drop=self.drop,
                coarser=self.coarser,
                cameras=cameras,
                held_out=held_out,
                geometry=self.geometry,
                device=self.device,
                progress=progress,
            )
        print_reduction(reduction)
        return data

    def judges(self, data: bytes) -> "tuple[list[Camera], tuple[View, ...], str]":
        """Cameras by which contribution and loss are measured, held-out views, and a text that says which cameras."""
        source = self.scene_source()
        if source is not None:
            scene = read_scene(source)
            # A scene of which every view is held out still says where people look from.
            views = scene.train_views or scene.test_views
            return [view.camera for view in views], scene.test_views, f"the {len(views)} training views"
        from compgs.codec.reader import read_content
        from compgs.evaluation.camera_path import surround

        content = read_content(data)
        origin = tuple(-x for x in content.world_offset)
        around = surround(content.coordinates * content.voxel_size)
        cameras = [camera.moved(origin) for _, camera in around]
        return cameras, (), f"{len(cameras)} cameras around the scene; --scene judges by photographs"

    def scene_source(self) -> SceneSource | None:
        """The scene that was given, or the run's own; none for a file alone, or if the run's scene has moved."""
        if self.scene is not None:
            return self.source_at(self.scene)
        if not self.source.is_dir():
            return None
        own = load_settings(self.source).scene
        return own if Path(own.path).exists() else None


def with_fewer_viewpoints(data: bytes, count: int) -> bytes:
    """The file with the first `count` of its viewpoints; 0: without any."""
    from compgs.codec.reader import read_content
    from compgs.codec.writer import write_content

    content = read_content(data)
    if content.viewpoints is None:
        return data
    views = content.viewpoints.views[:count]
    kept = replace(content.viewpoints, views=views) if views else None
    return write_content(replace(content, viewpoints=kept))
