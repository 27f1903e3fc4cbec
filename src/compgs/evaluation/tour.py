"""A way through a scene along cameras that it was captured from: where they stood there is something to see."""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from compgs.cameras import Camera
from compgs.errors import UnsupportedCamera
from compgs.numerics.rotations import quaternion_from_rotation, rigid, rotation_from_quaternion

# Of the tour's other legs' median: a longer leg leads through what nobody has seen, and is left out.
LONGEST_LEG = 3.0
BLOCKED = 100.0  # of the greatest distance: what a way costs that is not passable
TURNING = 1.0  # spreads of the positions that a change of direction by one (of unit vectors) counts as


def tour(
    cameras: Sequence[Camera],  # at least 2, in any order
    *,
    frames: int,
    width: int,
    height: int,
    passable: Callable[[Camera, Camera], bool] | None = None,
) -> list[tuple[str, Camera]]:
    """`frames` cameras on a smooth way along the given ones, with the first one's field of view across.

    The shortest round tour (nearest neighbours, then 2-opt), without its longest leg where that is much longer than
    the others; see `way_through`. Where it is not `passable` from one camera to another, the way leads by others, if
    there is such a way. Raises UnsupportedCamera for fewer than two cameras.
    """
    if len(cameras) < 2:
        raise UnsupportedCamera(f"a way along cameras needs two of them, found {len(cameras)}")
    order, closed = tour_order(cameras, passable)
    first = cameras[0]
    across = first.fx / first.width
    chosen = [replace(cameras[i], fx=across * cameras[i].width) for i in order]
    way = way_through(chosen, frames=frames, width=width, height=height, closed=closed)
    return [(f"tour {i}", camera) for i, camera in enumerate(way)]


def way_through(
    cameras: Sequence[Camera],  # at least 2, in this order
    *,
    frames: int,
    width: int,
    height: int,
    closed: bool = False,
) -> list[Camera]:
    """`frames` cameras on a smooth way through the given ones, from first to last or, `closed`, on to the first.

    Positions by centripetal Catmull-Rom splines, rotations by spherical interpolation, fields of view across by the
    ratio of focal length and width. The pace is equal: all turning takes as long as all moving. Raises
    UnsupportedCamera for fewer than two cameras.
    """
    if len(cameras) < 2:
        raise UnsupportedCamera(f"a way along cameras needs two of them, found {len(cameras)}")
    chosen = [*cameras, cameras[0]] if closed else list(cameras)
    centers = np.stack([camera.center for camera in chosen])
    rotations = _same_side(np.stack([quaternion_from_rotation(camera.rotation) for camera in chosen]))
    lenses = np.log([camera.fx / camera.width for camera in chosen])
    legs = _legs(centers, rotations)
    knots = np.concatenate([[0.0], np.cumsum(legs)])
    times = np.linspace(0.0, knots[-1], frames + 1)[:-1] if closed else np.linspace(0.0, knots[-1], frames)
    result = []
    for time in times:
        leg = min(int(np.searchsorted(knots, time, side="right")) - 1, len(legs) - 1)
        part = (time - knots[leg]) / legs[leg]
        center = _between(centers, leg, part, closed)
        rotation = rotation_from_quaternion(_slerp(rotations[leg], rotations[leg + 1], part))
        focal = float(np.exp((1 - part) * lenses[leg] + part * lenses[leg + 1])) * width
        pose = rigid(rotation, -rotation @ center)
        result.append(Camera(pose, focal, focal, width / 2, height / 2, width, height))
    return result


def _legs(centers: np.ndarray, rotations: np.ndarray) -> np.ndarray:
    """What each leg takes, above 0: its share of all distances and its share of all turning."""
    moved = np.linalg.norm(np.diff(centers, axis=0), axis=1)
    turned = np.arccos(np.clip((rotations[:-1] * rotations[1:]).sum(axis=1), -1.0, 1.0))
    moved[moved <= 1e-12 * np.abs(centers).max()] = 0.0  # rounding errors
    turned[turned <= 1e-6] = 0.0
    shares = sum((part / part.sum() for part in (moved, turned) if part.any()), np.zeros(len(moved)))
    return np.maximum(shares, 1e-9)


def tour_order(
    cameras: Sequence[Camera], passable: Callable[[Camera, Camera], bool] | None = None
) -> tuple[list[int], bool]:
    """Order of the cameras on their tour, and whether it is closed; an open one begins behind its longest leg. Cameras
    come several times where the way between two others leads by them.
    """
    distance, by = _passable_distances(cameras, passable)
    order = [0]
    left = set(range(1, len(cameras)))
    while left:
        order.append(min(left, key=lambda i: (distance[order[-1], i], i)))
        left.remove(order[-1])
    order = _two_opt(order, distance)
    legs = [distance[a, b] for a, b in zip(order, [*order[1:], order[0]], strict=True)]
    longest = int(np.argmax(legs))
    others = legs[:longest] + legs[longest + 1 :]
    if len(cameras) > 2 and legs[longest] <= LONGEST_LEG * max(float(np.median(others)), 1e-30):
        return _expanded([*order, order[0]], by)[:-1], True
    return _expanded(order[longest + 1 :] + order[: longest + 1], by), False


def _passable_distances(
    cameras: Sequence[Camera], passable: Callable[[Camera, Camera], bool] | None
) -> tuple[np.ndarray, np.ndarray]:
    """[V, V] distances on the shortest passable ways, and [V, V] int64: which camera comes next on such a way."""
    distance, count = _distances(cameras), len(cameras)
    following = np.tile(np.arange(count), (count, 1))
    if passable is None:
        return distance, following
    straight = distance.copy()
    for one, other in itertools.combinations(range(count), 2):
        if not passable(cameras[one], cameras[other]):
            straight[one, other] = straight[other, one] = np.inf
    shortest = straight.copy()
    for by in range(count):  # Floyd and Warshall
        detour = shortest[:, by, None] + shortest[by]
        shorter = detour < shortest - 1e-12
        following[shorter] = np.broadcast_to(following[:, by, None], following.shape)[shorter]
        shortest[shorter] = detour[shorter]
    # Where only what is in the way leads from one to the other: as straight as the crow flies, and last of all.
    far = BLOCKED * max(float(distance.max()), 1e-30)
    blocked = np.isinf(shortest)
    return np.where(blocked, far + distance, shortest), following


def _expanded(order: Sequence[int], following: np.ndarray) -> list[int]:
    """Insert the cameras that the way from one to the next leads by."""
    result = [order[0]]
    for camera in order[1:]:
        while result[-1] != camera:
            result.append(int(following[result[-1], camera]))
    return result


def _distances(cameras: Sequence[Camera]) -> np.ndarray:
    """[V, V]: of positions, in units of their spread, and of viewing directions."""
    centers = np.stack([camera.center for camera in cameras])
    centers = centers - centers.mean(0)
    spread = max(float(np.sqrt((centers**2).sum(1).mean())), 1e-30)
    places = np.concatenate([centers / spread, TURNING * np.stack([c.rotation[2] for c in cameras])], 1)
    return np.linalg.norm(places[:, None] - places[None], axis=2)


def _two_opt(order: list[int], distance: np.ndarray) -> list[int]:
    """Turn pieces of a round tour around while that makes it shorter."""
    better = True
    while better:
        better = False
        for i in range(len(order) - 2):
            for j in range(i + 2, len(order) - (i == 0)):
                a, b, c, d = order[i], order[i + 1], order[j], order[(j + 1) % len(order)]
                if distance[a, c] + distance[b, d] < distance[a, b] + distance[c, d] - 1e-12:
                    order[i + 1 : j + 1] = order[i + 1 : j + 1][::-1]
                    better = True
    return order


def _same_side(quaternions: np.ndarray) -> np.ndarray:
    """q and -q are one rotation: each is taken near to the one before."""
    result = quaternions.copy()
    for i in range(1, len(result)):
        if result[i] @ result[i - 1] < 0:
            result[i] = -result[i]
    return result


def _slerp(a: np.ndarray, b: np.ndarray, part: float) -> np.ndarray:
    angle = float(np.arccos(np.clip(a @ b, -1.0, 1.0)))
    if angle < 1e-6:
        return a + part * (b - a)
    return (np.sin((1 - part) * angle) * a + np.sin(part * angle) * b) / np.sin(angle)


def _between(points: np.ndarray, leg: int, part: float, closed: bool) -> np.ndarray:
    """Return a place on a spline through the points, `part` of the way between two (Barry and Goldman 1988)."""
    n = len(points) - 1
    if not closed:  # beyond its ends it goes straight on, so that it neither starts nor stops slowly
        points = np.concatenate([2 * points[:1] - points[1:2], points, 2 * points[-1:] - points[-2:-1]])
        leg, n = leg + 1, n + 3
    before, after = points[(leg - 1) % n], points[(leg + 2) % n]
    p = [before, points[leg], points[leg + 1], after]
    knots = [0.0]
    for a, b in itertools.pairwise(p):
        knots.append(knots[-1] + max(float(np.linalg.norm(b - a)) ** 0.5, 1e-12))
    t = knots[1] + part * (knots[2] - knots[1])
    for level in range(1, 4):
        # As a step from one point: exact where two are in one place, and far from the origin.
        p = [
            p[i] + (t - knots[i]) / (knots[i + level] - knots[i]) * (p[i + 1] - p[i])
            for i in range(4 - level)
        ]
    return p[0]
