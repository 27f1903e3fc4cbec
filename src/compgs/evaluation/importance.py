"""What a primitive contributes to the images of a scene."""

from collections.abc import Callable, Sequence

import numpy as np

from compgs.cameras import Camera
from compgs.model.hybrid_model import HybridModel
from compgs.model.splats import SplatModel
from compgs.render import blend_of, contributions, local_camera, settings_of, visible_mask


def importance(
    model: HybridModel, cameras: Sequence[Camera], progress: Callable[[int, int], None] | None = None
) -> np.ndarray:  # [P] float64, pixels
    """Blending weights (transmittance x alpha) of each coupled primitive, summed over pixels and cameras.

    `progress(done, total)` is called after each camera.
    """
    settings = settings_of(model)
    total = np.zeros(model.coupled)
    for i, world_camera in enumerate(cameras):
        camera = local_camera(model, world_camera)
        gaussians, drawn = model.drawn(camera, visible_mask(*model.bounds, camera, settings))
        # No atomics: `drawn` names each primitive once, so the sum is the same in every run.
        total[drawn] += contributions(gaussians, camera, settings, blend_of(model))
        if progress:
            progress(i + 1, len(cameras))
    return total


def splat_importance(
    model: SplatModel, cameras: Sequence[Camera], progress: Callable[[], None] | None = None
) -> np.ndarray:  # [M] float32, pixels
    """The same of splats; `progress()` is called after each camera."""
    settings = settings_of(model)
    total = np.zeros(len(model.splats), np.float32)
    for world_camera in cameras:
        camera = local_camera(model, world_camera)
        total += contributions(model.gaussians(camera), camera, settings, blend_of(model))
        if progress:
            progress()
    return total
