"""Where a held-out photograph was taken from, as the scene itself shows it: for captures whose poses are not exact.

Training may learn where its views were taken from (`training.poses`); of a held-out view it knows nothing. So its given
camera is turned and shifted until the rendering fits the photograph best: Gauss-Newton on the squared difference, with
the rendering's changes by finite differences, so that every kind of file is aligned in the same way. The colors of the
rendering are fitted to the photograph meanwhile.
"""

from dataclasses import replace

import numpy as np

from compgs.cameras import Camera
from compgs.evaluation.exposure import fitted_exposure
from compgs.metrics import to_8bit
from compgs.numerics.rotations import rotation_from_quaternion
from compgs.render import Renderable, render
from compgs.render.depth import depth
from compgs.scene.views import View

STEP = 0.25  # pixels, by which a camera is turned or shifted to see how the rendering changes
MOST_STEPS = 12
SMALL_STEP = 0.02  # pixels: whoever moves by less has arrived
SHORTER = (1.0, 0.5, 0.25)  # tried, until the fit is better
DAMPING = 1e-4  # of a direction's own curvature: turning and shifting look almost alike


def aligned_camera(model: Renderable, view: View) -> Camera:
    """The view's camera, turned and shifted to where the model looks most like the photograph."""
    camera, units = view.camera, units_of(model, view.camera)
    counted = np.ones(view.image.shape[:2], dtype=bool) if view.mask is None else view.mask
    photograph = view.image[counted] / 255.0

    def seen(from_camera: Camera) -> np.ndarray:
        """[P, 3] float64: what counts of a rendering, in the photograph's colors."""
        image = render(model, from_camera).image
        fit = fitted_exposure(to_8bit(image), view.image, view.mask)
        return np.asarray(image, dtype=np.float64)[counted] @ fit[:, :3].T + fit[:, 3]

    here = seen(camera)
    error = float(((photograph - here) ** 2).sum())
    for _ in range(MOST_STEPS):
        changes = [
            ((seen(moved(camera, units * direction)) - here) / STEP).ravel() for direction in STEP * np.eye(6)
        ]
        slopes = np.stack(changes, axis=1)
        curvature = slopes.T @ slopes
        curvature += np.diag(DAMPING * np.diag(curvature) + 1e-9)
        step = np.linalg.solve(curvature, slopes.T @ (photograph - here).ravel())
        for share in SHORTER:
            candidate = moved(camera, units * share * step)
            there = seen(candidate)
            found = float(((photograph - there) ** 2).sum())
            if found < error:
                break
        else:
            return camera
        camera, here, error = candidate, there, found
        if np.abs(share * step).max() < SMALL_STEP:
            break
    return camera


def units_of(model: Renderable, camera: Camera) -> np.ndarray:
    """[6] what moves the middle of the picture by about a pixel: radians about the camera's axes, world units along."""
    distances = depth(model, camera)
    shown = distances[np.isfinite(distances)]
    distance = float(np.median(shown)) if len(shown) else 1.0
    return np.array([1.0] * 3 + [distance] * 3) / camera.fx


def moved(camera: Camera, change: np.ndarray) -> Camera:
    """The camera after a turn [0:3] in radians and a shift [3:6] in world units, about and along its own axes."""
    pose = np.eye(4)
    pose[:3, :3] = rotation_from_quaternion(np.array([1.0, *change[:3] / 2]))
    pose[:3, 3] = change[3:]
    return replace(camera, world_to_camera=pose @ camera.world_to_camera)
