"""One visitor, without a browser: which pictures it gets, from where, and how large."""

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

import compgs
from compgs.codec.reader import file_info
from compgs.errors import CorruptSection
from compgs.formats import SplatArrays
from compgs.formats.sog_streamed_writer import write_levels
from compgs.formats.tiled_writer import NewTile, write_tiles
from compgs.metrics import psnr, to_8bit
from compgs.render import RasterSettings
from compgs.viewer.pace import Pace
from compgs.viewer.shown import FileShown
from compgs.viewer.stage import OwnThread
from compgs.viewer.visitor import REST_SECONDS, Lens, Look, Picture, Visitor, lens_of

GOLDEN = (
    Path(__file__).parents[1] / "golden" / "default.cgs"
)  # 800 anchors, 437 of them in its first 12 994 bytes


class StandIn:
    """In place of a browser: keeps what it is sent."""

    def __init__(self, lens: Lens) -> None:
        self.now = lens
        self.pictures: list[Picture] = []
        self.failures: list[str] = []

    def lens(self) -> Lens:
        return self.now

    def show(self, picture: Picture) -> None:
        self.pictures.append(picture)

    def fail(self, message: str) -> None:
        self.failures.append(message)


class Half(Pace):
    """Half of the sides, whatever a picture takes."""

    def __init__(self, seconds: float) -> None:
        super().__init__(seconds, share=0.5)

    def took(self, seconds: float, share: float | None = None) -> None:
        pass


@pytest.fixture
def shown(tiny_cgs: Path) -> FileShown:
    return FileShown(tiny_cgs, "cpu")


@contextmanager
def visiting(shown: FileShown) -> Iterator[tuple[Visitor, StandIn]]:
    page = StandIn(lens_of(shown.cameras[0][1]))
    stage = OwnThread()
    visitor = Visitor(page, shown, stage, Look(len(shown.levels) - 1, shown.background))
    thread = threading.Thread(target=visitor.work, daemon=True)
    thread.start()
    try:
        yield visitor, page
    finally:
        visitor.close()
        thread.join(10)
        stage.close()
        assert not thread.is_alive()


def until(condition: Callable[[], object]) -> None:
    end = time.monotonic() + 300  # kernels may have to be compiled
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.005)


def test_a_page_at_rest_gets_one_picture_the_renderer_s(shown: FileShown) -> None:
    with visiting(shown) as (_, page):
        until(lambda: page.pictures)
        time.sleep(0.5)
        (picture,) = page.pictures
    camera = shown.cameras[0][1]
    expected = to_8bit(compgs.render(shown.whole, camera).image)
    assert picture.full and picture.counts == shown.whole.counts and picture.drawn > 20
    assert picture.image.shape == (camera.height, camera.width, 3)
    assert psnr(picture.image, expected) > 50


def test_pictures_are_small_while_the_camera_moves_and_full_when_it_rests(shown: FileShown) -> None:
    with visiting(shown) as (visitor, page):
        until(lambda: page.pictures)
        visitor.moving = Half(0.07)
        now = time.perf_counter()
        visitor.clock = lambda: now  # it stands: however slow the machine is, the camera does not rest
        page.pictures.clear()
        for moves in range(1, 5):
            visitor.changed()
            until(lambda moves=moves: len(page.pictures) >= moves)
        assert not any(picture.full for picture in page.pictures)
        now += 2 * REST_SECONDS
        until(lambda: page.pictures[-1].full)
        time.sleep(0.4)
    assert [picture.full for picture in page.pictures].count(True) == 1 and page.pictures[-1].full
    assert {picture.image.shape for picture in page.pictures[:-1]} == {(24, 32, 3)}
    assert page.pictures[-1].image.shape == (48, 64, 3)


def test_wishes_change_the_next_picture() -> None:
    shown = FileShown(GOLDEN, "cpu")
    with visiting(shown) as (visitor, page):
        until(lambda: page.pictures)
        visitor.wish(background=(1.0, 0.0, 0.5), share=0.1, level=1)
        until(lambda: page.pictures[-1].full and len(page.pictures) > 1)
        picture = page.pictures[-1]
    coarse = compgs.decode(GOLDEN, prefix=12_994)
    camera = shown.cameras[0][1].resized(64, 48)
    expected = compgs.render(coarse, camera, RasterSettings(background=(1.0, 0.0, 0.5)))
    assert picture.counts == coarse.counts and coarse.counts["anchors"] == 437
    assert psnr(picture.image, to_8bit(expected.image)) > 50


def test_the_levels_are_the_beginnings_of_the_file_that_are_scenes(shown: FileShown) -> None:
    levels = FileShown(GOLDEN, "cpu").levels
    assert levels == ("11.8 kB: 214 anchors", "13.0 kB: 437 anchors", "all of it: 14.9 kB")
    assert len(shown.levels) == 1 and shown.levels[0].startswith("all of it: ")


def test_with_a_cap_a_file_is_its_longest_beginning_within_it() -> None:
    parts = file_info(GOLDEN.read_bytes()).ranges
    for most, expected in (
        (parts[-1].coupled, parts[-1]),
        (parts[-1].coupled - 1, parts[-2]),
        (parts[1].coupled, parts[1]),
        (1, parts[0]),  # the coarsest is shown even so
    ):
        shown = FileShown(GOLDEN, "cpu", most=most)
        finest = shown.model(len(shown.levels) - 1)
        assert finest.counts == {"anchors": expected.anchors, "coupled_primitives": expected.coupled}
        assert len(shown.levels) == parts.index(expected) + 1


def splats(count: int) -> SplatArrays:
    """In one place, gray."""
    zeros, rows = np.zeros((count, 3), np.float32), np.zeros((count, 0, 3), np.float32)
    turned = np.tile(np.float32([1, 0, 0, 0]), (count, 1))
    return SplatArrays(zeros, zeros, turned, np.zeros(count, np.float32), zeros, rows)


def test_with_a_cap_tiles_and_levels_of_a_streamed_sog_are_within_it(tmp_path: Path) -> None:
    tiles = write_tiles(tmp_path / "town.tiles", [NewTile("a", GOLDEN.read_bytes())])
    parts = file_info(GOLDEN.read_bytes()).ranges
    shown = FileShown(tiles, "cpu", most=parts[0].coupled)
    picture = compgs.render(shown.model(0), shown.cameras[0][1])
    assert 0 < picture.visible.sum() <= parts[0].coupled
    write_levels(tmp_path / "lod-meta.json", 2, iter([[splats(60), splats(20)]]))
    for most, level in ((60, 60), (59, 20), (5, 20)):
        shown = FileShown(tmp_path / "lod-meta.json", "cpu", most=most)
        assert shown.model(0).counts == {"splats": level}


def test_a_part_that_cannot_be_decoded_is_said_once_and_the_rest_goes_on(
    shown: FileShown, monkeypatch: pytest.MonkeyPatch
) -> None:
    with visiting(shown) as (visitor, page):
        until(lambda: page.pictures)

        def damaged(level: int, *, fresh: bool) -> None:
            raise CorruptSection("latents: damaged")

        monkeypatch.setattr(shown, "model", damaged)
        visitor.changed(moving=False)
        until(lambda: page.failures)
        time.sleep(0.3)
        monkeypatch.undo()
        count = len(page.pictures)
        visitor.changed(moving=False)
        until(lambda: len(page.pictures) > count)
    assert page.failures == ["latents: damaged"]


def test_a_lens_is_the_camera_that_it_was_made_from(shown: FileShown) -> None:
    for _, camera in shown.cameras[:4]:
        found = lens_of(camera).camera()
        np.testing.assert_allclose(found.world_to_camera, camera.world_to_camera, atol=1e-9)
        assert (found.width, found.height) == (camera.width, camera.height)
        assert found.fy == pytest.approx(camera.fy)


def test_a_narrow_page_still_sees_all_that_a_camera_saw(shown: FileShown) -> None:
    camera = shown.cameras[0][1]  # 64 x 48
    wide, narrow = lens_of(camera, aspect=2.0), lens_of(camera, aspect=0.5)
    high = 24 / camera.fy
    assert np.tan(wide.field_of_view / 2) == pytest.approx(high)
    assert 0.5 * np.tan(narrow.field_of_view / 2) == pytest.approx(32 / camera.fx)
