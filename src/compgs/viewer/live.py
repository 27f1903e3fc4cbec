"""A scene in the browser, rendered by this process for each visitor, with its exact view dependence (viser).

    page ──camera, wishes──► Visitor ──job──► Stage ──render──► picture ──► page

viser serves the page and keeps its camera; everything is on this machine, and nothing is loaded from elsewhere.
"""

import contextlib
import io
import socket
import threading
import time
from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from compgs.errors import ConfigError
from compgs.viewer import check_viewer
from compgs.viewer.shown import Shown, focus
from compgs.viewer.stage import Stage
from compgs.viewer.visitor import Lens, Look, Page, Picture, Visitor, lens_of

if TYPE_CHECKING:
    import viser

    from compgs.viewer.controls import Controls

MOVING_QUALITY, FULL_QUALITY = 75, 95  # of the JPEG that a page gets
TELL_SECONDS = 0.25  # between two lines about the picture
# Seconds of a picture at rest while the scene is being trained: at full size it would come too late to be of use.
TRAINING_SECONDS = 0.3


def free_port(host: str, port: int) -> int:
    """The port, or a free one for 0. Raises OSError where none can be listened at: viser would try others for ever."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with socket.socket(family, socket.SOCK_STREAM) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        probe.bind((host, port))
        return int(probe.getsockname()[1])


class LiveViewer:
    """Serves a scene until it is closed. Raises MissingDependency, OSError for an address that is not to be had."""

    def __init__(self, shown: Shown, stage: Stage, *, host: str, port: int, training: bool = False) -> None:
        check_viewer()
        self.shown = shown
        self.stage = stage
        self.training = training
        self.controls: dict[int, Controls] = {}  # by visitor
        port = free_port(host, port)
        with _quiet():
            self.server = _new_server(host, port, shown.title)
        self.host, self.port = host, self.server.get_port()
        self.server.gui.configure_theme(show_logo=False, show_share_button=False, dark_mode=True)
        self._place_camera()
        self.server.on_client_connect(self._welcome)
        self.server.on_client_disconnect(self._part)

    @property
    def address(self) -> str:
        return f"http://{f'[{self.host}]' if ':' in self.host else self.host}:{self.port}/"

    def scene_changed(self, news: str) -> None:
        """Tell all visitors, who get a new picture; `news`: Markdown beside it."""
        for controls in list(self.controls.values()):
            controls.tell_news(news)
            controls.visitor.changed(moving=False)

    def close(self) -> None:
        for controls in list(self.controls.values()):
            controls.close()
        self.stage.close()
        with _quiet():
            self.server.stop()

    def _place_camera(self) -> None:
        """Where visitors begin."""
        camera = self.shown.cameras[0][1].moved(np.array(self.shown.world_offset))
        lens, start = lens_of(camera), self.server.initial_camera
        self.server.scene.set_up_direction(self.shown.up)
        start.position = lens.position
        start.look_at = lens.position + focus(self.shown.positions, camera) * camera.rotation[2]
        start.up = np.array(self.shown.up)
        start.fov = lens.field_of_view

    def _welcome(self, client: "viser.ClientHandle") -> None:
        from compgs.viewer.controls import Controls

        look = Look(len(self.shown.levels) - 1, self.shown.background)
        page = BrowserPage(client)
        visitor = Visitor(page, self.shown, self.stage, look)
        if self.training:
            visitor.resting.seconds = TRAINING_SECONDS
        page.controls = self.controls[client.client_id] = Controls(client, visitor)
        client.camera.on_update(lambda _: visitor.changed())
        threading.Thread(target=visitor.work, name="compgs-visitor", daemon=True).start()

    def _part(self, client: "viser.ClientHandle") -> None:
        controls = self.controls.pop(client.client_id, None)
        if controls is not None:
            controls.close()


class BrowserPage(Page):
    """A browser that viser is connected to."""

    def __init__(self, client: "viser.ClientHandle") -> None:
        self.client = client
        self.controls: Controls | None = None
        self._told = 0.0

    def lens(self) -> Lens:
        camera = self.client.camera
        size = max(1, camera.image_width), max(1, camera.image_height)
        return Lens(camera.position, camera.wxyz, camera.fov, *size)

    def show(self, picture: Picture) -> None:
        quality = FULL_QUALITY if picture.full else MOVING_QUALITY
        self.client.scene.set_background_image(picture.image, format="jpeg", jpeg_quality=quality)
        self.client.flush()
        now = time.monotonic()
        if self.controls is not None and (picture.full or now - self._told > TELL_SECONDS):
            self.controls.tell(picture)
            self._told = now

    def fail(self, message: str) -> None:
        self.client.add_notification("This cannot be shown", message, color="red")


def _new_server(host: str, port: int, label: str) -> "viser.ViserServer":
    import viser

    class Server(viser.ViserServer):
        """Serves without the tunnel to a public address that any visitor could ask for."""

        def request_share_url(self, verbose: bool = True) -> str | None:
            return None

    try:
        return Server(host=host, port=port, label=label, verbose=False)
    except OSError as error:
        raise ConfigError(f"viser cannot be started ({error})") from error


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """viser announces itself; what is to be said the command says."""
    with contextlib.redirect_stdout(io.StringIO()):
        yield
