"""What a camera sees of a scene of splats, splat by splat: from it follows whether it is a good place to look from.

A splat's *weight* in a picture is its transmittance times alpha, summed over the pixels (`render/contributions.py`).
Weights in a small picture say how much of it is covered, which splats are seen, and whether the camera stands inside of
something: no depth has to be rendered.
"""

from dataclasses import dataclass

import numpy as np

from compgs.cameras import Camera
from compgs.formats.arrays import normalized
from compgs.gaussians import Gaussians
from compgs.model.splats import SplatModel
from compgs.render import blend_of, contributions, local_camera, settings_of, visible_mask

PROBE_SIDE = 80  # pixels, the longer side of a probing picture
INSIDE = 3.0  # standard deviations from a splat's middle: whoever is nearer stands in it
MOST_IN_THE_WAY = 0.05  # of a picture taken in the open
LEAST_COVERED = 0.08  # of a picture that is worth looking at


@dataclass(frozen=True, eq=False)
class Probe:
    """A small picture, as the weights of the splats that are in it."""

    splats: np.ndarray  # [V] int64, ascending: those that may be in the picture
    weights: np.ndarray  # [V] float32, pixels
    covered: float  # share of the picture that shows splats, not the background
    in_the_way: float  # share of the picture that is made of splats in which the camera stands

    @property
    def open(self) -> bool:
        """Whether the camera stands in the open, and not in a wall."""
        return self.in_the_way <= MOST_IN_THE_WAY

    @property
    def good(self) -> bool:
        """Whether the camera stands in the open and sees something."""
        return self.open and self.covered >= LEAST_COVERED


def probe(model: SplatModel, camera: Camera) -> Probe:
    """What a camera of the world sees, in a picture of PROBE_SIDE pixels."""
    scale = PROBE_SIDE / max(camera.width, camera.height)
    width, height = (max(1, round(side * scale)) for side in (camera.width, camera.height))
    small = local_camera(model, camera.resized(width, height))
    settings = settings_of(model)
    visible = visible_mask(*model.bounds, small, settings)
    gaussians = model.gaussians(small, visible)
    weights = contributions(gaussians, small, settings, blend_of(model))
    within = weights[standing_in(gaussians, small.center)].sum()
    shares = float(weights.sum()) / (width * height), float(within) / (width * height)
    return Probe(np.flatnonzero(visible), weights, *shares)


def standing_in(gaussians: Gaussians[np.ndarray], place: np.ndarray) -> np.ndarray:
    """[M] bool: which Gaussians a place [3] is in, within INSIDE standard deviations along each of their axes."""
    offsets = place - gaussians.means.astype(np.float64)
    quaternions = normalized(gaussians.quaternions)
    w, axis = quaternions[:, :1], quaternions[:, 1:]
    # Into the Gaussian's axes, by the conjugate quaternion: v + 2 w (v x q) + 2 (v x q) x q.
    across = np.cross(offsets, axis)
    turned = offsets + 2 * w * across + 2 * np.cross(across, axis)
    return ((turned / gaussians.scales) ** 2).sum(axis=1) < INSIDE**2
