"""The division of a capture: nothing is left out, nothing is twice, and each tile has the views that show it."""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from compgs.cameras import Camera
from compgs.errors import CheckpointError, ConfigError, SceneError
from compgs.evaluation.camera_path import look_at
from compgs.formats.tiled import Core
from compgs.formats.tiled_ground import contains, cuts, parse_grid
from compgs.scene.sight import depths_in
from compgs.scene.views import Points, Scene, View
from compgs.tiles import block as block_module
from compgs.tiles import block_scene, grid_for, plan_tiles, read_plan, write_plan
from compgs.tiles.ground import ground_of
from compgs.tiles.sight import shares_of_picture, times_seen

PIXELS = np.zeros((40, 60, 3), np.uint8)


def camera_at(eye: tuple[float, float, float], target: tuple[float, float, float]) -> Camera:
    """60 x 40 pixels, 64 by 45 degrees, the world's z upwards."""
    return Camera(look_at(np.array(eye), np.array(target), np.array([0.0, 0, 1])), 48, 48, 30, 20, 60, 40)


def scene_of(positions: np.ndarray, cameras: dict[str, Camera]) -> Scene:
    views = tuple(View(name, camera, PIXELS) for name, camera in cameras.items())
    points = Points(positions, np.full((len(positions), 3), 100, np.uint8))
    return Scene("street", views, views[:1], points, (0, 0, 0), 20.0, Path("street"))


@pytest.fixture(scope="module")
def street() -> Scene:
    """Two heaps of points 40 apart along x; cameras that see the left one, the right one, or both from afar."""
    rng = np.random.default_rng(0)
    heap = rng.uniform(-4, 4, (3000, 3)) * [1, 0.75, 0.5]
    left, right = heap + np.array([-20, 0, 0]), heap + np.array([20, 0, 0])
    cameras = {}
    for i in range(10):
        y = 12.0 + 0.1 * i
        cameras[f"left_{i}"] = camera_at((-20 + 0.2 * i, y, 2), (-20, 0, 0))
        cameras[f"right_{i}"] = camera_at((20 - 0.2 * i, y, 2), (20, 0, 0))
    for i in range(3):
        cameras[f"both_{i}"] = camera_at((0, 60.0 + i, 5), (0, 0, 0))
    return scene_of(np.concatenate([left, right]), cameras)


def test_the_ground_lies_across_the_sky_and_its_first_axis_along_the_scene(street: Scene) -> None:
    ground = ground_of([view.camera for view in street.train_views], street.points.positions)
    assert abs(ground.right[0]) > 0.999
    assert abs(ground.forward[2]) < 0.2 and abs(ground.right[2]) < 0.01
    np.testing.assert_allclose(np.dot(ground.right, ground.forward), 0, atol=1e-12)
    places = ground.places(street.points.positions)
    assert np.ptp(places[:, 0]) > 4 * np.ptp(places[:, 1])
    np.testing.assert_allclose(ground.places(np.array([ground.origin])), 0, atol=1e-12)


def test_what_stands_above_one_another_has_one_place_whatever_way_the_world_is_turned() -> None:
    turn = look_at(np.zeros(3), np.array([1.0, 2.0, 3.0]), np.array([0.3, 0.1, 1.0]))[:3, :3]
    rng = np.random.default_rng(1)
    flat = np.concatenate(
        [rng.uniform(-10, 10, (200, 1)), rng.uniform(-3, 3, (200, 1)), np.zeros((200, 1))], 1
    )
    poses = [camera_at((x, 20, 6), (x, 0, 0)) for x in (-5.0, 0.0, 5.0)]
    # The cameras' mean up is not the world's: theirs counts.
    up = -np.mean([camera.rotation[1] for camera in poses], axis=0) @ turn.T
    turned = [
        replace(
            c, world_to_camera=c.world_to_camera @ np.block([[turn.T, np.zeros((3, 1))], [np.eye(4)[3:]]])
        )
        for c in poses
    ]
    ground = ground_of(turned, flat @ turn.T)
    low, high = (ground.places(flat @ turn.T + height * up) for height in (0.0, 7.0))
    np.testing.assert_allclose(low, high, atol=1e-9)


@pytest.mark.parametrize("grid", [(1, 1), (2, 1), (3, 2), (4, 3)])
def test_every_place_of_the_plane_is_in_one_core(grid: tuple[int, int], street: Scene) -> None:
    plan = plan_tiles(street, *grid)
    rng = np.random.default_rng(2)
    edges = [edge for tile in plan.tiles for edge in (*tile.core.low, *tile.core.high) if math.isfinite(edge)]
    on_edges = np.array([(a, b) for a in edges for b in (*edges, 0.0)]).reshape(-1, 2)
    places = np.concatenate([rng.normal(size=(2000, 2)) * 30, on_edges, [[1e12, -1e12]]])
    assert (sum(contains(tile.core, places).astype(int) for tile in plan.tiles) == 1).all()
    assert sum(tile.points for tile in plan.tiles) == len(street.points)
    assert [tile.name for tile in plan.tiles] == [f"{c}_{r}" for c in range(grid[0]) for r in range(grid[1])]


def test_tiles_are_padded_by_a_fifth_of_what_their_points_cover(street: Scene) -> None:
    left, right = plan_tiles(street, 2, 1).tiles
    assert left.core.high[0] == right.core.low[0] and abs(left.core.high[0]) < 16
    for inner, outer in ((left.core.high[0], left.padded.high[0]), (right.padded.low[0], right.core.low[0])):
        assert outer - inner == pytest.approx(0.2 * 8 * 0.96, rel=0.05)
    assert left.padded.low == left.core.low == (-math.inf, -math.inf)


def test_the_spacing_of_a_tile_is_that_of_its_own_points() -> None:
    """A grid of steps of 0.5 on one side, of 2 on the other."""
    fine = np.stack(np.meshgrid(np.arange(-40, -10, 0.5), np.arange(0, 10, 0.5), [0.0]), -1).reshape(-1, 3)
    coarse = np.stack(np.meshgrid(np.arange(10, 140, 2.0), np.arange(0, 10, 2.0), [0.0]), -1).reshape(-1, 3)
    camera = camera_at((20, 200, 50), (20, 0, 0))
    plan = plan_tiles(scene_of(np.concatenate([fine, coarse]), {"a": camera, "b": camera}), 4, 1)
    spacings = sorted(round(tile.spacing, 6) for tile in plan.tiles)
    assert spacings[0] == 0.5 and spacings[-1] == 2.0


def test_margins_reach_no_farther_than_a_fifth_of_the_points() -> None:
    """Most of the points in a small heap, some far away, which say how long the sides of the outer tiles are."""
    rng = np.random.default_rng(6)
    heap, far = rng.uniform(-1, 1, (3000, 3)), rng.uniform(-100, 100, (1000, 3))
    camera = camera_at((0, 150, 20), (0, 0, 0))
    scene = scene_of(np.concatenate([heap, far]) * np.array([1.5, 1, 0.1]), {"a": camera, "b": camera})
    plan = plan_tiles(scene, 2, 1)
    places = plan.ground.places(scene.points.positions)
    for tile in plan.tiles:
        beyond = contains(tile.padded, places).sum() - tile.points
        assert beyond == pytest.approx(0.2 * tile.points, abs=2)
    across = plan_tiles(scene, 1, 2)
    assert all(t.padded.low[0] == -math.inf and t.padded.high[0] == math.inf for t in across.tiles)


def test_cuts_give_parts_of_equal_weight() -> None:
    rng = np.random.default_rng(3)
    values, weights = rng.normal(size=5000), rng.integers(0, 10, 5000)
    edges = cuts(values, weights, 5)
    part = np.searchsorted(edges, values)
    sums = np.bincount(part, weights)
    assert len(sums) == 5 and np.abs(sums - weights.sum() / 5).max() <= 10
    assert cuts(np.array([1.0, 2, 3, 4]), np.array([1, 1, 1, 1]), 2) == [2.5]
    assert cuts(np.array([4.0, 1, 2, 3]), np.array([3, 1, 1, 1]), 2) == [3.5]
    with pytest.raises(ConfigError, match="cannot be cut into 3 parts"):
        cuts(np.ones(9), np.ones(9), 3)


def test_a_tile_has_the_views_that_show_it_and_no_others(street: Scene) -> None:
    left, right = plan_tiles(street, 2, 1).tiles
    if "left_0" not in left.views:
        left, right = right, left
    both = {f"both_{i}" for i in range(3)}
    assert set(left.views) == {f"left_{i}" for i in range(10)} | both
    assert set(right.views) == {f"right_{i}" for i in range(10)} | both


def test_a_view_is_somewhere_where_it_shows_most_even_if_that_is_little(street: Scene) -> None:
    plan = plan_tiles(street, 6, 4)
    assert {name for tile in plan.tiles for name in tile.views} == {view.name for view in street.train_views}
    assert min(len(tile.views) for tile in plan.tiles) >= 8


def test_shares_count_what_is_near_as_large_as_it_looks() -> None:
    """One point twice as far as another: a quarter of its size, so a fifth of both."""
    camera = camera_at((0, 0, 0), (1, 0, 0))
    positions = np.array([[2.0, 0, 0], [4.0, 0.5, 0], [-3.0, 0, 0], [1.0, 50, 0]])
    members = np.array([[1.0, 0], [0, 1], [0, 1], [0, 1]])
    np.testing.assert_allclose(shares_of_picture([camera], positions, members), [[0.8, 0.2]])
    np.testing.assert_array_equal(times_seen([camera, camera], positions), [2, 2, 0, 0])
    away = camera_at((0, 0, 0), (0, -1, 0))
    np.testing.assert_array_equal(shares_of_picture([away], positions, members), [[0, 0]])
    # What is right before the lens counts as if it were at a quarter of the median distance.
    crowd = np.array([[0.001, 0, 0], *[[4.0, 0.1 * i, 0] for i in range(-2, 3)]])
    first = np.array([[1.0], *[[0.0]] * 5])
    np.testing.assert_allclose(shares_of_picture([camera], crowd, first), [[16 / 21]], rtol=1e-6)


def test_a_margin_lets_in_what_is_beside_the_image() -> None:
    camera = camera_at((0, 0, 0), (1, 0, 0))
    beside = np.array(
        [[1.0, 0.65, 0], [1.0, -0.65, 0], [1.0, 0, 0.45], [1.0, 0, -0.45]]
    )  # edges: 0.625, 0.417
    assert not depths_in(camera, beside)[1].any()
    assert depths_in(camera, beside, 0.1)[1].all()


def test_a_block_has_its_points_and_of_what_its_views_see_at_most_as_many(
    street: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = plan_tiles(street, 6, 1)
    block = block_scene(street, whole.ground, whole.tiles[0])
    seen = times_seen([view.camera for view in block.train_views], street.points.positions) > 0
    inside = contains(whole.tiles[0].padded, whole.ground.places(street.points.positions))
    assert len(block.points) == (seen | inside).sum()  # few enough that nothing is left out
    monkeypatch.setattr(block_module, "KEPT_OUTSIDE", 0)
    plan = plan_tiles(street, 2, 1)
    for tile in plan.tiles:
        block = block_scene(street, plan.ground, tile)
        assert tuple(view.name for view in block.train_views) == tile.views
        places = plan.ground.places(block.points.positions)
        inside = contains(tile.padded, places)
        assert inside.sum() == contains(tile.padded, plan.ground.places(street.points.positions)).sum()
        assert 0 < (~inside).sum() <= inside.sum()  # the views from afar show both
        seen = times_seen([view.camera for view in block.train_views], block.points.positions)
        assert (seen[~inside] > 0).all()
        again = block_scene(street, plan.ground, tile)
        np.testing.assert_array_equal(again.points.positions, block.points.positions)
        assert block.test_views == street.test_views
    crowded = plan_tiles(street, 6, 1)
    block = block_scene(street, crowded.ground, crowded.tiles[0])
    inside = contains(crowded.tiles[0].padded, crowded.ground.places(block.points.positions))
    assert (~inside).sum() == inside.sum()


def test_a_plan_of_another_scene_is_refused(street: Scene) -> None:
    plan = plan_tiles(street, 2, 1)
    fewer = replace(street, train_views=street.train_views[5:])
    with pytest.raises(SceneError, match="views that are not there, such as left_0"):
        for tile in plan.tiles:
            block_scene(fewer, plan.ground, tile)


def test_too_many_tiles_are_refused_with_the_remedy(street: Scene) -> None:
    with pytest.raises(ConfigError, match=r"expected at least 100; use fewer tiles"):
        plan_tiles(street, 20, 20)
    away = {f"{i}": camera_at((-20, 12 + i, 2), (-20, 99, 0)) for i in range(9)}
    with pytest.raises(ConfigError, match="no view shows tile 0_0; use fewer tiles"):
        plan_tiles(scene_of(street.points.positions, away), 2, 1)


@pytest.mark.parametrize(("text", "grid"), [("auto", None), ("1x1", (1, 1)), ("12x3", (12, 3))])
def test_grids_are_read_as_they_are_written(text: str, grid: tuple[int, int] | None) -> None:
    assert parse_grid(text) == grid


@pytest.mark.parametrize("text", ["", "4", "0x2", "2x0", "-1x2", "2 x 2", "33x32", "2x2x2", "AUTO"])
def test_grids_that_are_none_are_refused(text: str) -> None:
    with pytest.raises(ConfigError, match="expected auto, or columns and rows such as 4x2"):
        parse_grid(text)


def test_auto_gives_a_tile_for_so_many_points_or_views_about_square(street: Scene) -> None:
    assert grid_for(street) == (1, 1)
    rng = np.random.default_rng(5)
    wide = rng.uniform(-1, 1, (1_000_000, 3)) * [80, 10, 0.1]
    cameras = {"a": camera_at((0, 30, 9), (0, 0, 0)), "b": camera_at((3, 30, 9), (3, 0, 0))}
    assert grid_for(scene_of(wide, cameras)) == (4, 1)
    square = rng.uniform(-1, 1, (1_000_000, 3)) * [11, 10, 0.1]
    assert grid_for(scene_of(square, cameras)) == (2, 2)
    many = {f"{i}": cameras["a"] for i in range(801)}
    assert math.prod(grid_for(scene_of(wide[:1000], many))) == 3


def test_a_plan_is_read_as_it_was_written(street: Scene, tmp_path: Path) -> None:
    plan = plan_tiles(street, 3, 2)
    write_plan(tmp_path, plan)
    assert read_plan(tmp_path / "plan.json") == plan
    assert plan.grid == "3x2" and plan.tile("2_1") is plan.tiles[5]
    with pytest.raises(ConfigError, match="tile '3_0': not of the plan, which has 0_0, 0_1"):
        plan.tile("3_0")


def test_what_is_no_plan_is_refused(street: Scene, tmp_path: Path) -> None:
    write_plan(tmp_path, plan_tiles(street, 2, 1))
    path = tmp_path / "plan.json"
    content = json.loads(path.read_text())
    for damaged in (
        "rubbish",
        json.dumps([]),
        json.dumps({**content, "schema": "compgs tiles plan 2"}),
        json.dumps({**content, "ground": {"origin": [0, 0, 0]}}),
        json.dumps({**content, "tiles": [{"name": "0_0"}]}),
    ):
        path.write_text(damaged)
        with pytest.raises(CheckpointError, match="not a plan of tiles"):
            read_plan(path)
    with pytest.raises(CheckpointError, match="cannot be read"):
        read_plan(tmp_path / "none" / "plan.json")


def test_cores_are_half_open() -> None:
    core = Core((0.0, -math.inf), (2.0, 1.0))
    places = np.array([[0, 0], [2, 0], [1.999, -1e9], [1, 1], [-1e-9, 0]])
    assert contains(core, places).tolist() == [True, False, True, False, False]
