"""`compgs render`: images from a file."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import FlagCreatePairsOff, arg

from compgs.cli.command import NO_DEFAULT, ComputingCommand, SceneFileOrRunArgument, SceneOptions
from compgs.cli.console import duration, say
from compgs.cli.progress import counting
from compgs.cli.run_folder import RunSettings, SceneSource, file_and_run
from compgs.cli.scenes import read_scene
from compgs.cli.usage import UsageError, check_range
from compgs.outputs import check_output_folder, write_bytes, write_json

if TYPE_CHECKING:
    from compgs.cameras import Camera
    from compgs.render import Renderable
    from compgs.scene import Scene

BLACK = (0.0, 0.0, 0.0)
MAX_SIDE = 16_384  # pixels


@dataclass(frozen=True, kw_only=True)
class Render(ComputingCommand, SceneOptions, SceneFileOrRunArgument):
    """Render images from a file of splats: views of a scene, cameras of a JSON file, or a circle around the scene.

    A camera file is a list of objects with world_to_camera (4 x 4, OpenCV axes), fx, fy, cx, cy, width and
    height; training and evaluation leave one, cameras.json. Images are 00000.png, 00001.png, ...; the
    cameras.json beside them says which is which.

    Examples

    compgs render runs/garden -o renders

    compgs render garden.cgs scenes/garden -o renders

    compgs render garden.cgs --cameras runs/garden/cameras.json -o renders

    compgs render garden.cgs --frames 120 --width 960 --height 540 -o orbit
    """

    output: Annotated[Path, arg(aliases=["-o"], metavar="FOLDER")]
    """Folder for the images."""

    background: Annotated[
        tuple[float, float, float] | None, arg(metavar="R G B", help_behavior_hint=NO_DEFAULT)
    ] = None
    """Color behind everything, 0 to 1, in place of the file's own; only .cgs files have one: by default the scene's, or
    black."""

    split: Literal["test", "train", "all"] = "test"
    """Which views of the scene: held out, trained on, or both."""

    cameras: Annotated[Path | None, arg(metavar="JSON", help_behavior_hint=NO_DEFAULT)] = None
    """Camera file to render, instead of a scene."""

    frames: Annotated[int, arg(metavar="N")] = 60
    """Images of the way through the scene."""

    path: Annotated[
        Literal["cameras", "orbit"] | None,
        arg(help_behavior_hint="(default: cameras, for a file that has them)"),
    ] = None
    """The way: along the cameras that the file keeps, or in a circle around the scene."""

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
    """Replace images that are in FOLDER already."""

    def run(self) -> None:
        self.check_values()
        from compgs.formats import check_scene, open_scene

        file, run = file_and_run(self.file)
        check_scene(file)
        check_output_folder(self.output, overwrite=self.overwrite)
        if self.cameras is not None and (self.scene or self.source):
            raise UsageError("both a scene and --cameras were given; give one")
        self.prepare()
        import torch

        source = self.views_source(run)
        scene = read_scene(source) if source else None
        views = self.given_views(scene)
        device = self.device or ("cuda" if torch.cuda.is_available() else "cpu")
        model = open_scene(file, device, scene.background if scene else BLACK)
        if self.background is not None:
            model = model.over(self.background)
        self.render(model, views or self.way(model))

    def check_values(self) -> None:
        """Raises UsageError."""
        self.check_reading()
        check_range("--frames", self.frames, 1, 100_000)
        check_range("--width", self.width, 1, MAX_SIDE)
        check_range("--height", self.height, 1, MAX_SIDE)
        check_range("--elevation", self.elevation, -89, 89)
        if not 0 < self.distance < float("inf"):
            raise UsageError(f"--distance {self.distance}: expected a finite number above 0")
        if not any(self.up) or not all(map(math.isfinite, self.up)):
            raise UsageError(f"--up {' '.join(map(str, self.up))}: expected a direction, not all of it zero")

    def views_source(self, run: RunSettings | None) -> SceneSource | None:
        """The scene whose views are rendered, if any are: that of a run's folder is read as in training."""
        if run and self.file.is_dir() and self.cameras is None and self.path is None:
            return self.source_of_run(run.scene)
        return self.scene_source() if self.scene or self.source else None

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

    def way(self, model: "Renderable") -> "Sequence[tuple[str, Camera]]":
        """Along the file's cameras, or in a circle. Raises UsageError."""
        cameras = model.viewpoints
        if self.path == "orbit" or (self.path is None and len(cameras) < 2):
            return self.circle(model)
        if len(cameras) < 2:
            raise UsageError(f"--path cameras: {self.file} keeps {len(cameras)} cameras; use --path orbit")
        from compgs.evaluation.tour import tour

        return tour(cameras, frames=self.frames, width=self.width, height=self.height)

    def circle(self, model: "Renderable") -> "Sequence[tuple[str, Camera]]":
        import numpy as np

        from compgs.evaluation.camera_path import orbit

        circle = orbit(
            model.bounds[0].cpu().numpy(),
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
        from compgs.evaluation.camera_path import camera_entry
        from compgs.evaluation.measure import encode_png, timed_render

        times: list[float] = []
        with counting("rendering") as progress:
            for i, (_, camera) in enumerate(views):
                image, seconds = timed_render(model, camera)
                write_bytes(self.output / f"{i:05d}.png", encode_png(image))
                times.append(seconds)
                progress(i + 1, len(views))
        write_json(self.output / "cameras.json", [camera_entry(camera, name) for name, camera in views])
        say(f"{len(views)} images in {self.output}, {duration(median(times))} a view")
