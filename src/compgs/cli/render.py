"""`compgs render`: images from a file."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import FlagCreatePairsOff, arg

from compgs.cli.command import NO_DEFAULT, ComputingCommand, SceneFileArgument, SceneOptions, UsageError
from compgs.cli.console import duration, say
from compgs.cli.inputs import check_scene_file
from compgs.cli.progress import counting
from compgs.cli.scenes import read_scene
from compgs.outputs import check_output_folder, write_bytes, write_json

if TYPE_CHECKING:
    from compgs.cameras import Camera
    from compgs.evaluation.scene_file import SceneModel
    from compgs.scene import Scene

BLACK = (0.0, 0.0, 0.0)


@dataclass(frozen=True, kw_only=True)
class Render(ComputingCommand, SceneOptions, SceneFileArgument):
    """Render images from a .cgs or .ply file: views of a scene, cameras of a JSON file, or a circle around the scene.

    A camera file is a list of objects with world_to_camera (4 x 4, OpenCV axes), fx, fy, cx, cy, width and
    height; training and evaluation leave one, cameras.json. Images are 00000.png, 00001.png, ...; the
    cameras.json beside them says which is which.

    Examples

    compgs render garden.cgs scenes/garden -o renders

    compgs render garden.cgs --cameras runs/garden/cameras.json -o renders

    compgs render garden.cgs --frames 120 --width 960 --height 540 -o orbit
    """

    output: Annotated[Path, arg(aliases=["-o"], metavar="FOLDER")]
    """Folder for the images."""

    split: Literal["test", "train", "all"] = "test"
    """Which views of the scene: held out, trained on, or both."""

    cameras: Annotated[Path | None, arg(metavar="JSON", help_behavior_hint=NO_DEFAULT)] = None
    """Camera file to render, instead of a scene."""

    frames: Annotated[int, arg(metavar="N")] = 60
    """Images of the circle."""

    width: Annotated[int, arg(metavar="PIXELS")] = 640
    """Of the circle's images."""

    height: Annotated[int, arg(metavar="PIXELS")] = 480
    """Of the circle's images."""

    up: tuple[float, float, float] = (0.0, -1.0, 0.0)
    """Direction of the sky, for the circle."""

    elevation: Annotated[float, arg(metavar="DEGREES")] = 25.0
    """Of the circle, above the horizon."""

    distance: Annotated[float, arg(metavar="RADII")] = 2.2
    """Of the circle from the middle of the scene."""

    overwrite: FlagCreatePairsOff[bool] = False
    """Replace images that are in FOLDER already."""

    def run(self) -> None:
        check_scene_file(self.file)
        check_output_folder(self.output, overwrite=self.overwrite)
        if self.cameras is not None and (self.scene or self.source):
            raise UsageError("both a scene and --cameras were given; give one")
        if (
            not 1 <= self.frames <= 100_000
            or not 1 <= min(self.width, self.height) <= max(self.width, self.height) <= 16_384
        ):
            raise UsageError("--frames must be 1 to 100000, --width and --height 1 to 16384")
        if not -89 <= self.elevation <= 89 or not 0 < self.distance < float("inf"):
            raise UsageError("--elevation must be -89 to 89 degrees, --distance above 0")
        self.prepare()
        import torch

        from compgs.evaluation.scene_file import open_scene_file

        scene = read_scene(self.scene_source()) if self.scene or self.source else None
        views = self.given_views(scene)
        # Of .ply files alone: a .cgs file has its own.
        background = scene.background if scene else self.background or BLACK
        device = self.device or ("cuda" if torch.cuda.is_available() else "cpu")
        model = open_scene_file(self.file, device, background)
        self.render(model, views or self.circle(model))

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

    def circle(self, model: "SceneModel") -> "Sequence[tuple[str, Camera]]":
        from compgs.evaluation.camera_path import orbit

        return orbit(
            model.bounds[0].cpu().numpy(),
            frames=self.frames,
            width=self.width,
            height=self.height,
            up=self.up,
            elevation=self.elevation,
            distance=self.distance,
        )

    def render(self, model: "SceneModel", views: "Sequence[tuple[str, Camera]]") -> None:
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
