"""Captures far from the origin of their coordinates, as in UTM or ECEF: the frame that they are trained in.

Models, renderers and optimizers compute in single precision, 24 bits from the origin to the smallest detail. A capture
4 000 km from its origin would be left with steps of half a metre. So training takes place in a local frame, world
coordinates minus a `world_offset` that the model remembers; until then everything is double precision.
"""

import math
from dataclasses import replace

import numpy as np

from compgs.scene.views import Points, Scene, View

# Scene extents from the origin to the cameras, from which on the local frame has its own origin. Up to here single
# precision rounds positions by at most 100 * 2^-24 = 6e-6 extents: 1/40 pixel of a view from one extent away with a
# focal length of 4 000 pixels. And the 2^20 voxels from the origin to the end of the grid are still 10 000 an extent.
# No structure from motion that places its own origin comes near.
FAR = 100.0


def world_offset(scene: Scene) -> tuple[float, float, float]:
    """Origin of the scene's local frame, in world units: zero unless the training cameras are far from the origin.

    Else their mean, rounded to whole units, or to the power of ten below the extent where that is less than one.
    """
    if not scene.train_views:
        return (0.0, 0.0, 0.0)
    middle = np.mean([view.camera.center for view in scene.train_views], axis=0)
    if np.linalg.norm(middle) <= FAR * scene.extent:
        return (0.0, 0.0, 0.0)
    digits = max(0, math.ceil(-math.log10(max(scene.extent, 1e-300))))
    x, y, z = (round(float(value), digits) + 0.0 for value in middle)  # + 0.0: no negative zero
    return (x, y, z)


def local_scene(scene: Scene, offset: tuple[float, float, float]) -> Scene:
    """The scene in the frame whose origin lies at `offset` of the world; points in single precision."""
    positions = np.asarray(scene.points.positions, dtype=np.float64) - np.asarray(offset, dtype=np.float64)
    return replace(
        scene,
        train_views=tuple(_moved(view, offset) for view in scene.train_views),
        test_views=tuple(_moved(view, offset) for view in scene.test_views),
        points=Points(positions.astype(np.float32), scene.points.colors),
    )


def _moved(view: View, offset: tuple[float, float, float]) -> View:
    camera = view.camera.moved(offset)
    return view if camera is view.camera else replace(view, camera=camera)
