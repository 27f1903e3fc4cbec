"""Points where structure from motion found few: surfaces without corners, leaves, what only some photographs show.

Anchors begin at the points of a scene, and adaptive control adds some near those that there are. Where a scene begins
without any (on Truck: walls, the ground, trees behind), blurs of a few large primitives stay to the end. With these
points Truck gains a quarter of a decibel (docs/results/truck.md).
"""

import numpy as np
import torch

from compgs.numerics.evenly import evenly
from compgs.numerics.freed_memory import give_back_freed
from compgs.progress import Counting
from compgs.scene.views import Points, Scene
from compgs.stereo.fusion import Depths, agreed, thinned
from compgs.stereo.looks import COMPARED_PIXELS, looks_of, small_camera
from compgs.stereo.neighbours import asked_of, neighbours_of, sight_of
from compgs.stereo.plane_sweep import swept

SWEPT = 110  # photographs whose distances are found, evenly spread: the others are looked at as neighbours
FEWEST_NEIGHBOURS = 2  # the sweep takes the mean of the best two
# Points that SWEPT photographs of COMPARED_PIXELS give at a spacing of one of these pixels. At s pixels it is one in s,
# not one in s^2, as fewer pixels agree than there are cells: Truck at full size has 391 000 / s, Bonsai 426 000 / s,
# Truck's photographs at 1600 pixels 367 000 / s.
GIVEN = 390_000


@torch.no_grad()
def dense_points(
    scene: Scene,
    spacing: float,  # pixels of the training photographs between two points, about
    device: torch.device,
    progress: Counting | None = None,
) -> Points:
    """The points to add to a scene's own, which must be there: they say where to look. Raises UnreadableImage.

    The same photographs give the same points on the same kind of device.
    """
    known, full = scene.points.positions, scene.train_views[0].camera
    depths = _depths(scene, device, progress)
    give_back_freed()
    if not depths:
        return Points(known[:0], scene.points.colors[:0])
    points = thinned(agreed(depths), spacing * small_camera(full).width / full.width, known)
    give_back_freed()  # before training, which keeps what is free
    return points


def expected_points(scene: Scene, spacing: float) -> float:
    """How many points `dense_points` finds, about, without looking."""
    full = scene.train_views[0].camera
    small = small_camera(full)
    apart = max(spacing * small.width / full.width, 1.0)
    looked_at = min(len(scene.train_views), SWEPT) / SWEPT * small.width * small.height / COMPARED_PIXELS
    return GIVEN / apart * looked_at


def _depths(scene: Scene, device: torch.device, progress: Counting | None) -> list[Depths]:
    """Distances of the photographs that are swept. Raises UnreadableImage."""
    looks = looks_of(scene.train_views, device)
    cameras = [look.camera for look in looks]
    asked = asked_of(scene.points.positions)
    sights = [sight_of(camera, asked) for camera in cameras]
    chosen = evenly(len(looks), SWEPT)
    depths = []
    for done, number in enumerate(chosen):
        if progress is not None:
            progress(done, len(chosen))
        sight, others = sights[number], neighbours_of(number, cameras, sights)
        if sight is None or len(others) < FEWEST_NEIGHBOURS:
            continue
        look = looks[number]
        inverse, step = swept(look, [looks[other] for other in others], sight.nearest, sight.farthest)
        found = inverse.cpu().numpy()
        if look.counted is not None:
            found = np.where(look.counted, found, 0)
        depths.append(Depths(look.camera, look.color, found, step))
    if progress is not None:
        progress(len(chosen), len(chosen))
    return depths
