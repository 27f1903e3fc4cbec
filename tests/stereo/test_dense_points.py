"""Dense points, against the surfaces of a scene that is known: rays are traced to where the points are said to be."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from compgs.cameras import Camera
from compgs.config import Config
from compgs.numerics.evenly import evenly
from compgs.scene import ray_tracing
from compgs.scene.generated import camera_path, observe, still_life
from compgs.scene.points import fallback_points
from compgs.scene.views import Points, Scene, View
from compgs.stereo import dense_points, expected_points
from compgs.stereo.fusion import Places, thinned
from compgs.stereo.neighbours import neighbours_of, sight_of
from compgs.training.plan import plan
from compgs.training.start import initial_model, start_of, with_dense_points, with_seen_points

CPU = torch.device("cpu")


@pytest.fixture(scope="module")
def solids() -> ray_tracing.Solids:
    return still_life(np.random.default_rng(0))


@pytest.fixture(scope="module")
def scene(solids: ray_tracing.Solids) -> Scene:
    """The still life in 24 photographs, with a tenth of the points that would be found of it."""
    chance = np.random.default_rng(0)
    cameras = camera_path(24, 112, 84)
    photographs = [ray_tracing.render(solids, camera) for camera in cameras]
    names = [f"{number}.png" for number in range(len(cameras))]
    _, points = observe(solids, cameras, names, photographs, chance)
    views = tuple(View(*view) for view in zip(names, cameras, photographs, strict=True))
    sparse = Points(points.positions[::10], points.colors[::10])
    return Scene(
        name="still life",
        points=sparse,
        train_views=views,
        test_views=(),
        background=(0.0, 0.0, 0.0),
        extent=3.0,
        source=Path("."),
    )


@pytest.fixture(scope="module")
def found(scene: Scene) -> Points:
    return dense_points(scene, 4.0, CPU)


def misses(solids: ray_tracing.Solids, positions: np.ndarray, cameras: list[Camera]) -> np.ndarray:
    """[P] how far positions are from what a ray to them hits, over its length; of the best of the cameras."""
    best = np.full(len(positions), np.inf)
    for camera in cameras:
        way = positions - camera.center
        length = np.linalg.norm(way, axis=1)
        origins = np.repeat(camera.center[None], len(way), 0)
        best = np.minimum(
            best, np.abs(ray_tracing.trace(solids, origins, way / length[:, None]) / length - 1)
        )
    return best


def test_dense_points_lie_on_the_surfaces(scene: Scene, solids: ray_tracing.Solids, found: Points) -> None:
    assert len(found) > 3 * len(scene.points)
    cameras = [view.camera for view in scene.train_views]
    assert np.mean(misses(solids, found.positions, cameras) < 0.03) > 0.9
    # ... and those beside them do not, so that the measure says something: the scene is 3 units large.
    moved = found.positions + np.random.default_rng(1).uniform(-0.6, 0.6, (len(found), 3))
    assert np.mean(misses(solids, moved, cameras) < 0.03) < 0.6


@pytest.mark.slow
def test_masked_pixels_have_no_points(scene: Scene) -> None:
    nothing = np.zeros((84, 112), bool)
    masked = replace(scene, train_views=tuple(replace(view, counted=nothing) for view in scene.train_views))
    assert len(dense_points(masked, 4.0, CPU)) == 0


def test_views_that_see_no_points_say_nothing(scene: Scene) -> None:
    far = Points(scene.points.positions + 1e6, scene.points.colors)
    assert len(dense_points(replace(scene, points=far), 4.0, CPU)) == 0


def test_how_many_points_there_will_be_is_known_within_a_factor_of_two(scene: Scene, found: Points) -> None:
    assert 0.5 * len(found) < expected_points(scene, 4.0) < 2.0 * len(found)


@pytest.mark.slow
@pytest.mark.parametrize("spacing", [2.0, 8.0])
def test_how_many_points_there_will_be_is_known_at_other_spacings(scene: Scene, spacing: float) -> None:
    found = len(dense_points(scene, spacing, CPU))
    assert 0.5 * found < expected_points(scene, spacing) < 2.0 * found


def test_neighbours_stand_a_little_aside() -> None:
    def camera(x: float) -> Camera:
        pose = np.eye(4)
        pose[0, 3] = -x
        return Camera(pose, 100.0, 100.0, 50.0, 50.0, 100, 100)

    points = np.random.default_rng(0).uniform((-3, -3, 9.5), (3, 3, 10.5), (500, 3))
    # 10 units before the points a baseline of .12 is 1.2 units.
    cameras = [camera(x) for x in (0.0, 0.05, 0.6, 1.2, 1.3, 2.4, 6.0)]
    assert neighbours_of(0, cameras, [sight_of(c, points) for c in cameras]) == [3, 4, 2, 5]


def test_cells_grow_with_the_distance_and_known_places_stay_alone() -> None:
    positions = np.repeat([[0.0, 0, 0], [0.4, 0, 0], [10, 0, 0], [10.4, 0, 0], [20, 0, 0]], 3, 0) + 0.01
    footprints = np.repeat([0.1, 0.1, 0.6, 0.6, 0.1], 3)
    places = Places(positions, np.full((15, 3), 7, np.uint8), footprints)
    kept = thinned(places, 2.5, np.array([[20.0, 0, 0]]))
    # Cells of .25 part the first two, a cell of 1 unites the next two, and the last is known.
    np.testing.assert_allclose(np.sort(kept.positions[:, 0]), [0.01, 0.41, 10.21])
    assert (
        len(thinned(replace(places, positions=positions + np.arange(15)[:, None]), 2.5, np.zeros((1, 3))))
        == 0
    )


def test_a_run_begins_with_the_dense_points(scene: Scene, found: Points) -> None:
    config = Config()
    start = start_of(scene, config, CPU, 25_000)
    assert plan(config, start).dense_points > 0
    sparse = plan(config, start_of(scene, config, CPU, 300))
    assert sparse.dense_points == 0
    assert plan(config, replace(start, points_at_hand=True)).dense_points == 0
    few = initial_model(scene, config, CPU, sparse).anchors
    many = initial_model(scene, config, CPU, replace(sparse, dense_points=4.0)).anchors
    # Several of the points share a voxel, which goes by the sparse ones.
    assert 2 * few < many <= few + len(found)


def test_random_points_give_way_to_those_that_photographs_show(
    scene: Scene, solids: ray_tracing.Solids
) -> None:
    cameras = [view.camera for view in scene.train_views]
    guessed = replace(scene, points=fallback_points(cameras, 2_000), guessed=True)
    dense = replace(plan(Config(), start_of(scene, Config(), CPU, 300)), dense_points=4.0)

    def on_surfaces(scene: Scene) -> float:
        anchors = initial_model(scene, Config(), CPU, dense).positions().numpy()
        return float(np.mean(misses(solids, anchors, cameras) < 0.05))

    assert on_surfaces(guessed) > 0.8 > 0.65 > on_surfaces(replace(guessed, guessed=False))


def test_random_points_stay_where_photographs_show_too_few(scene: Scene) -> None:
    nothing = np.zeros((84, 112), bool)
    masked = tuple(replace(view, counted=nothing) for view in scene.train_views)
    guessed = replace(scene, train_views=masked, guessed=True)
    assert with_seen_points(guessed, 4.0, CPU) is guessed


@pytest.mark.slow
def test_the_same_photographs_give_the_same_points_and_no_more_than_there_is_room_for(
    scene: Scene, found: Points
) -> None:
    more = with_dense_points(scene, 4.0, 100, CPU).points
    added = evenly(len(found), 100)
    np.testing.assert_array_equal(more.positions[len(scene.points) :], found.positions[added])
    np.testing.assert_array_equal(more.colors[len(scene.points) :], found.colors[added])


def test_a_choice_of_few_is_spread_evenly() -> None:
    assert evenly(10, 4) == [0, 2, 5, 7]
    assert evenly(3, 9) == [0, 1, 2]
    assert evenly(3, -1) == []
