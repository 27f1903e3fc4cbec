"""Cameras for splats alone: they see what matters, stand where there is room, and are the same every time."""

from dataclasses import replace

import numpy as np
import pytest

from compgs.cameras import Camera
from compgs.compressing.placing import Placed, cover, place_cameras
from compgs.compressing.probing import Probe, probe
from compgs.compressing.shape import shape_of, weighted_quantile
from compgs.compressing.surroundings import Lens, Surroundings
from compgs.errors import SceneError
from compgs.model.splats import SplatModel

LENS = Lens(64, 48)
UP = np.array([0.0, -1.0, 0.0])


@pytest.fixture(scope="module")
def around_ball(ball) -> Placed:
    return place_cameras(ball.model, 40, 6, lens=LENS)


@pytest.fixture(scope="module")
def in_room(room) -> Placed:
    return place_cameras(room.model, 24, 6, lens=LENS)


def centers(cameras: tuple[Camera, ...]) -> np.ndarray:
    return np.stack([camera.center for camera in cameras])


def test_floaters_move_neither_the_middle_nor_the_radius(ball) -> None:
    shape = shape_of(ball.model)
    np.testing.assert_allclose(shape.middle, [3, 0, 0], atol=0.2)
    assert 0.9 < shape.radius < 1.2


def test_a_weighted_quantile_is_that_of_values_that_come_more_often() -> None:
    rng = np.random.default_rng(0)
    values, times = rng.normal(size=50), rng.integers(1, 9, 50)
    repeated = np.sort(np.repeat(values, times))
    for share in (0.1, 0.5, 0.77):
        expected = repeated[int(np.ceil(share * len(repeated))) - 1]
        assert weighted_quantile(values, times.astype(float), share) == expected


def test_every_splat_that_matters_is_seen_by_several_cameras(ball, around_ball: Placed) -> None:
    """A splat on a sphere is seen from where it faces the camera; no probe is asked."""
    normals = ball.model.splats.means[ball.solid] - [3, 0, 0]
    times = np.zeros(len(normals))
    for camera in around_ball.train:
        local = (normals + np.array([3, 0, 0])) @ camera.rotation.T + camera.translation
        pixels = local[:, :2] / local[:, 2:] * camera.fx + [camera.cx, camera.cy]
        inside = (local[:, 2] > 0) & ((pixels >= 0) & (pixels <= [camera.width, camera.height])).all(1)
        times += inside & ((normals * (camera.center - [3, 0, 0] - normals)).sum(1) > 0)
    below = normals[:, 1] > 0.7  # y is down; from straight below hardly anybody looks
    assert times[~below].min() >= 2 and (times >= 2).mean() > 0.95 and np.median(times) >= 5


def test_cameras_of_an_object_stand_around_it_and_mostly_above(ball, around_ball: Placed) -> None:
    offsets = centers(around_ball.train) - [3, 0, 0]
    assert np.linalg.norm(offsets, axis=1).min() > 1.1
    assert len({tuple(signs) for signs in (offsets[:, [0, 2]] > 0).tolist()}) == 4
    assert (offsets[:, 1] < 0.3).mean() > 0.6  # y is down


def test_cameras_of_a_room_stand_in_it_and_not_in_its_walls(room, in_room: Placed) -> None:
    for cameras in (in_room.train, in_room.held_out):
        assert np.abs(centers(cameras)).max() < 2.0
        for camera in cameras:
            looked = probe(room.model, camera)
            assert looked.in_the_way <= 0.05 and looked.covered > 0.8


def test_a_ball_is_open_and_a_room_is_closed(ball, room) -> None:
    chance = np.random.default_rng(0)
    assert Surroundings(ball.model, shape_of(ball.model), LENS, UP, chance).outside() == 1.0
    assert Surroundings(room.model, shape_of(room.model), LENS, UP, chance).outside() < 0.1


def test_cameras_to_judge_by_are_others_and_near_those_trained_on(around_ball: Placed) -> None:
    distances = np.linalg.norm(
        centers(around_ball.held_out)[:, None] - centers(around_ball.train), axis=2
    ).min(1)
    assert len(around_ball.train) == 40 and len(around_ball.held_out) == 6
    assert distances.min() > 1e-3 and distances.max() < 1.5


def test_a_seed_gives_the_same_cameras_and_another_one_others(ball) -> None:
    one, again, other = (place_cameras(ball.model, 4, 2, lens=LENS, seed=seed) for seed in (5, 5, 6))
    for first, second in zip((*one.train, *one.held_out), (*again.train, *again.held_out), strict=True):
        np.testing.assert_array_equal(first.world_to_camera, second.world_to_camera)
    assert not np.allclose(centers(one.train), centers(other.train))


def test_cameras_are_of_the_world_where_the_model_is_far_from_its_origin(ball) -> None:
    offset = (1e5, 0.0, -2e5)
    here = place_cameras(ball.model, 4, 2, lens=LENS)
    there = place_cameras(ball.model.at(offset), 4, 2, lens=LENS)
    np.testing.assert_allclose(centers(there.train) - offset, centers(here.train), atol=1e-6)


def test_splats_that_hardly_show_are_refused(ball) -> None:
    splats = ball.model.splats
    faint = replace(splats, opacity_logits=np.full_like(splats.opacity_logits, -8.0))
    with pytest.raises(SceneError, match="no place was found"):
        place_cameras(SplatModel(faint, (0.0, 0.0, 0.0)), 2, 1, lens=LENS)


def seeing(*splats: int, weight: float = 1.0) -> Probe:
    return Probe(np.array(splats), np.full(len(splats), weight, dtype=np.float32), 1.0, 0.0)


def test_first_all_is_seen_once_then_twice() -> None:
    """Four splats; one candidate sees three, others the pairs: by hand."""
    candidates = [seeing(0, 1, 2), seeing(2, 3), seeing(0, 1), seeing(3)]
    chance = np.random.default_rng(0)
    # 3; then {2, 3} adds 1/2 + 1, {0, 1} 1/2 + 1/2, {3} 1; then {0, 1} adds 1, {3} 1/2.
    assert cover(candidates, np.ones(4), np.ones(4), 3, chance) == [0, 1, 2]


def test_a_splat_that_is_seen_from_afar_does_not_count_as_seen() -> None:
    candidates = [seeing(0, 1, weight=0.05), seeing(0), seeing(1)]
    assert cover(candidates, np.ones(2), np.ones(3), 2, np.random.default_rng(0)) == [1, 2]


def test_what_is_seen_already_counts_less_for_a_candidate_that_is_liked_less() -> None:
    candidates = [seeing(0, 1, 2), seeing(0, 1, 2), seeing(1, 2), seeing(3)]
    # After the first: {0, 1, 2} again 0.2 x 3/2, {1, 2} again 1, {3} for the first time 1, liked or not.
    liking = np.array([1.0, 0.2, 0.9, 0.2])
    assert cover(candidates, np.ones(4), liking, 3, np.random.default_rng(0)) == [0, 3, 2]


@pytest.mark.parametrize(("until", "looked_at"), [(None, 240), (1e9, 240), (0.0, 60)])
def test_where_time_is_short_fewer_places_are_looked_for(ball, until: float | None, looked_at: int) -> None:
    told: list[int] = []
    found = place_cameras(
        ball.model, 80, 2, lens=LENS, until=until, progress=lambda done, _: told.append(done)
    )
    assert told[-1] == looked_at and len(found.train) == min(80, looked_at) and len(found.held_out) == 2
