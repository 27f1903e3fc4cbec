"""The panel beside a visitor's picture: what can be set, shown, jumped to, recorded and saved.

Files come as downloads of the browser: visitors write nothing on the machine that renders.
"""

import functools
import math
import threading
import time
from collections.abc import Callable
from concurrent.futures import CancelledError
from pathlib import PurePath
from typing import TYPE_CHECKING, Any

import numpy as np

from compgs.cameras import Camera
from compgs.errors import CompGSError
from compgs.evaluation.measure import encode_png
from compgs.viewer import overlays
from compgs.viewer.camera_paths import CameraPath, filmed
from compgs.viewer.shown import focus, radius
from compgs.viewer.visitor import Lens, Picture, Visitor, lens_of

if TYPE_CHECKING:
    import viser

ACCENT = (255, 140, 0)  # points and frustums
LEAST_DEGREES, MOST_DEGREES = 5.0, 120.0  # of the field of view
PREVIEW_RATE = 20  # camera positions a second
SIZES = {
    "640 x 480": (640, 480),
    "960 x 540": (960, 540),
    "1280 x 720": (1280, 720),
    "1920 x 1080": (1920, 1080),
}
ELLIPSOIDS, CAMERAS = "Ellipsoids", "Camera positions"  # of the overlays
MOST_ELLIPSOIDS = 20_000
MOST_LABELS = 40  # cameras in the list to choose from


class Stopped(Exception):
    """The visitor does not want the film any more, or has gone."""


class Controls:
    """Holds the controls of one visitor."""

    def __init__(self, client: "viser.ClientHandle", visitor: Visitor) -> None:
        self.client = client
        self.visitor = visitor
        self.shown = visitor.shown
        self.path = CameraPath()
        self._filming = threading.Event()
        self._nodes: dict[str, list[Any]] = {}  # of the scene, by what they show
        gui = client.gui
        self.news = gui.add_markdown("")
        self.facts = gui.add_markdown(
            "The first picture is on its way. The first one ever compiles the renderer."
        )
        with gui.add_folder("Picture"):
            self._add_picture()
        with gui.add_folder("Show"):
            self._add_overlays()
        with gui.add_folder("Cameras"):
            self._add_cameras()
        with gui.add_folder("Camera path", expand_by_default=False):
            self._add_path()
        client.camera.on_update(lambda _: self._record())

    def close(self) -> None:
        """The visitor has gone."""
        self._filming.clear()
        self.visitor.close()

    # what is told ------------------------------------------------------------------------------------------------

    def tell(self, picture: Picture) -> None:
        """Facts of the picture that was sent."""
        height, width = picture.image.shape[:2]
        there = ", ".join(f"{count:,} {name.replace('_', ' ')}" for name, count in picture.counts.items())
        self.facts.content = (
            f"{there}  \n{picture.drawn:,} drawn, {width} x {height} pixels in {1e3 * picture.seconds:.0f} ms"
        )

    def tell_news(self, news: str) -> None:
        self.news.content = news

    def notify(self, title: str, body: str, *, failed: bool = False) -> None:
        self.client.add_notification(
            title, body, color="red" if failed else "teal", auto_close_seconds=None if failed else 4.0
        )

    # the picture ---------------------------------------------------------------------------------------------------

    def _add_picture(self) -> None:
        gui, visitor = self.client.gui, self.visitor
        degrees = math.degrees(lens_of(self.shown.cameras[0][1]).field_of_view)
        degrees = round(min(max(degrees, LEAST_DEGREES), MOST_DEGREES), 1)
        hint = "Degrees, of the height"
        fov = gui.add_slider("Field of view", LEAST_DEGREES, MOST_DEGREES, 0.5, degrees, hint=hint)
        fov.on_update(lambda _: self._set_field_of_view(math.radians(fov.value)))
        share = gui.add_slider("Resolution", 0.1, 1.0, 0.05, 1.0, hint="At rest, of the window's")
        share.on_update(lambda _: visitor.wish(share=share.value))
        red, green, blue = (round(255 * part) for part in self.shown.background)
        background = gui.add_rgb("Background", (red, green, blue))
        background.on_update(
            lambda _: visitor.wish(background=tuple(part / 255 for part in background.value))
        )
        levels = self.shown.levels
        if len(levels) > 1:
            detail = gui.add_slider(
                "Detail",
                1,
                len(levels),
                1,
                len(levels),
                hint="How much of the file is decoded, from its beginning",
            )
            words = gui.add_markdown(levels[-1])

            @detail.on_update
            def _(_: object) -> None:
                words.content = levels[detail.value - 1]
                visitor.wish(level=detail.value - 1)
                self._refresh()

        screenshot = gui.add_button(
            "Screenshot", hint="A PNG of this view at the window's size, without overlays"
        )
        screenshot.on_click(lambda _: self._trying("The screenshot failed", self._screenshot))

    def _set_field_of_view(self, radians: float) -> None:
        self.client.camera.fov = radians
        self.visitor.changed()

    def _screenshot(self) -> None:
        image = self.visitor.image(self.visitor.in_world(self.lens().camera()))
        self._download(f"{self._stem()}.png", encode_png(image))

    # overlays ------------------------------------------------------------------------------------------------------

    def _add_overlays(self) -> None:
        gui = self.client.gui
        shows: dict[str, tuple[str, Callable[[], list[Any]]]] = {
            "Anchors": ("As points, over the picture", self._points),
            ELLIPSOIDS: (
                "The primitives that cover most of this view, of one standard deviation",
                self._ellipsoids,
            ),
            CAMERAS: ("Click one to see what it saw", self._frustums),
        }
        self._makers: dict[str, Callable[[], list[Any]]] = {}
        boxes = {}
        for name, (hint, make) in shows.items():
            boxes[name] = box = gui.add_checkbox(name, False, hint=hint)
            self._makers[name] = make
            box.on_update(functools.partial(self._toggle, name, box))
        self.most = gui.add_slider("How many", 100, MOST_ELLIPSOIDS, 100, 2000, hint="Ellipsoids, at most")
        self.most.on_update(functools.partial(self._toggle, ELLIPSOIDS, boxes[ELLIPSOIDS]))

    def _toggle(self, name: str, box: Any, _: object = None) -> None:
        for node in self._nodes.pop(name, []):
            node.remove()
        if box.value:
            self._draw_over(name)

    def _refresh(self) -> None:
        """Overlays of another scene; a node takes the place of the one of its name."""
        for name in self._nodes.keys() - {CAMERAS}:
            self._draw_over(name)

    def _draw_over(self, name: str) -> None:
        self._trying(f"{name} cannot be shown", lambda: self._nodes.update({name: self._makers[name]()}))

    def _points(self) -> list[Any]:
        visitor = self.visitor

        def job() -> np.ndarray:
            return overlays.anchor_points(self.shown.model(visitor.look.level, fresh=True))

        points = visitor.stage.run(job)
        size = overlays.POINT_SHARE * radius(points)
        node = self.client.scene.add_point_cloud(
            "/anchors",
            points,
            ACCENT,
            point_size=size,
            precision="float32",
            point_shape="circle",
            point_shading="flat",
        )
        return [node]

    def _ellipsoids(self) -> list[Any]:
        visitor, camera = self.visitor, self.visitor.in_world(self.lens().camera())

        def job() -> overlays.Ellipsoids:
            model = self.shown.model(visitor.look.level, fresh=True)
            return overlays.ellipsoids(model, camera, int(self.most.value))

        found = visitor.stage.run(job)
        vertices, faces = overlays.sphere()
        node = self.client.scene.add_batched_meshes_simple(
            "/ellipsoids",
            vertices,
            faces,
            batched_wxyzs=found.quaternions,
            batched_positions=found.means,
            batched_scales=found.radii,
            batched_colors=found.colors,
            lod="off",
            cast_shadow=False,
            receive_shadow=False,
        )
        return [node]

    def _frustums(self) -> list[Any]:
        frame = [(name, self.visitor.in_frame(camera)) for name, camera in self.shown.cameras]
        chosen = overlays.shown_cameras(frame)
        length = radius(self.shown.positions) * overlays.FRUSTUM_SHARE
        nodes = []
        for i, (_, camera) in enumerate(chosen):
            lens = lens_of(camera)
            node = self.client.scene.add_camera_frustum(
                f"/cameras/{i}",
                fov=lens.field_of_view,
                aspect=camera.width / camera.height,
                scale=length,
                thickness=0.03 * length,
                color=ACCENT,
                wxyz=lens.quaternion,
                position=lens.position,
            )
            node.on_click(functools.partial(self._jump, camera))
            nodes.append(node)
        return nodes

    # cameras -------------------------------------------------------------------------------------------------------

    def _add_cameras(self) -> None:
        gui, cameras = self.client.gui, dict(overlays.shown_cameras(self.shown.cameras)[:MOST_LABELS])
        choice = gui.add_dropdown("From", tuple(cameras), hint="Look from one of the scene's cameras")
        choice.on_update(lambda _: self._jump(self.visitor.in_frame(cameras[choice.value])))
        start = gui.add_button("To the start")
        start.on_click(lambda _: self._jump(self.visitor.in_frame(self.shown.cameras[0][1])))

    def lens(self) -> Lens:
        return self.visitor.page.lens()

    def _jump(self, camera: Camera, _: object = None) -> None:
        """The page's camera to a camera of the local frame."""
        page = self.lens()
        self._place(lens_of(camera, page.width / page.height), focus(self.shown.positions, camera))
        self.visitor.changed()

    def _place(self, lens: Lens, distance: float) -> None:
        """`distance`: to what the camera is to go around."""
        camera, ahead = self.client.camera, lens.camera().rotation[2]
        with self.client.atomic():
            camera.position = lens.position
            camera.look_at = lens.position + distance * ahead
            camera.wxyz = lens.quaternion
            camera.fov = lens.field_of_view

    # the path ------------------------------------------------------------------------------------------------------

    def _add_path(self) -> None:
        gui = self.client.gui
        self.views = gui.add_markdown("")
        gui.add_button("Add this view").on_click(lambda _: self._edit(lambda: self.path.add(self._camera())))
        self.recording = gui.add_checkbox(
            "Record flight", False, hint="Adds a view every half second while you move"
        )
        gui.add_button("Remove the last").on_click(lambda _: self._edit(self.path.remove_last))
        gui.add_button("Remove all").on_click(lambda _: self._edit(self.path.clear))
        self.seconds = gui.add_slider("Seconds", 1.0, 120.0, 0.5, 10.0)
        self.rate = gui.add_slider("Frames a second", 10, 60, 1, 30)
        self.size = gui.add_dropdown("Size", tuple(SIZES), initial_value="960 x 540")
        actions = {"Preview": self._preview, "Render video": self._film, "Save path": self._save}
        for label, action in actions.items():
            gui.add_button(label).on_click(functools.partial(self._on_path, action))
        load = gui.add_upload_button("Load path", mime_type="application/json")
        load.on_upload(
            lambda _: self._trying("No path", lambda: self._load(load.value.name, load.value.content))
        )
        self.stop = gui.add_button("Stop", visible=False)
        self.stop.on_click(lambda _: self._filming.clear())
        self.bar: Any = gui.add_progress_bar(0.0, visible=False)
        self._edit(lambda: None)

    def _camera(self) -> Camera:
        """Return a camera of the world, as the page's is now."""
        return self.visitor.in_world(self.lens().camera())

    def _edit(self, change: Callable[[], object]) -> None:
        change()
        count = len(self.path.views)
        self.views.content = f"{count} view{'' if count == 1 else 's'}"

    def _record(self) -> None:
        if self.recording.value and not self._filming.is_set():
            self._edit(lambda: self.path.record(self._camera(), time.monotonic()))

    def _on_path(self, action: Callable[[], None], _: object = None) -> None:
        if self._filming.is_set():
            return
        self._filming.set()
        self.stop.visible = True
        try:
            self._trying("The path cannot be used", action)
        finally:
            self._filming.clear()
            self.stop.visible = self.bar.visible = False

    def _preview(self) -> None:
        page = self.lens()
        for camera in self.path.frames(round(self.seconds.value * PREVIEW_RATE), page.width, page.height):
            if not self._filming.is_set():
                return
            local = self.visitor.in_frame(camera)
            self._place(lens_of(local), focus(self.shown.positions, local))
            time.sleep(1 / PREVIEW_RATE)

    def _film(self) -> None:
        width, height = SIZES[self.size.value]
        cameras = self.path.frames(round(self.seconds.value * self.rate.value), width, height)
        self.bar.visible = True

        def progress(done: int, total: int) -> None:
            self.bar.value = 100.0 * done / total
            if not self._filming.is_set():
                raise Stopped

        self._download(*filmed(cameras, self.visitor.image, self._stem(), self.rate.value, progress))

    def _save(self) -> None:
        self._download(f"{self._stem()}-path.json", self.path.content())

    def _load(self, name: str, content: bytes) -> None:
        loaded = CameraPath.of(content, name)
        self._edit(lambda: setattr(self, "path", loaded))

    # all of them ---------------------------------------------------------------------------------------------------

    def _stem(self) -> str:
        return PurePath(self.shown.title).stem or "scene"

    def _download(self, name: str, content: bytes) -> None:
        self.client.send_file_download(name, content, save_immediately=True)

    def _trying(self, failure: str, action: Callable[[], object]) -> None:
        """What goes wrong is said beside the picture."""
        try:
            action()
        except Stopped:
            self.notify("Stopped", "Nothing was kept.")
        except CancelledError:
            pass  # the viewer ends
        except (CompGSError, MemoryError) as error:
            self.notify(failure, str(error) or "not enough memory", failed=True)
