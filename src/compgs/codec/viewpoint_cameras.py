"""Cameras as the viewpoints that a file holds, and back: from the world to the model's local frame, and back."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from compgs.cameras import Camera
from compgs.codec.viewpoints import MAX_LENSES, MAX_SIDE, Vector, Viewpoint, Viewpoints
from compgs.numerics.rotations import quaternion_from_rotation, rigid, rotation_from_quaternion

LEAST_VIEWPOINTS = 3
ANCHORS_PER_VIEWPOINT = 100  # a viewpoint takes 13 bytes, an anchor some ten


def kept_viewpoints(most: int, anchors: int) -> int:
    """Cameras that a file of so many anchors keeps: in small ones fewer, so that they take 2 % of it at most, but for
    the few that any viewer needs to start with.
    """
    return min(most, max(LEAST_VIEWPOINTS, anchors // ANCHORS_PER_VIEWPOINT))


def viewpoints_from_cameras(
    cameras: Sequence[Camera],  # of the world, 1 to 255
    up: Vector,  # unit vector
    world_offset: Vector = (0.0, 0.0, 0.0),  # of the model, world units
) -> Viewpoints:
    """Viewpoints as `encode_viewpoints` takes them.

    The principal point goes to the middle of the image, images too large for the file become smaller, and of more than
    16 different lenses each view gets the most similar of the first 16.
    """
    views = [_viewpoint(camera.moved(world_offset)) for camera in cameras]
    lenses = list(dict.fromkeys(view.lens for view in views))[:MAX_LENSES]
    return Viewpoints(up, tuple(_with_lens(view, lenses) for view in views))


def camera_from_viewpoint(viewpoint: Viewpoint, world_offset: Vector = (0.0, 0.0, 0.0)) -> Camera:
    """The camera of the world; the principal point is the middle of the image."""
    rotation = rotation_from_quaternion(np.array(viewpoint.rotation))
    local = Camera(
        rigid(rotation, -rotation @ np.array(viewpoint.center)),
        viewpoint.fx,
        viewpoint.fy,
        viewpoint.width / 2,
        viewpoint.height / 2,
        viewpoint.width,
        viewpoint.height,
    )
    return local.moved(-np.array(world_offset))


def _viewpoint(camera: Camera) -> Viewpoint:
    longest = max(camera.width, camera.height)
    if longest > MAX_SIDE:
        sides = (max(1, side * MAX_SIDE // longest) for side in (camera.width, camera.height))
        camera = camera.resized(*sides)
    w, x, y, z = quaternion_from_rotation(camera.rotation).tolist()
    cx, cy, cz = camera.center.tolist()
    return Viewpoint((w, x, y, z), (cx, cy, cz), camera.width, camera.height, camera.fx, camera.fy)


def _with_lens(view: Viewpoint, lenses: Sequence[tuple[int, int, float, float]]) -> Viewpoint:
    """Return the view through its own lens, or the most similar one there is."""
    if view.lens in lenses:
        return view

    def difference(lens: tuple[int, int, float, float]) -> float:
        """Compare the fields of view first of all, then the image sizes, in logarithms."""
        width, height, fx, fy = lens
        fields = math.log(width / fx * view.fx / view.width) ** 2
        fields += math.log(height / fy * view.fy / view.height) ** 2
        return fields + 0.01 * (math.log(width / view.width) ** 2 + math.log(height / view.height) ** 2)

    width, height, fx, fy = min(lenses, key=difference)
    return replace(view, width=width, height=height, fx=fx, fy=fy)
