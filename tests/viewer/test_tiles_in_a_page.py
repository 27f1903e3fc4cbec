"""A scene of tiles in the page: its picture is the renderer's, within the cap, and nothing is fetched twice."""

import re
import threading
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import partial
from http.server import ThreadingHTTPServer
from pathlib import Path

import numpy as np
import pytest

import compgs
from compgs.cameras import Camera
from compgs.codec.reader import read_content
from compgs.codec.writer import write_content
from compgs.formats.tiled import read_manifest
from compgs.formats.tiled_scene import TiledScene, open_tiles
from compgs.formats.tiled_writer import NewTile, write_tiles
from compgs.metrics import psnr, to_8bit
from compgs.ordering.order import canonical_order, level_counts
from compgs.viewer.gallery import GalleryHandler
from compgs.viewer.thumbnails import Thumbnails

from .devtools import Page, tab, until
from .test_picture import CONTENTS, looking, written

pytestmark = pytest.mark.slow
SIDE = 3  # tiles of the town
LEAST_DB = 35.0
WIDTH, HEIGHT = 320, 240
SHOW = """window.shown = null;
compgsViewer.show(%s).then(() => (window.shown = compgsViewer.info.coupled));"""


@dataclass
class Town:
    """`asked`: first and last byte of each request, by the name of the file."""

    model: TiledScene
    pitch: float
    asked: dict[str, list[tuple[int, int]]] = field(default_factory=dict)
    address: str = ""

    def camera(self, i: float, j: float, height: float = 1.0) -> Camera:
        """Above a place between the tiles, looking on along the diagonal."""
        place = np.array((i, 0.0, j)) * self.pitch + self.middle
        eye = place - np.array((0, height * self.pitch, 0))
        camera = looking(eye, place + self.pitch * np.array((1.0, 0.2, 1.0)))
        return replace(camera, fx=200.0, fy=200.0, cx=WIDTH / 2, cy=HEIGHT / 2, width=WIDTH, height=HEIGHT)

    @property
    def middle(self) -> np.ndarray:
        tile = self.model.manifest.tiles[0]
        return np.array(tile.spheres[:, :3].mean(0)) + np.array(self.model.world_offset)


@pytest.fixture
def town(tmp_path: Path) -> Iterator[Town]:
    """Tiles that go from coarse to fine, and a server that writes down what it is asked for."""
    content = read_content(written(CONTENTS["dilated"]))
    counts = level_counts(content.coordinates[canonical_order(content.coordinates)])
    levels = [i for i, count in enumerate(counts) if i == 0 or count > counts[i - 1]]
    levels[-1] = len(counts) - 1
    pitch = float(np.ptp(content.coordinates, axis=0).max()) * content.voxel_size
    tiles = [
        NewTile(
            f"{i}_{j}",
            write_content(replace(content, world_offset=(i * pitch, 0.0, j * pitch)), levels=levels),
        )
        for i in range(SIDE)
        for j in range(SIDE)
    ]
    manifest = write_tiles(tmp_path / "scenes" / "town.tiles", tiles)
    town = Town(open_tiles(manifest), pitch)

    class Watched(GalleryHandler):
        def do_GET(self) -> None:
            name = self.path.rpartition("/")[2]
            if name.endswith(".cgs"):
                found = re.fullmatch(r"bytes=(\d+)-(\d+)", self.headers.get("Range", ""))
                size = (manifest.parent / name).stat().st_size
                asked = (int(found[1]), int(found[2])) if found else (0, size - 1)
                town.asked.setdefault(name, []).append(asked)
            super().do_GET()

    handler = partial(Watched, (tmp_path / "scenes").resolve(), Thumbnails())
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        town.address = f"http://127.0.0.1:{server.server_port}/view?url=/files/town.tiles/manifest.json"
        yield town
        server.shutdown()


def show(page: Page, camera: Camera) -> tuple[np.ndarray, int]:
    """The page's picture of a camera, when it is sharp, and how many splats it holds."""
    lens = ", ".join(
        f"{name}: {getattr(camera, name)}" for name in ("width", "height", "fx", "fy", "cx", "cy")
    )
    pose = camera.world_to_camera.ravel().tolist()
    page.ask(SHOW % f"{{ {lens}, worldToCamera: {pose} }}")
    splats = until(lambda: page.ask("window.shown"), "a sharp picture", 240)
    page.ask(
        f"copy = new OffscreenCanvas({WIDTH}, {HEIGHT}).getContext('2d');"
        "copy.drawImage(compgsViewer.canvas, 0, 0);"
        f"window.pixels = [...copy.getImageData(0, 0, {WIDTH}, {HEIGHT}).data]; 0"
    )
    pixels = np.array(page.ask("window.pixels"), np.uint8).reshape(HEIGHT, WIDTH, 4)
    return np.ascontiguousarray(pixels[:, :, :3]), splats


def check_nothing_twice(town: Town) -> None:
    for name, parts in town.asked.items():
        end = 0
        for first, last in sorted(parts):
            assert first == end, f"{name}: {parts}"
            end = last + 1


def test_tiles_are_fetched_as_they_are_looked_at_and_their_picture_is_the_renderers(
    town: Town, browser: str, tmp_path: Path
) -> None:
    with tab(browser, tmp_path / "browser", WIDTH, HEIGHT) as page:
        page.open(town.address + "&renderer=webgl2")
        until(lambda: page.ask("Boolean(window.compgsViewer?.info)"), "the scene")
        for place in ((1.2, 1.2), (0.0, 0.0)):
            camera = town.camera(*place)
            picture, _ = show(page, camera)
            expected = to_8bit(compgs.render(town.model, camera).image)
            assert expected.std() > 10
            assert psnr(picture, expected) >= LEAST_DB
        assert page.ask("document.getElementById('error-text').textContent") == ""
        before = sum(map(len, town.asked.values()))
        show(page, town.camera(1.2, 1.2))
        assert sum(map(len, town.asked.values())) == before
    check_nothing_twice(town)


def test_a_walk_with_a_cap_never_holds_more_splats_and_shows_what_is_near(
    town: Town, browser: str, tmp_path: Path
) -> None:
    tiles = read_manifest(tmp_path / "scenes" / "town.tiles" / "manifest.json").tiles
    most = 3 * tiles[0].coupled_primitives
    with tab(browser, tmp_path / "browser", WIDTH, HEIGHT) as page:
        page.open(f"{town.address}&renderer=webgl2&splats={most}")
        until(lambda: page.ask("Boolean(window.compgsViewer?.info)"), "the scene")
        for step in (0.0, 0.5, 1.0, 0.0):
            picture, splats = show(page, town.camera(step, step))
            assert 0.5 * most < splats <= most
            assert picture.std() > 10
    check_nothing_twice(town)
    assert sum(last + 1 - first for parts in town.asked.values() for first, last in parts) < sum(
        tile.bytes for tile in tiles
    )
