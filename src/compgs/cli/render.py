"""`compgs render`: images or a video from a file."""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import FlagCreatePairsOff, arg

from compgs.cli.command import NO_DEFAULT, DecodingCommand, MemoryOption, SceneFileOrRunArgument, SceneOptions
from compgs.cli.console import say
from compgs.cli.progress import counting
from compgs.cli.run_folder import RunSettings, SceneSource, file_and_run
from compgs.cli.scenes import read_scene
from compgs.cli.usage import UsageError, check_range
from compgs.errors import OutputError
from compgs.outputs import check_output_file, check_output_folder, write_bytes, write_json
from compgs.words import duration

if TYPE_CHECKING:
    import numpy as np

    from compgs.cameras import Camera
    from compgs.render import Renderable
    from compgs.scene import Scene

BLACK = (0.0, 0.0, 0.0)
MAX_SIDE = 16_384  # pixels
VIDEO_BYTES = 16 << 20  # that must be free for a video; a long one fails later


@dataclass(frozen=True, kw_only=True)
class Render(DecodingCommand, SceneOptions, SceneFileOrRunArgument, MemoryOption):
    """Render images or a video from a file of splats: views of a scene, cameras of a JSON file, or a way through it.

    A camera file is a list of objects with world_to_camera (4 x 4, OpenCV axes), fx, fy, cx, cy, width and
    height; training and evaluation leave one, cameras.json, and `compgs view` records one. Images are
    00000.png, 00001.png, ...; the cameras.json beside them says which is which.

    Examples

    compgs render runs/garden -o renders

    compgs render garden.cgs scenes/garden -o renders

    compgs render garden.cgs --cameras runs/garden/cameras.json -o renders

    compgs render garden.cgs --frames 120 --width 960 --height 540 -o garden.mp4

    compgs render garden.cgs --path path.json --frames 300 -o flight.mp4
    """

    output: Annotated[Path, arg(aliases=["-o"], metavar="FOLDER|MP4")]
    """Folder for the images, or a video: a name that ends in .mp4 (needs `pip install '.[video]'` in the project's
    folder)."""

    background: Annotated[
        tuple[float, float, float] | None, arg(metavar="R G B", help_behavior_hint=NO_DEFAULT)
    ] = None
    """Color behind everything, 0 to 1, in place of the file's own; only .cgs files have one: by default the scene's, or
    black."""

    split: Literal["test", "train", "all"] = "test"
    """Which views of the scene: held out, trained on, or both."""

    cameras: Annotated[Path | None, arg(metavar="JSON", help_behavior_hint=NO_DEFAULT)] = None
    """Camera file, whose cameras are rendered, instead of a scene."""

    frames: Annotated[int, arg(metavar="N")] = 60
    """Images of the way through the scene."""

    path: Annotated[
        str | None,
        arg(metavar="cameras|orbit|JSON", help_behavior_hint="(default: cameras, for a file that has them)"),
    ] = None
    """The way: along the cameras that the file keeps, in a circle around the scene, or smoothly through the cameras of
    a camera file, in their order."""

    fps: Annotated[float, arg(metavar="N")] = 30.0
    """Frames per second of a video."""

    width: Annotated[int, arg(metavar="PIXELS")] = 640
    """Of the images."""

    height: Annotated[int, arg(metavar="PIXELS")] = 480
    """Of the images."""

    up: Annotated[tuple[float, float, float], arg(metavar="X Y Z")] = (0.0, -1.0, 0.0)
    """Direction of the sky, for the circle."""

    elevation: Annotated[float, arg(metavar="DEGREES")] = 25.0
    """Of the circle, above the horizon."""

    distance: Annotated[float, arg(metavar="RADII")] = 2.2
    """Of the circle from the middle of the scene."""

    overwrite: FlagCreatePairsOff[bool] = False
    """Replace the video, or the images that are in FOLDER already: all of them, also those beyond the new ones."""

    def run(self) -> None:
        self.check_values()
        from compgs.formats import check_scene, open_scene

        self.allow_memory()
        file, run = file_and_run(self.file)
        check_scene(file)
        self.check_output()
        if self.cameras is not None and (self.scene or self.source):
            raise UsageError("both a scene and --cameras were given; give one")
        keyframes = self.keyframes()
        self.prepare("decode", "render")
        from compgs.devices import chosen_device

        source = self.views_source(run)
        scene = read_scene(source) if source else None
        views = self.given_views(scene)
        model = open_scene(file, chosen_device(self.device), scene.background if scene else BLACK)
        if self.background is not None:
            model = model.over(self.background)
        self.render(model, views or self.way(model, keyframes))

    @property
    def video(self) -> bool:
        return self.output.suffix.lower() == ".mp4"

    def check_values(self) -> None:
        """Raises UsageError."""
        self.check_reading()
        check_range("--frames", self.frames, 1, 100_000)
        check_range("--width", self.width, 1, MAX_SIDE)
        check_range("--height", self.height, 1, MAX_SIDE)
        check_range("--elevation", self.elevation, -89, 89)
        check_range("--fps", self.fps, 1, 240)
        if not 0 < self.distance < float("inf"):
            raise UsageError(f"--distance {self.distance}: expected a finite number above 0")
        if not any(self.up) or not all(map(math.isfinite, self.up)):
            raise UsageError(f"--up {' '.join(map(str, self.up))}: expected a direction, not all of it zero")

    def views_source(self, run: RunSettings | None) -> SceneSource | None:
        """The scene whose views are rendered, if any are: that of a run's folder is read as in training."""
        if run and self.file.is_dir() and self.cameras is None and self.path is None:
            return self.source_of_run(run.scene)
        return self.scene_source() if self.scene or self.source else None

    def check_output(self) -> None:
        """Raises OutputError, MissingDependency."""
        if not self.video:
            check_output_folder(self.output, overwrite=self.overwrite)
            return
        from compgs.evaluation.video import check_video

        check_output_file(self.output, overwrite=self.overwrite, needed_bytes=VIDEO_BYTES)
        check_video()

    def keyframes(self) -> "Sequence[Camera]":
        """Of a `--path` that is a file. Raises UsageError, SceneError."""
        if self.path in (None, "cameras", "orbit"):
            return []
        from compgs.evaluation.camera_path import read_cameras

        file = Path(str(self.path))
        if not file.is_file():
            raise UsageError(f"--path {self.path}: expected cameras, orbit or a camera file; there is none")
        if self.cameras is not None or self.scene or self.source:
            raise UsageError("--path is a way of its own; leave out the scene and --cameras")
        keyframes = [camera for _, camera in read_cameras(file)]
        if len(keyframes) < 2:
            raise UsageError(f"--path {self.path}: a way needs two cameras at least, found {len(keyframes)}")
        return keyframes

    def given_views(self, scene: "Scene | None") -> "Sequence[tuple[str, Camera]]":
        """Names and cameras of the scene or camera file; none if neither was given."""
        if self.cameras is not None:
            from compgs.evaluation.camera_path import read_cameras

            return read_cameras(self.cameras)
        if scene is None:
            return []
        chosen = {
            "test": scene.test_views,
            "train": scene.train_views,
            "all": (*scene.train_views, *scene.test_views),
        }[self.split]
        if not chosen:
            raise UsageError(f"--split {self.split}: the scene has no such views")
        return [(view.name, view.camera) for view in chosen]

    def way(self, model: "Renderable", keyframes: "Sequence[Camera]") -> "Sequence[tuple[str, Camera]]":
        """Through the given cameras, along the file's, or in a circle. Raises UsageError."""
        from compgs.evaluation.tour import tour, way_through

        if keyframes:
            way = way_through(keyframes, frames=self.frames, width=self.width, height=self.height)
            return [(f"path {i}", camera) for i, camera in enumerate(way)]
        cameras = model.viewpoints
        if self.path == "orbit" or (self.path is None and len(cameras) < 2):
            return self.circle(model)
        if len(cameras) < 2:
            raise UsageError(f"--path cameras: {self.file} keeps {len(cameras)} cameras; use --path orbit")
        return tour(cameras, frames=self.frames, width=self.width, height=self.height)

    def circle(self, model: "Renderable") -> "Sequence[tuple[str, Camera]]":
        import numpy as np

        from compgs.evaluation.camera_path import orbit

        circle = orbit(
            model.bounds[0],
            frames=self.frames,
            width=self.width,
            height=self.height,
            up=self.up,
            elevation=self.elevation,
            distance=self.distance,
        )
        # Around the model's own frame; cameras are given in the world's.
        return [(name, camera.moved(-np.array(model.world_offset))) for name, camera in circle]

    def render(self, model: "Renderable", views: "Sequence[tuple[str, Camera]]") -> None:
        times: list[float] = []
        with counting("rendering") as progress:
            frames = rendered(model, [camera for _, camera in views], times, progress)
            if self.video:
                self.write_video(frames, views)
            else:
                self.write_images(frames, views)
        say(f"{len(views)} images in {self.output}, {duration(median(times))} a view")

    def write_video(self, frames: "Iterator[np.ndarray]", views: "Sequence[tuple[str, Camera]]") -> None:
        """Raises UsageError, OutputError."""
        from compgs.evaluation.video import write_video

        sizes = sorted({(camera.width, camera.height) for _, camera in views})
        if len(sizes) > 1:
            found = ", ".join(f"{width} x {height}" for width, height in sizes[:2])
            raise UsageError(f"{self.output}: a video has one size, the views have {found}; name a folder")
        write_video(self.output, frames, frames_per_second=self.fps)

    def write_images(self, frames: "Iterator[np.ndarray]", views: "Sequence[tuple[str, Camera]]") -> None:
        from compgs.evaluation.camera_path import camera_entry
        from compgs.evaluation.measure import encode_png

        for i, image in enumerate(frames):
            if i == 0:  # now that there is something to take their place
                remove_images(self.output)
            write_bytes(self.output / f"{i:05d}.png", encode_png(image))
        write_json(self.output / "cameras.json", [camera_entry(camera, name) for name, camera in views])


def rendered(
    model: "Renderable",
    cameras: "Sequence[Camera]",
    times: list[float],  # gets the seconds of each view
    progress: "Callable[[int, int], None]",
) -> "Iterator[np.ndarray]":
    """Images [H, W, 3] uint8, one after the other."""
    from compgs.evaluation.measure import timed_render

    for i, camera in enumerate(cameras):
        image, seconds = timed_render(model, camera)
        times.append(seconds)
        yield image
        progress(i + 1, len(cameras))


def remove_images(folder: Path) -> None:
    """Those of an earlier rendering, and the file that says what they are. Raises OutputError."""
    try:
        for old in (*folder.glob("[0-9][0-9][0-9][0-9][0-9].png"), folder / "cameras.json"):
            old.unlink(missing_ok=True)
    except OSError as error:
        raise OutputError(f"{folder}: old images cannot be removed ({error.strerror})") from error
