"""Ways lead around what is in their way, and stay as they are where nothing is."""

import itertools

import numpy as np

from compgs.cameras import Camera
from compgs.evaluation.camera_path import look_at, orbit
from compgs.evaluation.clearance import COVERED, FreeSpace, clear_orbit, covered_by_near
from compgs.evaluation.tour import tour, tour_order
from compgs.model.splats import SplatArrays, SplatModel

UP = np.array([0.0, 0.0, 1.0])
PICTURES = {"frames": 40, "width": 64, "height": 48}


def balls(
    *centers: tuple[float, float, float], radii: tuple[float, ...] = (1.0,), backdrop: float = 12.0
) -> SplatModel:
    """Opaque balls of many small splats, in a room of distant ones."""
    radii = radii * len(centers) if len(radii) == 1 else radii
    chance = np.random.default_rng(0)
    directions = chance.normal(size=(1500, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    around = [np.array(c) + r * directions for c, r in zip(centers, radii, strict=True)]
    means = np.concatenate([*around, backdrop * directions])
    sizes = np.concatenate([*(np.full(1500, 0.06 * r) for r in radii), np.full(1500, 0.03 * backdrop)])
    n = len(means)
    return SplatModel(
        SplatArrays(
            means=means.astype(np.float32),
            log_scales=np.log(sizes)[:, None].repeat(3, 1).astype(np.float32),
            quaternions=np.tile(np.float32([1, 0, 0, 0]), (n, 1)),
            opacity_logits=np.full(n, 4.0, np.float32),
            dc=np.zeros((n, 3), np.float32),
            rest=np.zeros((n, 0, 3), np.float32),
        ),
        (0.0, 0.0, 0.0),
    )


def looking(eye: tuple[float, float, float], target: tuple[float, float, float]) -> Camera:
    return Camera(look_at(np.array(eye), np.array(target), UP), 60.0, 60.0, 32.0, 24.0, 64, 48)


def nearest_to_origin(cameras: list[Camera]) -> float:
    return min(float(np.linalg.norm(camera.center)) for camera in cameras)


def test_what_is_nearer_covers_and_what_is_farther_does_not() -> None:
    model, camera = balls((0, 0, 0)), looking((3.0, 0, 0), (0, 0, 0))
    assert covered_by_near(model, camera, 1.5) == 0.0  # the ball begins at a distance of 2
    whole = covered_by_near(model, camera, 4.5)
    # The ball is seen under an angle whose sine is a third; its splats reach beyond it by up to three deviations.
    smallest, largest = (np.pi * (60 * np.tan(np.arcsin(r / 3))) ** 2 / (64 * 48) for r in (1.0, 1.18))
    assert smallest < whole < largest
    assert covered_by_near(model, camera, 40.0) > 0.8  # with what is behind it


def test_a_way_that_would_lead_through_something_leads_around_by_other_cameras() -> None:
    model = balls((0, 0, 0))
    around = [looking((3.0 * np.cos(a), 3.0 * np.sin(a), 0.0), (0, 0, 0)) for a in np.linspace(0, np.pi, 5)]
    straight = tour([around[0], around[-1]], **PICTURES)
    assert nearest_to_origin([camera for _, camera in straight]) < 0.3
    space = FreeSpace(model, around)
    assert not space.is_passable(around[0], around[-1])
    assert space.is_passable(around[0], around[1])
    way = space.kept_clear([c for _, c in tour(around, **PICTURES, passable=space.is_passable)])
    assert len(way) == PICTURES["frames"]
    assert nearest_to_origin(way) > 2.0
    assert max(space.covered(camera) for camera in way) <= COVERED


def test_the_way_comes_back_by_the_cameras_that_it_went_where_nothing_else_is_passable() -> None:
    cameras = [looking((x, 0.0, 0.0), (x, 9.0, 0.0)) for x in (0.0, 1.0, 2.0, 9.0)]
    order, closed = tour_order(cameras, lambda one, other: abs(one.center[0] - other.center[0]) < 1.5)
    assert not closed and sorted(order) == [0, 1, 2, 3]
    star = [looking((0, 0, 0), (9, 0, 0))] + [
        looking((np.cos(a), np.sin(a), 0), (9, 0, 0)) for a in (0.0, 2.1, 4.2)
    ]
    order, _ = tour_order(star, lambda one, other: min(np.linalg.norm(c.center) for c in (one, other)) < 0.5)
    legs = list(itertools.pairwise(order))
    assert set(order) == {0, 1, 2, 3} and all(0 in leg for leg in legs)


def test_a_frame_close_to_something_makes_a_small_detour_and_others_stay() -> None:
    model = balls((0.0, 1.0, 0.0), radii=(0.5,))
    # A straight way, looking across it; the ball is near its middle.
    way = [looking((x, 0.0, 0.0), (x, 9.0, 0.0)) for x in np.linspace(-6, 6, 61)]
    known = [looking((x, 0.0, 0.0), (x, 9.0, 0.0)) for x in (-6.0, 6.0)]
    space = FreeSpace(model, known)
    before = [space.covered(camera) for camera in way]
    assert max(before) > COVERED
    clear = space.kept_clear(way)
    assert max(space.covered(camera) for camera in clear) < max(before)
    np.testing.assert_array_equal(clear[0].world_to_camera, way[0].world_to_camera)
    np.testing.assert_array_equal(clear[-1].world_to_camera, way[-1].world_to_camera)
    steps = np.linalg.norm(np.diff([camera.center for camera in clear], axis=0), axis=1)
    assert steps.max() < 8 * np.median(steps)  # nothing jumps


def test_a_way_that_is_clear_stays_as_it_is() -> None:
    model = balls((0, 0, 0))
    ring = [looking((4 * np.cos(a), 4 * np.sin(a), 0), (0, 0, 0)) for a in np.arange(8) * np.pi / 4]
    space = FreeSpace(model, ring)
    plain = [camera for _, camera in tour(ring, **PICTURES)]
    kept = space.kept_clear([c for _, c in tour(ring, **PICTURES, passable=space.is_passable)])
    for one, other in zip(plain, kept, strict=True):
        np.testing.assert_array_equal(one.world_to_camera, other.world_to_camera)


def test_the_circle_rises_over_what_stands_in_it_and_else_is_the_usual_one() -> None:
    usual = {"frames": 12, "width": 64, "height": 48, "up": (0.0, 0.0, 1.0)}
    free = balls((0, 0, 0), backdrop=0.5)
    circle = clear_orbit(free, **usual, elevations=(25.0, 60.0), distances=(2.2,))
    plain = orbit(free.bounds[0], **usual, elevation=25.0, distance=2.2)
    for (_, one), (_, other) in zip(circle, plain, strict=True):
        np.testing.assert_array_equal(one.world_to_camera, other.world_to_camera)
    eye = plain[3][1].center
    # One large splat before the circle's fourth camera: it does not move the middle of the scene.
    one = balls(tuple(0.9 * eye), backdrop=0.5).splats
    rows = {name: getattr(one, name)[:1] for name in ("quaternions", "opacity_logits", "dc", "rest")}
    splat = {**rows, "means": np.float32([0.9 * eye]), "log_scales": np.full((1, 3), -2.0, np.float32)}
    merged = {name: np.concatenate([getattr(free.splats, name), splat[name]]) for name in splat}
    blocked = SplatModel(SplatArrays(**merged), (0.0, 0.0, 0.0))
    scene = clear_orbit(blocked, **usual, elevations=(25.0, 60.0), distances=(2.2,))
    fixed = orbit(blocked.bounds[0], **usual, elevation=60.0, distance=2.2)
    np.testing.assert_array_equal(scene[0][1].world_to_camera, fixed[0][1].world_to_camera)
