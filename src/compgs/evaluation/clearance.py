"""Ways that keep clear of what is near: between two cameras of a capture there may be a wall, or a bush.

A camera is *close* to something where what is nearer than its `reach` covers much of its picture. Cameras of a capture
stood where there was room, and a way's frames are to have a part of that room. From one camera to another the way goes
straight where that is clear, and by other cameras where it is not (`tour`). Where single frames are still close to
something, the way makes a small detour there: sideways, upwards or back.
"""

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from compgs.cameras import Camera
from compgs.evaluation.camera_path import orbit
from compgs.evaluation.tour import way_through
from compgs.gaussians import Gaussians
from compgs.numerics.rotations import rigid
from compgs.render import Renderable
from compgs.render.rasterize import rasterize
from compgs.render.render_model import local_camera, settings_of
from compgs.render.visibility import visible_mask

PROBE_PIXELS = 64  # longer side of the small pictures that are looked at
COVERED = 0.15  # of a picture, by what is too near: then the camera is close to it
STEPS = 8  # of a straight way between two cameras, that are looked at
PART = 0.7  # of the room that the nearest cameras of a capture have, which a frame is to have
LADDER = 2.0 ** -np.arange(0.0, 8.0, 0.5)  # distances that are tried, as parts of the scene's
# Detours: directions in the camera's axes (x right, y down, z forward), and lengths in units of the reach.
ASIDE = [np.array([x, y, 0.0]) for x, y in ((0, -1), (1, 0), (-1, 0), (1, -1), (-1, -1), (0, 1))]
BACK = [np.array([x, y, -1.0]) for x, y in ((0, 0), (0, -1), (1, 0), (-1, 0))]
DIRECTIONS = [direction / np.linalg.norm(direction) for direction in (*ASIDE, *BACK)]
LENGTHS = (0.25, 0.5, 0.75, 1.0, 1.5)
LOOKS = 16  # cameras of a circle that are looked at
OF_CIRCLE = 0.3  # of the way to the middle: what is nearer to a camera on a circle is in its way
EASING = 12  # a detour begins and ends within this part of the way's frames before and after it, at least: 1 of so many


def covered_by_near(model: Renderable, camera: Camera, reach: float) -> float:
    """Share of a camera's picture, 0 to 1, that is covered by what is nearer than `reach` world units."""
    small = local_camera(model, _small(camera))
    settings = replace(settings_of(model), background=(0.0, 0.0, 0.0))
    centers, radii = model.bounds
    near = np.linalg.norm(centers - small.center, axis=1) - radii < reach
    near &= np.asarray(visible_mask(centers, radii, small, settings))
    if not near.any():
        return 0.0
    seen = model.gaussians(small, near)
    depths = np.linalg.norm(seen.means - small.center.astype(np.float32), axis=1)
    chosen = depths < reach
    if not chosen.any():
        return 0.0
    white = np.ones((int(chosen.sum()), 3), np.float32)
    lit = Gaussians(
        seen.means[chosen], seen.quaternions[chosen], seen.scales[chosen], seen.opacities[chosen], white
    )
    return float(np.clip(rasterize(lit, small, settings).image, 0.0, 1.0).mean())


def room_of(model: Renderable, camera: Camera) -> float:
    """How far a camera is from what it sees, world units: within that, little of its picture is covered."""
    centers, _ = model.bounds
    farthest = float(np.median(np.linalg.norm(centers - local_camera(model, camera).center, axis=1)))
    for part in LADDER:
        if covered_by_near(model, camera, part * farthest) < COVERED:
            return float(part * farthest)
    return float(LADDER[-1] * farthest)


class FreeSpace:
    """Where there is room in a scene, as the cameras of its capture tell."""

    def __init__(self, model: Renderable, known: Sequence[Camera]) -> None:
        self.model = model
        self.rooms = np.array([room_of(model, camera) for camera in known])
        self.places = np.stack([camera.center for camera in known])

    def reach(self, frame: Camera) -> float:
        """A part of the room that the two nearest cameras of the capture have, world units."""
        nearest = np.argsort(np.linalg.norm(self.places - frame.center, axis=1))[:2]
        return PART * float(self.rooms[nearest].min())

    def covered(self, frame: Camera, reach: float | None = None) -> float:
        """Share of a frame's picture that is covered by what is too near."""
        return covered_by_near(self.model, frame, self.reach(frame) if reach is None else reach)

    def is_passable(self, one: Camera, other: Camera) -> bool:
        """Whether the straight way from one camera to another is clear."""
        width, height = one.width, one.height
        between = way_through([one, other], frames=STEPS + 2, width=width, height=height)[1:-1]
        return all(self.covered(frame) <= COVERED for frame in between)

    def kept_clear(self, way: Sequence[Camera]) -> list[Camera]:
        """The frames with small detours around what some of them are close to; the others stay as they are."""
        reaches = [self.reach(frame) for frame in way]
        close = [self.covered(frame, reach) > COVERED for frame, reach in zip(way, reaches, strict=True)]
        result = list(way)
        for first, last in _stretches(np.array(close), _easing(way)):
            result = self._with_detour(result, reaches, first, last)
        return result

    def _with_detour(
        self, way: list[Camera], reaches: Sequence[float], first: int, last: int
    ) -> list[Camera]:
        """The way with the smallest detour that is clear from frame `first` to `last`; the clearest, if none is."""
        easing = max(_easing(way), last - first + 1)
        frames = range(max(0, first - easing), min(len(way), last + easing + 1))
        weights = [_ease(max(first - i, i - last, 0) / easing) for i in frames]
        middle = way[(first + last) // 2]
        unit = max(reaches[first : last + 1])
        best, best_cover = way, max(self.covered(way[i], reaches[i]) for i in frames)
        for length, direction in itertools.product(LENGTHS, DIRECTIONS):
            step = length * unit * (middle.rotation.T @ direction)
            moved = {i: _moved(way[i], weight * step) for i, weight in zip(frames, weights, strict=True)}
            worst = 0.0
            for i, camera in moved.items():
                worst = max(worst, self.covered(camera, reaches[i]))
                if worst >= best_cover:
                    break
            else:
                best = [moved.get(i, camera) for i, camera in enumerate(way)]
                best_cover = worst
            if best_cover <= COVERED:
                break
        return best


def clear_orbit(
    model: Renderable,
    *,
    frames: int,
    width: int,
    height: int,
    up: tuple[float, float, float],
    elevations: Sequence[float],  # degrees above the horizon, the best first
    distances: Sequence[float],  # radii of the scene, the best first
) -> list[tuple[str, Camera]]:
    """The first of the circles around a scene (`orbit`) that is clear all around; the clearest, if none is."""

    def circle(elevation: float, distance: float, frames: int) -> list[tuple[str, Camera]]:
        cameras = orbit(
            model.bounds[0],
            frames=frames,
            width=width,
            height=height,
            up=up,
            elevation=elevation,
            distance=distance,
        )
        # Around the model's own frame; cameras are given in the world's.
        return [(name, camera.moved(-np.array(model.world_offset))) for name, camera in cameras]

    tried = list(itertools.product(elevations, distances))
    middle = np.median(model.bounds[0], axis=0) + np.array(model.world_offset)
    best, best_cover = tried[0], np.inf
    for shape in tried if len(tried) > 1 else ():
        looks = [camera for _, camera in circle(*shape, min(frames, LOOKS))]
        reach = OF_CIRCLE * float(np.linalg.norm(looks[0].center - middle))
        cover = max(covered_by_near(model, camera, reach) for camera in looks)
        if cover < best_cover:
            best, best_cover = shape, cover
        if cover <= COVERED:
            break
    return circle(*best, frames)


def _easing(way: Sequence[Camera]) -> int:
    """Frames in which the way leaves for a detour, or comes back from it, at least."""
    return max(2, len(way) // EASING)


def _stretches(close: np.ndarray, apart: int) -> Iterator[tuple[int, int]]:
    """First and last frame of each stretch of frames that are close to something; those not so far `apart` are one."""
    frames = np.flatnonzero(close)
    if not len(frames):
        return
    cuts = np.flatnonzero(np.diff(frames) > apart)
    starts, ends = [0, *(cuts + 1)], [*cuts, len(frames) - 1]
    for start, end in zip(starts, ends, strict=True):
        yield int(frames[start]), int(frames[end])


def _ease(part: float) -> float:
    """1 at 0, 0 from 1 on, without a kink."""
    return 0.5 * (1.0 + float(np.cos(np.pi * min(part, 1.0))))


def _moved(camera: Camera, step: np.ndarray) -> Camera:
    return replace(camera, world_to_camera=rigid(camera.rotation, -camera.rotation @ (camera.center + step)))


def _small(camera: Camera) -> Camera:
    scale = PROBE_PIXELS / max(camera.width, camera.height)
    return camera.resized(*(max(1, round(side * scale)) for side in (camera.width, camera.height)))
