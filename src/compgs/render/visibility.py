"""Which anchors may be in a view: a conservative frustum test of spheres.

A sphere holds the means of some Gaussians and reaches `r` to where their alpha falls below the cutoff. With
x, y, z in camera axes, what the rasterizer draws of it satisfies, on the right side (and likewise on the
other three),

    x - z (W - cx)/fx  <=  r sqrt(1 + limit^2) + (z + r) dilated/fx,       z + r >= near plane

where `limit` bounds x/z in the projection's Jacobian and `dilated` is the reach in pixels that dilation adds.
It holds for splats as they are drawn, by the first-order projection, which can reach farther than the true
ellipsoid.
"""

import math

import numpy as np

from compgs.cameras import Camera
from compgs.numerics.compiled import chunk_of, njit
from compgs.render.settings import RasterSettings, jacobian_limits

BLOCK = 4096  # anchors
ROUNDING = 1e-5  # of the lengths involved: float32 must not lose what lies on the boundary


def visible_mask(
    positions: np.ndarray,  # [N, 3] float32, world units
    radii: np.ndarray,  # [N] float32, world units, of spheres that hold all that is drawn of an anchor
    camera: Camera,
    settings: RasterSettings,
) -> np.ndarray:  # [N] bool
    """False only where nothing of an anchor can reach a pixel."""
    mask = np.empty(len(positions), np.bool_)
    # Writable: kernels would be compiled anew for arrays that are read-only.
    positions, radii = (np.require(a, np.float32, ("C", "W")) for a in (positions, radii))
    mark_visible(positions, radii, frustum(camera, settings).astype(np.float32), mask)
    return mask


def frustum(camera: Camera, settings: RasterSettings) -> np.ndarray:
    """[5, 5] rows n, offset, reach; a sphere (x, r) is kept where n . x + offset + reach r >= 0."""
    left, right, top, bottom = jacobian_limits(camera, settings)
    across, down = math.hypot(1, max(-left, right)), math.hypot(1, max(-top, bottom))
    sigmas = math.sqrt(2 * math.log(1 / settings.alpha_cutoff))
    dilated = sigmas * math.sqrt(settings.dilation_of(camera))  # pixels
    pad_x, pad_y = dilated / camera.fx, dilated / camera.fy
    rows = np.array(
        [
            [1, 0, camera.cx / camera.fx + pad_x, 0, across + pad_x],
            [-1, 0, (camera.width - camera.cx) / camera.fx + pad_x, 0, across + pad_x],
            [0, 1, camera.cy / camera.fy + pad_y, 0, down + pad_y],
            [0, -1, (camera.height - camera.cy) / camera.fy + pad_y, 0, down + pad_y],
            [0, 0, 1, -settings.near_plane, 1],
        ]
    )  # in camera axes
    world = rows.copy()
    world[:, :3] = rows[:, :3] @ camera.rotation
    world[:, 3] += rows[:, :3] @ camera.translation
    world[:, 3] += ROUNDING * (np.abs(rows[:, :3]) @ np.abs(camera.translation) + 1)
    return world


@njit(parallel=True, fastmath={"contract", "nsz"}, error_model="numpy")
def mark_visible(positions, radii, planes, mask, part):
    n = positions.shape[0]
    for block in chunk_of((n + BLOCK - 1) // BLOCK, part):
        for i in range(block * BLOCK, min(block * BLOCK + BLOCK, n)):
            x, y, z, radius = positions[i, 0], positions[i, 1], positions[i, 2], radii[i]
            kept = True
            for p in range(5):
                distance = planes[p, 0] * x + planes[p, 1] * y + planes[p, 2] * z + planes[p, 3]
                kept = kept & (distance + planes[p, 4] * radius >= np.float32(0))
            mask[i] = kept
