"""The viewer in a headless Chromium: the page shows what the renderer does, follows the mouse, and stays at home."""

from collections.abc import Iterator
from dataclasses import dataclass
from urllib.parse import urlsplit

import numpy as np
import pytest

import compgs
from compgs.metrics import psnr, to_8bit
from compgs.render import RasterSettings

from .devtools import Page, tab, until

viser = pytest.importorskip("viser")
from compgs.viewer.controls import Controls  # noqa: E402
from compgs.viewer.live import LiveViewer  # noqa: E402
from compgs.viewer.shown import FileShown  # noqa: E402
from compgs.viewer.stage import OwnThread  # noqa: E402

pytestmark = pytest.mark.slow
LEAST_DB = 35.0
WIDTH, HEIGHT = 900, 560
# Beside the panel on the right, and below what the page says about its software WebGL: 150 to 190 pixels and their
# shadow, as the machine's fonts break the lines.
FREE = slice(240, HEIGHT), slice(0, 540)


@dataclass(frozen=True)
class Visit:
    viewer: LiveViewer
    page: Page
    controls: Controls

    def expected(self, share: float = 1.0) -> np.ndarray:
        """The renderer's picture for the page's camera."""
        visitor = self.controls.visitor
        model = visitor.shown.model(visitor.look.level, fresh=True)
        camera = visitor.in_world(self.controls.lens().camera(share))
        return to_8bit(compgs.render(model, camera, RasterSettings(background=visitor.look.background)).image)

    def agrees(self) -> float | None:
        """PSNR of the free part of the window, once it is good enough."""
        found = psnr(
            np.ascontiguousarray(self.page.picture()[FREE]), np.ascontiguousarray(self.expected()[FREE])
        )
        return found if found >= LEAST_DB else None


@pytest.fixture(scope="module")
def visit(browser: str, cgs_bytes: bytes, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Visit]:
    folder = tmp_path_factory.mktemp("live")
    (folder / "scene.cgs").write_bytes(cgs_bytes)
    viewer = LiveViewer(FileShown(folder / "scene.cgs", "cpu"), OwnThread(), host="127.0.0.1", port=0)
    try:
        with tab(browser, folder / "browser", WIDTH, HEIGHT) as page:
            page.open(f"{viewer.address}?fixedDpr=1")  # software WebGL is slow, and would get fewer pixels
            controls = until(lambda: next(iter(viewer.controls.values()), None), "a visitor")
            # kernels may have to be compiled
            until(lambda: "drawn" in controls.facts.content, "a picture", 300)
            yield Visit(viewer, page, controls)
    finally:
        viewer.close()


def test_the_page_shows_what_the_renderer_does(visit: Visit) -> None:
    until(visit.agrees, f"the page shows the renderer's picture, {LEAST_DB} dB")
    assert visit.expected().shape == (HEIGHT, WIDTH, 3)
    assert visit.expected()[FREE].std() > 10  # something is there to see
    facts = visit.controls.facts.content
    assert "100 anchors, 400 coupled primitives" in facts and f"{WIDTH} x {HEIGHT} pixels" in facts


def test_a_drag_turns_the_camera_and_the_picture_follows(visit: Visit) -> None:
    before, shown = visit.controls.lens(), visit.expected()
    visit.page.drag((200, 300), (330, 340))
    until(
        lambda: not np.allclose(visit.controls.lens().position, before.position, atol=0.1), "another camera"
    )
    assert psnr(shown, visit.expected()) < 25
    until(visit.agrees, "the page shows what is to be seen from there")


def test_a_jump_to_a_camera_shows_what_it_saw(visit: Visit) -> None:
    _, camera = visit.controls.shown.cameras[3]
    visit.controls._jump(camera)
    until(lambda: np.allclose(visit.controls.lens().position, camera.center, atol=1e-4), "the camera's place")
    lens = visit.controls.lens()
    np.testing.assert_allclose(lens.camera().rotation, camera.rotation, atol=1e-3)
    until(visit.agrees, "the page shows what is to be seen from there")


def test_the_field_of_view_and_the_background_are_the_visitor_s(visit: Visit) -> None:
    visit.controls._set_field_of_view(1.4)
    visit.controls.visitor.wish(background=(1.0, 1.0, 1.0))
    until(lambda: abs(visit.controls.lens().field_of_view - 1.4) < 1e-6, "another field of view")
    until(visit.agrees, "the page shows it")
    assert visit.page.picture()[400, 20].min() > 240


def test_overlays_are_drawn_over_the_picture_and_go_again(visit: Visit) -> None:
    until(visit.agrees, "the picture without")
    before = visit.page.picture()[FREE].astype(int)
    visit.controls._draw_over("Anchors")
    until(lambda: (abs(visit.page.picture()[FREE] - before).max(2) > 50).sum() > 20, "points")
    for name in ("Ellipsoids", "Camera positions"):
        visit.controls._draw_over(name)
        assert visit.controls._nodes[name]
    for name in list(visit.controls._nodes):
        for node in visit.controls._nodes.pop(name):
            node.remove()
    until(visit.agrees, "the picture without")


def test_nothing_is_loaded_from_elsewhere(visit: Visit) -> None:
    """And nothing could be: the browser finds no other machine (`tab`), also in its workers."""
    visit.page.picture()
    addresses = [address.removeprefix("blob:") for address in visit.page.requests]
    assert {urlsplit(each).hostname for each in addresses if not each.startswith("data:")} == {"127.0.0.1"}


def test_no_visitor_can_ask_for_a_public_address(visit: Visit) -> None:
    assert visit.viewer.server.request_share_url() is None


def test_a_visitor_who_leaves_is_forgotten(visit: Visit) -> None:
    visit.page.open("about:blank")
    until(lambda: not visit.viewer.controls, "nobody there")
    until(lambda: not visit.controls.visitor.wait(), "its thread may end")
