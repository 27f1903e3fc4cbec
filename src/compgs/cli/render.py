"""`compgs render`: images or a video from a file."""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Annotated, Literal, TypedDict

from tyro.conf import FlagCreatePairsOff, arg

from compgs.cli.command import NO_DEFAULT, DecodingCommand, MemoryOption, SceneFileOrRunArgument, SceneOptions
from compgs.cli.console import say
from compgs.cli.levels import LevelOption
from compgs.cli.progress import counting
from compgs.cli.run_folder import RunSettings, SceneSource, file_and_run
from compgs.cli.scenes import read_scene
from compgs.cli.usage import UsageError, check_range
from compgs.outputs import check_output_file, check_output_folder, filling, write_bytes, write_json
from compgs.words import duration, size

if TYPE_CHECKING:
    import numpy as np

    from compgs.cameras import Camera
    from compgs.render import Renderable
    from compgs.scene import Scene

BLACK = (0.0, 0.0, 0.0)
# Of the way through a scene, and of the circle around it, where nothing else is asked for.
FRAMES = 60
# As many pixels have pictures of another shape.
WIDTH, HEIGHT = 640, 480
UP = (0.0, -1.0, 0.0)
# Of the circle, in the order in which they are tried: the first is taken that keeps clear of what is near.
ELEVATIONS, DISTANCES = (25.0, 40.0, 60.0), (2.2, 1.6, 3.0)
OF_WAY, OF_CIRCLE = ("path", "frames", "width", "height"), ("up", "elevation", "distance")
MAX_SIDE = 16_384  # pixels
# What somebody who names such a file does not want as a folder.
OTHER_MEDIA = (".apng", ".avi", ".jpeg", ".jpg", ".m4v", ".mkv", ".mov", ".mpg", ".png", ".webm")
ANIMATIONS = (".webp", ".gif")
VIDEO_BYTES = 16 << 20  # that must be free for a video; a long one fails later


@dataclass(frozen=True, kw_only=True)
class Render(DecodingCommand, SceneOptions, SceneFileOrRunArgument, LevelOption, MemoryOption):
    """Render images or a video from a file of splats: views of a scene, cameras of a JSON file, or a way through it.

    A camera file is a list of objects with world_to_camera (4 x 4, OpenCV axes), fx, fy, cx, cy, width and
    height; training and evaluation leave one, cameras.json, and `compgs view` records one. The cameras.json of 3DGS,
    transforms.json and the folder of a COLMAP model are read as well. Images are 00000.png, 00001.png, ...; the
    cameras.json beside them says which is which.

    Examples

    compgs render runs/garden -o renders

    compgs render garden.cgs scenes/garden -o renders

    compgs render garden.cgs --cameras runs/garden/cameras.json -o renders

    compgs render garden.cgs --frames 120 --width 960 --height 540 -o garden.mp4

    compgs render garden.cgs --frames 40 --width 320 --fps 15 --label "{bytes}" -o garden.webp

    compgs render garden.cgs --path path.json --frames 300 -o flight.mp4
    """

    output: Annotated[Path, arg(aliases=["-o"], metavar="FOLDER|MP4|WEBP|GIF")]
    """Folder for the images, or one file for all of them: a video, a name that ends in .mp4 (needs `pip install
    '.[video]'` in the project's folder), or an animation, .webp or .gif."""

    background: Annotated[
        tuple[float, float, float] | None, arg(metavar="R G B", help_behavior_hint=NO_DEFAULT)
    ] = None
    """Color behind everything, 0 to 1, in place of the file's own; only .cgs files have one: by default the scene's, or
    black."""

    split: Annotated[Literal["test", "train", "all"] | None, arg(help_behavior_hint="(default: test)")] = None
    """Which views of the scene: held out, trained on, or both."""

    cameras: Annotated[Path | None, arg(metavar="JSON|SCENE", help_behavior_hint=NO_DEFAULT)] = None
    """Camera file, or a capture without its photographs, whose cameras are rendered."""

    frames: Annotated[int | None, arg(metavar="N", help_behavior_hint=f"(default: {FRAMES})")] = None
    """Images of the way through the scene."""

    path: Annotated[
        str | None,
        arg(metavar="cameras|orbit|JSON", help_behavior_hint="(default: cameras, for a file that has them)"),
    ] = None
    """The way: along the cameras that the file keeps, in a circle around the scene, or smoothly through the cameras of
    a camera file, in their order."""

    fps: Annotated[float, arg(metavar="N")] = 30.0
    """Frames per second of a video or animation."""

    width: Annotated[int | None, arg(metavar="PIXELS", help_behavior_hint=NO_DEFAULT)] = None
    """Width of the images of the way. With --width or --height alone, and with neither, they have the shape of the
    capture's; with neither they are about 640 x 480 pixels."""

    height: Annotated[int | None, arg(metavar="PIXELS", help_behavior_hint=NO_DEFAULT)] = None
    """Height of the images of the way."""

    up: Annotated[
        tuple[float, float, float] | None,
        arg(metavar="X Y Z", help_behavior_hint=f"(default: {UP[0]:g} {UP[1]:g} {UP[2]:g})"),
    ] = None
    """Direction of the sky, for the circle."""

    elevation: Annotated[
        float | None, arg(metavar="DEGREES", help_behavior_hint=f"(default: {ELEVATIONS[0]:g})")
    ] = None
    """Height of the circle above the horizon; by default more where it would lead through something."""

    distance: Annotated[
        float | None, arg(metavar="RADII", help_behavior_hint=f"(default: {DISTANCES[0]:g})")
    ] = None
    """Distance of the circle from the middle of the scene; by default another one where it would lead through
    something, or where a file without cameras holds an object that would not be whole in the pictures."""

    label: Annotated[str | None, arg(metavar="TEXT", help_behavior_hint=NO_DEFAULT)] = None
    """Words in the lower left corner of each picture; {bytes} stands for the size of the file."""

    overwrite: FlagCreatePairsOff[bool] = False
    """Replace the video, or the images that are in FOLDER already: all of them, also those beyond the new ones."""

    def run(self) -> None:
        self.check_values()
        from compgs.opening import check_scene, open_scene

        self.allow_memory()
        file, run = file_and_run(self.file)
        check_scene(file)
        self.check_output()
        if self.cameras is not None and (self.scene or self.source):
            raise UsageError("both a scene and --cameras were given; give one")
        source = self.views_source(run)
        self.check_use(source)
        keyframes = self.keyframes()
        self.prepare("decode", "render")
        from compgs.devices import chosen_device

        scene = read_scene(source) if source else None
        views = self.given_views(scene)
        device, background = chosen_device(self.device), scene.background if scene else BLACK
        model = open_scene(file, device, background, self.level)
        if self.background is not None:
            model = model.over(self.background)
        self.render(model, views or self.way(model, keyframes))

    @property
    def video(self) -> bool:
        """Whether all frames become one file."""
        return self.output.suffix.lower() in (".mp4", *ANIMATIONS)

    def check_values(self) -> None:
        """Raises UsageError."""
        self.check_reading()
        for name, low, high in (
            ("frames", 1, 100_000),
            ("width", 1, MAX_SIDE),
            ("height", 1, MAX_SIDE),
            ("elevation", -89, 89),
            ("fps", 1, 240),
        ):
            value = getattr(self, name)
            if value is not None:
                check_range(f"--{name}", value, low, high)
        if self.distance is not None and not 0 < self.distance < float("inf"):
            raise UsageError(f"--distance {self.distance}: expected a finite number above 0")
        if self.up is not None and (not any(self.up) or not all(map(math.isfinite, self.up))):
            raise UsageError(f"--up {' '.join(map(str, self.up))}: expected a direction, not all of it zero")

    def check_use(self, source: SceneSource | None) -> None:
        """Raises UsageError for an option of a way where views are rendered, and the other way round."""
        views = source is not None or self.cameras is not None
        if views and (name := self.first_given(*OF_WAY, *OF_CIRCLE)):
            raise UsageError(
                f"--{name}: of a way through the scene, but its views, or a camera file's, were asked for; leave it "
                "out, or ask for a way alone, as with compgs render FILE --path orbit"
            )
        if self.split is not None and source is None:
            raise UsageError(f"--split {self.split}: of the views of a scene; give the scene, too")

    def pictures(self, like: "Sequence[Camera]") -> "Pictures":
        """How many frames a way has, and their size: of the shape that the cameras' pictures have, where there are
        some and nothing else is asked for.
        """
        shape = like[0].width / like[0].height if like else WIDTH / HEIGHT
        if self.width is None and self.height is None:
            # As many pixels as usual, however long the one side is.
            width = even((WIDTH * HEIGHT * shape) ** 0.5)
            height = even(width / shape)
        else:
            width = self.width or even((self.height or HEIGHT) * shape)
            height = self.height or even(width / shape)
        return {"frames": self.frames or FRAMES, "width": width, "height": height}

    def first_given(self, *options: str) -> str | None:
        """Return the first of these options that was given."""
        return next((name for name in options if getattr(self, name) is not None), None)

    def views_source(self, run: RunSettings | None) -> SceneSource | None:
        """The scene whose views are rendered, if any are: that of a run's folder is read as in training."""
        if run and self.file.is_dir() and self.cameras is None and self.path is None:
            return self.source_of_run(run.scene)
        return self.scene_source() if self.scene or self.source else None

    def check_output(self) -> None:
        """Raises UsageError, OutputError, MissingDependency."""
        if self.output.suffix.lower() in OTHER_MEDIA:
            raise UsageError(
                f"--output {self.output}: expected a folder for PNG images, or a name that ends in .mp4, .webp or .gif"
            )
        if not self.video:
            check_output_folder(self.output, overwrite=self.overwrite)
            return
        from compgs.evaluation.video import check_video

        check_output_file(self.output, overwrite=self.overwrite, needed_bytes=VIDEO_BYTES)
        if self.output.suffix.lower() == ".mp4":
            check_video()

    def keyframes(self) -> "Sequence[Camera]":
        """Read the keyframes of a `--path` that is a file. Raises UsageError, SceneError."""
        if self.path in (None, "cameras", "orbit"):
            return []
        from compgs.evaluation.camera_path import read_cameras

        file = Path(str(self.path))
        if not file.exists():
            raise UsageError(f"--path {self.path}: expected cameras, orbit or a camera file; there is none")
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
        }[self.split or "test"]
        if not chosen:
            raise UsageError(f"--split {self.split}: the scene has no such views")
        return [(view.name, view.camera) for view in chosen]

    def way(self, model: "Renderable", keyframes: "Sequence[Camera]") -> "Sequence[tuple[str, Camera]]":
        """Return a way through the given cameras, along the file's, or in a circle, clear of what is near.

        Raises UsageError.
        """
        from compgs.evaluation.clearance import FreeSpace
        from compgs.evaluation.tour import tour, way_through

        cameras = model.viewpoints
        if self.path == "orbit" or (self.path is None and len(cameras) < 2):
            return self.circle(model)
        if name := self.first_given(*OF_CIRCLE):
            raise UsageError(f"--{name}: of the circle around the scene; give it with --path orbit")
        if keyframes:  # somebody has chosen them: the way is theirs
            way = way_through(keyframes, **self.pictures(keyframes))
            return [(f"path {i}", camera) for i, camera in enumerate(way)]
        if len(cameras) < 2:
            raise UsageError(f"--path cameras: {self.file} keeps {len(cameras)} cameras; use --path orbit")
        space = FreeSpace(model, cameras)
        frames = tour(cameras, **self.pictures(cameras), passable=space.is_passable)
        clear = space.kept_clear([camera for _, camera in frames])
        return [(name, camera) for (name, _), camera in zip(frames, clear, strict=True)]

    def circle(self, model: "Renderable") -> "Sequence[tuple[str, Camera]]":
        from compgs.evaluation.camera_path import distance_of_all
        from compgs.evaluation.clearance import clear_orbit

        pictures, up = self.pictures(model.viewpoints), self.up or UP
        elevations = ELEVATIONS if self.elevation is None else (self.elevation,)
        distances: tuple[float, ...] = DISTANCES if self.distance is None else (self.distance,)
        if self.distance is None and not model.viewpoints:
            # Far away from the cameras of a capture nothing is known; an object without a capture is shown whole.
            size = {"width": pictures["width"], "height": pictures["height"]}
            far = distance_of_all(model.bounds[0], **size, up=up, elevation=elevations[0])
            distances = (far, *(each for each in DISTANCES if each != far))
        return clear_orbit(model, **pictures, up=up, elevations=elevations, distances=distances)

    def render(self, model: "Renderable", views: "Sequence[tuple[str, Camera]]") -> None:
        times: list[float] = []
        with counting("rendering") as progress:
            frames = rendered(model, [camera for _, camera in views], times, progress)
            if self.label:
                frames = self.labelled(frames)
            if self.video:
                self.write_video(frames, views)
            else:
                self.write_images(frames, views)
        say(f"{len(views)} images in {self.output}, {duration(median(times))} a view")

    def labelled(self, frames: "Iterator[np.ndarray]") -> "Iterator[np.ndarray]":
        """Write --label on each frame."""
        from compgs.evaluation.animation import labelled
        from compgs.opening import component_bytes

        file, _ = file_and_run(self.file)
        whole = sum(component_bytes(file).values())  # of all files, if the scene is in several
        text = str(self.label).replace("{bytes}", size(whole))
        return (labelled(frame, text) for frame in frames)

    def write_video(self, frames: "Iterator[np.ndarray]", views: "Sequence[tuple[str, Camera]]") -> None:
        """Raises UsageError, OutputError."""
        from compgs.evaluation.animation import write_animation
        from compgs.evaluation.video import write_video

        sizes = sorted({(camera.width, camera.height) for _, camera in views})
        if len(sizes) > 1:
            found = ", ".join(f"{width} x {height}" for width, height in sizes[:2])
            raise UsageError(f"{self.output}: a video has one size, the views have {found}; name a folder")
        write = write_animation if self.output.suffix.lower() in ANIMATIONS else write_video
        write(self.output, frames, frames_per_second=self.fps)

    def write_images(self, frames: "Iterator[np.ndarray]", views: "Sequence[tuple[str, Camera]]") -> None:
        from compgs.evaluation.camera_path import camera_entry
        from compgs.evaluation.measure import encode_png

        with filling(self.output) as folder:
            for i, image in enumerate(frames):
                write_bytes(folder / f"{i:05d}.png", encode_png(image))
            write_json(folder / "cameras.json", [camera_entry(camera, name) for name, camera in views])


class Pictures(TypedDict):
    """Those of a way."""

    frames: int
    width: int  # pixels
    height: int  # pixels


def even(pixels: float) -> int:
    """Round to an even number, as videos want their sides."""
    return min(MAX_SIDE, max(2, 2 * round(pixels / 2)))


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
