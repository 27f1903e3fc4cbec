"""Folders of tiles: the picture is that of all tiles together, in bounded memory, and damage is refused."""

import hashlib
import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from compgs.cameras import Camera
from compgs.codec.decoder import decode_bytes
from compgs.codec.reader import file_info, read_content
from compgs.codec.reduce import without_coupled
from compgs.codec.writer import write_content
from compgs.devices import drawn
from compgs.errors import BitstreamError, ConfigError, CorruptSection, NotACompGSFile, UnsupportedVersion
from compgs.evaluation.camera_path import look_at, orbit
from compgs.formats.tile_detail import levels_with_whole, wanted_levels
from compgs.formats.tiled import Core, GroundAxes, read_manifest
from compgs.formats.tiled_scene import (
    ASKED_BY,
    TileCache,
    TiledScene,
    open_tiles,
    resident_bytes,
    tile_memory,
)
from compgs.formats.tiled_writer import NewTile, _counted_from, common_offset, spheres, write_tiles
from compgs.gaussians import Gaussians
from compgs.opening import check_scene, component_bytes, format_of, open_scene
from compgs.ordering.order import canonical_order, level_counts
from compgs.render import RasterSettings, Renderable, local_camera, rasterize, render, settings_of

APART = 8.0  # world units between the middles of two tiles
DILATION = 2.0**-12  # at cameras of 60 pixels: three times what is added without one
AT = ((0.0, 0.0, 0.0), (APART, 0.0, 0.0), (0.0, APART, 0.0), (APART, APART, 0.0))


def placed_at(data: bytes, offset: tuple[float, float, float]) -> bytes:
    """The same scene somewhere else."""
    return write_content(replace(read_content(data), world_offset=offset, angular_dilation=DILATION))


@pytest.fixture(scope="module")
def contents(cgs_bytes: bytes) -> list[bytes]:
    return [placed_at(cgs_bytes, offset) for offset in AT]


@pytest.fixture(scope="module")
def folder(contents: list[bytes], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four tiles that stand around the point (4, 4, 0)."""
    place = tmp_path_factory.mktemp("scenes") / "city.tiles"
    write_tiles(place, [NewTile(f"{i % 2}_{i // 2}", data) for i, data in enumerate(contents)])
    return place


@pytest.fixture(scope="module")
def cameras() -> list[Camera]:
    """Of the world: around all tiles, and close to one."""
    every = np.array(AT)
    around = [c for _, c in orbit(every, frames=4, width=64, height=48, up=(0, 0, 1))]
    down = look_at(np.array([APART, 0.1, 4.0]), np.array([APART, 0.0, 0.0]), np.array([0.0, 0, 1]))
    return [*around, Camera(down, 60.0, 60.0, 32.0, 24.0, 64, 48)]


def together(contents: list[bytes], camera: Camera, offset: np.ndarray, tmp_path: Path) -> np.ndarray:
    """The picture of all tiles' Gaussians in one list: nothing is culled, nothing is left on disk."""
    rows = []
    for data in contents:
        (tmp_path / "one.cgs").write_bytes(data)
        model = open_scene(tmp_path / "one.cgs")
        shift = np.array(model.world_offset) - offset
        seen = model.gaussians(camera.moved(model.world_offset))
        rows.append(vars(replace(seen, means=seen.means + shift.astype(np.float32))).values())
    every = Gaussians(*(np.concatenate(arrays) for arrays in zip(*rows, strict=True)))
    settings = RasterSettings(background=(0.1, 0.2, 0.3), angular_dilation=DILATION)
    return rasterize(every, camera.moved(offset), settings).image


def test_the_picture_is_that_of_all_tiles_in_one_list(
    folder: Path, contents: list[bytes], cameras: list[Camera], tmp_path: Path
) -> None:
    model = open_scene(folder)
    assert isinstance(model, TiledScene) and isinstance(model, Renderable)
    offset = np.array(model.world_offset)
    assert offset.tolist() == [4.0, 4.0, 0.0]
    for camera in cameras:
        expected = together(contents, camera, offset, tmp_path)
        assert expected.std() > 0.02
        np.testing.assert_array_equal(render(model, camera).image, expected)


def test_memory_for_one_tile_gives_the_same_picture_as_memory_for_all(
    folder: Path, cameras: list[Camera]
) -> None:
    every, one = open_tiles(folder / "manifest.json"), open_tiles(folder / "manifest.json", memory=1)
    for camera in cameras:
        np.testing.assert_array_equal(render(one, camera).image, render(every, camera).image)
    assert every.cache.reads == 4 < one.cache.reads
    largest = max(tile.memory for tile in one.manifest.tiles)
    assert one.cache.most_open == largest < every.cache.most_open == 4 * largest


def test_open_tiles_never_take_more_than_they_may(folder: Path, cameras: list[Camera]) -> None:
    tile = read_manifest(folder / "manifest.json").tiles[0].memory
    model = open_tiles(folder / "manifest.json", memory=2 * tile + tile // 2)
    for camera in cameras * 2:
        render(model, camera)
        assert model.cache.bytes <= model.cache.most_open <= 2 * tile


def test_a_tile_that_no_pixel_shows_is_not_opened(folder: Path, cameras: list[Camera]) -> None:
    model = open_tiles(folder / "manifest.json")
    render(model, cameras[-1])
    assert [index in model.cache for index in range(4)] == [False, True, False, False]


def test_a_camera_that_sees_no_tile_shows_the_background(folder: Path) -> None:
    away = look_at(np.array([4.0, 4.0, 50.0]), np.array([4.0, 4.0, 100.0]), np.array([0.0, 1, 0]))
    model = open_tiles(folder / "manifest.json").over((0.25, 0.5, 0.75))
    image = render(model, Camera(away, 60.0, 60.0, 32.0, 24.0, 64, 48)).image
    assert model.cache.reads == 0
    np.testing.assert_array_equal(image, np.broadcast_to(np.float32([0.25, 0.5, 0.75]), image.shape))


def test_a_picture_with_more_tiles_than_fit_finds_most_of_them_open_the_next_time(
    folder: Path, cameras: list[Camera]
) -> None:
    tile = read_manifest(folder / "manifest.json").tiles[0].memory
    model = open_tiles(folder / "manifest.json", memory=3 * tile)
    render(model, cameras[0])
    assert model.cache.reads == 4
    for already in (4, 6, 8):  # closing the longest unused would read four each time
        render(model, cameras[0])
        assert model.cache.reads <= already + 2


def test_a_tile_that_takes_more_than_was_said_still_makes_room(folder: Path) -> None:
    model = open_tiles(folder / "manifest.json")
    tile = model.manifest.tiles[0].memory
    cache = TileCache(model.cache.get, [1] * 4, 2 * tile + tile // 2)
    for index in (0, 1, 2):
        cache.get(index)
    assert cache.bytes == 2 * tile and [index in cache for index in range(4)] == [False, True, True, False]


def test_two_halves_of_a_file_show_what_the_file_shows(
    cgs_bytes: bytes, tmp_path: Path, cameras: list[Camera]
) -> None:
    content = read_content(cgs_bytes)
    left = np.repeat(content.coordinates[:, 0] < 0, content.mask.sum(1))
    halves = [write_content(without_coupled(content, part)) for part in (left, ~left)]
    manifest = write_tiles(tmp_path / "two.tiles", [NewTile("0_0", halves[0]), NewTile("1_0", halves[1])])
    (tmp_path / "one.cgs").write_bytes(cgs_bytes)
    whole, tiles = open_scene(tmp_path / "one.cgs"), open_scene(manifest)
    assert tiles.counts == whole.counts and tiles.background == whole.background
    for _, camera in orbit(np.array([[0.0, 0, 0], [1, 1, 1]]), frames=3, width=64, height=48):
        np.testing.assert_allclose(render(tiles, camera).image, render(whole, camera).image, atol=2e-6)


def test_every_anchor_lies_in_a_sphere_of_its_tile() -> None:
    rng = np.random.default_rng(0)
    centers = (rng.normal(size=(5000, 3)) * [30, 3, 1] + [1e5, 0, 0]).astype(np.float32)
    radii = rng.exponential(size=5000).astype(np.float32)
    found = spheres(centers, radii)
    assert 16 <= len(found) <= 64
    reach = np.linalg.norm(centers[:, None].astype(np.float64) - found[:, :3], axis=2) + radii[:, None]
    assert (reach <= found[:, 3] * (1 + 1e-12)).any(1).all()
    assert np.median(found[:, 3]) < 30  # groups are of neighbours: all together reach 100 to both sides
    endless = spheres(centers, np.where(np.arange(5000) == 7, np.inf, radii))
    assert np.isfinite(endless).all() and endless[:, 3].max() > 1e26


def test_spheres_of_a_manifest_hold_the_anchors_far_from_the_origin_too(
    cgs_bytes: bytes, tmp_path: Path
) -> None:
    """Rounded to the digits of the file, and to single precision, in which a view meets them."""
    places = [(4e6, -3e5, 12.0), (4e6 + 2000.0, -3e5 + 700.0, 13.0)]
    tiles = [NewTile(f"{i}", placed_at(cgs_bytes, place)) for i, place in enumerate(places)]
    model = open_scene(write_tiles(tmp_path / "far.tiles", tiles))
    centers, radii = (array.astype(np.float64) for array in model.bounds)
    for index, place in enumerate(places):
        tile = model.cache.get(index)
        shift = np.subtract(place, model.world_offset).astype(np.float32)
        positions = (tile.bounds[0] + shift).astype(np.float64)
        reach = np.linalg.norm(positions[:, None] - centers, axis=2) + tile.bounds[1][:, None]
        assert (reach <= radii).any(1).all()
    assert radii.max() < 50


def test_spheres_lose_nothing_by_the_digits_that_a_manifest_has(folder: Path, tmp_path: Path) -> None:
    rng = np.random.default_rng(4)
    exact = np.concatenate([rng.normal(size=(500, 3)) * 900, rng.exponential(size=(500, 1))], axis=1)
    whole = read_manifest(folder / "manifest.json")
    tile = replace(whole.tiles[0], spheres=exact)
    counted = _counted_from((-1000.0, 300.0, 0.0), tile)
    (tmp_path / "manifest.json").write_bytes(replace(whole, tiles=(counted,)).encoded())
    read = read_manifest(tmp_path / "manifest.json").tiles[0].spheres.astype(np.float32).astype(np.float64)
    moved = exact[:, :3] + [1000.0, -300.0, 0.0]
    assert (np.linalg.norm(read[:, :3] - moved, axis=1) + exact[:, 3] <= read[:, 3]).all()
    assert (read[:, 3] < exact[:, 3] + 0.2).all()


def test_what_a_tile_is_said_to_take_is_what_its_arrays_take(folder: Path) -> None:
    model = open_tiles(folder / "manifest.json").cache.get(0)
    p, radii = model.primitives, model.bounds[1]
    stored = [p.positions, p.log_scales, p.references, p.residuals, p.anchor_index]
    arrays = [*stored, *model.geometry, radii, model._scene.first_coupled[1:]]
    assert resident_bytes(model) == sum(array.nbytes for array in arrays)


def test_components_sum_to_the_bytes_of_the_folder(folder: Path) -> None:
    assert format_of(folder).name == format_of(folder / "manifest.json").name == "tiles"
    assert sum(component_bytes(folder).values()) == sum(f.stat().st_size for f in folder.iterdir())


def test_a_manifest_is_read_as_it_was_written(folder: Path, contents: list[bytes], tmp_path: Path) -> None:
    ground = GroundAxes((1.0, 2.0, 3.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0))
    core = Core((-np.inf, 0.5), (4.0, np.inf))
    manifest = read_manifest(write_tiles(tmp_path / "x.tiles", [NewTile("a", contents[0], core)], ground))
    assert manifest.ground == ground and manifest.tiles[0].core == core
    assert manifest.tiles[0].sha256 == hashlib.sha256(contents[0]).hexdigest()
    assert len(manifest.viewpoints) == len(open_scene(tmp_path / "x.tiles" / "a.cgs").viewpoints) > 0
    dilation = open_scene(tmp_path / "x.tiles" / "a.cgs").angular_dilation
    assert (
        open_scene(tmp_path / "x.tiles").angular_dilation == manifest.angular_dilation == dilation is not None
    )
    four = read_manifest(folder / "manifest.json")
    assert len(four.viewpoints) == 12
    np.testing.assert_allclose(four.up, open_scene(folder / "0_0.cgs").up, atol=1e-12)
    first = [open_scene(folder / f"{name}.cgs").viewpoints[0] for name in ("0_0", "1_0", "0_1", "1_1")]
    for kept, camera in zip(four.viewpoints, first, strict=False):  # in turns, the best of each tile first
        np.testing.assert_allclose(kept.world_to_camera, camera.world_to_camera, rtol=1e-11, atol=1e-12)


def from_coarse_to_fine(data: bytes) -> bytes:
    """The same scene, with a range for each octree level that has anchors of its own."""
    content = read_content(data)
    counts = level_counts(content.coordinates[canonical_order(content.coordinates)])
    levels = [i for i, count in enumerate(counts) if i == 0 or count > counts[i - 1]]
    levels[-1] = len(counts) - 1
    return write_content(content, levels=levels)


def test_levels_of_a_tile_are_the_beginnings_of_its_file_that_are_scenes(
    contents: list[bytes], tmp_path: Path
) -> None:
    data = from_coarse_to_fine(contents[0])
    (tile,) = read_manifest(write_tiles(tmp_path / "x.tiles", [NewTile("a", data)])).tiles
    assert len(tile.levels) > 2
    for level in tile.levels:
        model = decode_bytes(data[: level.bytes], tmp_path, prefix=True)
        assert (model.anchors, model.coupled) == (level.anchors, level.coupled_primitives)
    with pytest.raises(BitstreamError):  # no byte less
        decode_bytes(data[: tile.levels[0].bytes - 1], tmp_path, prefix=True)


def test_a_manifest_from_before_tiles_had_levels_is_read(copy: Path) -> None:
    content = json.loads((copy / "manifest.json").read_bytes())
    for tile in content["tiles"]:
        del tile["levels"]
    forged(copy, {"tiles": content["tiles"]})
    assert [tile.levels for tile in read_manifest(copy / "manifest.json").tiles] == [()] * 4


def test_the_frame_of_tiles_with_one_offset_is_theirs() -> None:
    assert common_offset([(1.5, 2.0, 3.0)] * 2) == (1.5, 2.0, 3.0)
    assert common_offset([(0.0, 0.0, 0.0), (1.0, 2.0, 3.3)]) == (0.0, 1.0, 2.0)


# detail ------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def row(contents: list[bytes], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six tiles one behind the other along y, each from coarse to fine."""
    place = tmp_path_factory.mktemp("scenes") / "row.tiles"
    content = read_content(from_coarse_to_fine(contents[0]))
    levels = [part.level for part in file_info(from_coarse_to_fine(contents[0])).ranges]
    offsets = [(0.0, i * APART, 0.0) for i in range(6)]
    tiles = [write_content(replace(content, world_offset=offset), levels=levels) for offset in offsets]
    return write_tiles(place, [NewTile(str(i), data) for i, data in enumerate(tiles)])


def before_the_row(width: int = 64) -> Camera:
    pose = look_at(np.array([0.0, -APART, 2.0]), np.array([0.0, 2 * APART, 0.0]), np.array([0.0, 0, 1]))
    return Camera(pose, 0.9 * width, 0.9 * width, width / 2, width / 2, width, width)


def test_with_a_cap_near_tiles_are_finer_than_far_ones_and_no_picture_has_more(row: Path) -> None:
    tiles = read_manifest(row).tiles
    camera = before_the_row(800)
    one = tiles[0].coupled_primitives
    for most in (one // 3, one, 2 * one, 4 * one):
        model = open_tiles(row, most_splats=most)
        local = local_camera(model, camera)
        wanted = wanted_levels(tiles, local, most)
        counts = [
            levels_with_whole(t)[n - 1].coupled_primitives if n else 0
            for t, n in zip(tiles, wanted, strict=True)
        ]
        assert 0.5 * most < sum(counts) <= most
        assert wanted == sorted(wanted, reverse=True) and wanted[0] > wanted[-1]
        drawn = render(model, camera)
        assert drawn.visible.sum() <= most
        assert drawn.image.std() > 0.01
        assert all(len(part.means) <= most for part in model.parts(local))


def test_a_cap_with_room_for_all_that_is_seen_changes_nothing(row: Path) -> None:
    camera = before_the_row(800)
    capped = open_tiles(row, most_splats=10**9)
    np.testing.assert_array_equal(render(capped, camera).image, render(open_tiles(row), camera).image)
    # Seen small, coarse tiles are enough.
    small = before_the_row(16)
    few = sum(len(part.means) for part in capped.parts(local_camera(capped, small)))
    assert few < 0.5 * sum(len(part.means) for part in open_tiles(row).parts(local_camera(capped, small)))


# damage ------------------------------------------------------------------------------------------------------------


@pytest.fixture
def copy(folder: Path, tmp_path: Path) -> Path:
    place = tmp_path / "copy.tiles"
    place.mkdir()
    for file in folder.iterdir():
        (place / file.name).write_bytes(file.read_bytes())
    return place


def changed(data: bytes) -> Iterator[bytes]:
    """A manifest with one number or word changed, at many places, or cut."""
    digits = [i for i in range(40, len(data)) if data[i : i + 1].isdigit()]
    for i in digits[:: max(1, len(digits) // 60)]:
        other = b"7" if data[i : i + 1] != b"7" else b"3"
        one = data[:i] + other + data[i + 1 :]
        if json.loads(one) != json.loads(data):  # the last digits of a float64 may say the same
            yield one
    yield data.replace(b'"1_0"', b'"1_9"')
    yield data.replace(b'"core":null', b'"core":1', 1)
    yield data[: len(data) // 2]
    yield b'{"format": "compgs tiles"}'
    yield b'{"format": "compgs tiles", "version": ' + b"[" * 100_000


def test_a_manifest_that_was_changed_anywhere_is_refused(copy: Path) -> None:
    whole = (copy / "manifest.json").read_bytes()
    for data in changed(whole):
        assert data != whole
        (copy / "manifest.json").write_bytes(data)
        with pytest.raises((CorruptSection, UnsupportedVersion)):
            open_scene(copy)


def forged(copy: Path, whole: dict[str, object] | None = None, **changes: object) -> None:
    """The first tile's entry, or what stands beside the tiles, is changed, and the checksum is made to match."""
    path = copy / "manifest.json"
    content = json.loads(path.read_text())
    rest = {k: v for k, v in content.items() if k not in ("format", "version", "checksum")}
    rest |= whole or {}
    rest["tiles"][0] |= changes
    text = json.dumps(rest, sort_keys=True, separators=(",", ":"))
    head = {"format": "compgs tiles", "version": 1, "checksum": hashlib.sha256(text.encode()).hexdigest()}
    path.write_text(json.dumps(head | rest))


@pytest.mark.parametrize(
    "changes",
    [
        {"name": "../secret"},
        {"name": "1_0"},
        {"anchors": 0},
        {"anchors": True},
        {"bytes": 1e3},
        {"sha256": "0"},
        {"world_offset": [0, 0]},
        {"world_offset": [0, 0, 1e31]},
        {"spheres": []},
        {"spheres": [[0, 0, 0, -1]]},
        {"spheres": [[0, 0, 0, "x"]]},
        {"core": {"low": [1, 0], "high": [0, 1]}},
        {"levels": 7},
        {"levels": [[100, 5]]},
        {"levels": [[100, 5, -1]]},
        {"levels": [[200, 5, 1], [100, 6, 2]]},
        {"levels": [[100, 6, 2], [200, 6, 2]]},
        {"levels": [[1 << 40, 6, 2]]},
    ],
)
def test_a_manifest_of_nonsense_is_refused_also_where_its_checksum_matches(
    copy: Path, changes: dict[str, object]
) -> None:
    forged(copy)
    open_scene(copy)
    forged(copy, **changes)
    with pytest.raises(CorruptSection, match="manifest is damaged"):
        open_scene(copy)


@pytest.mark.parametrize("value", [0.0, -1, 2.0, "0.1", True, [0.1]])
def test_a_dilation_that_cannot_be_is_refused(copy: Path, value: object) -> None:
    forged(copy, {"angular_dilation": 1e-6})
    assert open_scene(copy).angular_dilation == 1e-6
    forged(copy, {"angular_dilation": value})
    with pytest.raises(CorruptSection, match="manifest is damaged"):
        open_scene(copy)


def test_a_manifest_without_a_dilation_is_drawn_as_before_there_was_one(copy: Path) -> None:
    path = copy / "manifest.json"
    rest = json.loads(path.read_text())
    del rest["angular_dilation"]
    path.write_text(json.dumps(rest))
    forged(copy)
    assert open_scene(copy).angular_dilation is None


@pytest.mark.parametrize(
    "changes",
    [{"anchors": 9_000}, {"coupled_primitives": 90_000}, {"world_offset": [0.0, 0.0, 1.0]}],
)
def test_a_file_that_holds_another_scene_than_the_manifest_says_is_refused(
    copy: Path, changes: dict[str, object]
) -> None:
    forged(copy, **changes)
    with pytest.raises(CorruptSection, match="holds another scene than the manifest says"):
        open_tiles(copy / "manifest.json").cache.get(0)


def test_a_tile_that_is_missing_cut_or_another_is_refused_by_name(copy: Path, cameras: list[Camera]) -> None:
    file = copy / "1_0.cgs"
    whole = file.read_bytes()
    file.write_bytes(whole[:-1])
    with pytest.raises(BitstreamError, match=r"tile 1_0: 1_0\.cgs has \d+ bytes, the manifest promises"):
        check_scene(copy)
    flipped = bytearray(whole)
    flipped[-20] ^= 1
    file.write_bytes(bytes(flipped))
    model = open_scene(copy)  # what is not looked at is not read
    with pytest.raises(CorruptSection, match=r"is not the file that manifest\.json promises"):
        render(model, cameras[-1])
    file.unlink()
    with pytest.raises(NotACompGSFile, match=r"tile 1_0: there is no .*1_0\.cgs"):
        check_scene(copy)


def test_a_manifest_of_another_version_says_so(copy: Path) -> None:
    text = (copy / "manifest.json").read_text().replace('"version":1', '"version":2')
    (copy / "manifest.json").write_text(text)
    with pytest.raises(UnsupportedVersion, match="version 2"):
        open_scene(copy)


def test_a_folder_whose_tiles_are_being_replaced_has_no_manifest(copy: Path, contents: list[bytes]) -> None:
    def stopped() -> Iterator[NewTile]:
        yield NewTile("0_0", contents[1])
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_tiles(copy, stopped())
    assert not (copy / "manifest.json").exists()
    write_tiles(copy, [NewTile("0_0", contents[1])])
    assert sorted(file.name for file in copy.iterdir()) == ["0_0.cgs", "manifest.json"]
    check_scene(copy)


def test_tiles_without_a_name_of_their_own_or_none_at_all_are_refused(
    tmp_path: Path, contents: list[bytes]
) -> None:
    for tiles in (
        [],
        [NewTile("a/b", contents[0])],
        [NewTile("a", contents[0]), NewTile("a", contents[1])],
    ):
        with pytest.raises(ConfigError):
            write_tiles(tmp_path / "x.tiles", tiles)
        assert not (tmp_path / "x.tiles" / "manifest.json").exists()


# memory and devices ------------------------------------------------------------------------------------------------


def test_how_much_memory_tiles_may_take_is_said_by_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(ASKED_BY, "123456")
    assert tile_memory() == 123456
    monkeypatch.delenv(ASKED_BY)
    assert tile_memory() >= 1 << 28
    for wrong in ("", "0", "-5", "2GB"):
        monkeypatch.setenv(ASKED_BY, wrong)
        with pytest.raises(ConfigError, match=ASKED_BY):
            tile_memory()


def test_another_device_draws_the_gaussians_of_all_tiles(folder: Path, cameras: list[Camera]) -> None:
    model = open_tiles(folder / "manifest.json")
    local = cameras[0].moved(model.world_offset)
    settings = settings_of(model)
    found = drawn(model.gaussians(local), local, settings, str(torch.device("cpu")))
    np.testing.assert_allclose(found.image, render(model, cameras[0]).image, atol=2e-5)
    mixed = model.blended(model.gaussians(local), local, settings)
    np.testing.assert_array_equal(mixed.image, render(model, cameras[0]).image)
