"""Plane sweep (Collins 1996): of many distances, the one at which a pixel's surroundings look alike in its neighbours.

Likeness is the normalized cross-correlation of windows: a photograph that is brighter as a whole is no obstacle. Of the
neighbours the best two count, since what lies behind an edge is hidden from some of them.
"""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from compgs.stereo.looks import Look

PLANES = (
    112  # distances, evenly in their inverses: one moves the picture by a pixel or so from one to the next
)
WINDOW = 5  # pixels
BEST = 2  # neighbours that must agree
LEAST_LIKENESS = 0.55  # correlation; what agrees by chance is left to `fusion`
LEAST_VARIANCE = 1e-4  # of gray in the window: 2.5 of 255 levels, above a photograph's noise
NEARER, FARTHER = 0.7, 8.0  # than the nearest and the farthest of the sparse points in view


def swept(look: Look, others: Sequence[Look], nearest: float, farthest: float) -> tuple[Tensor, float]:
    """[H, W] inverse distance along the axis of each pixel, 0 where it is not known; and that of two planes in a row.

    `nearest` and `farthest`: world units, of what is known to be in view.
    """
    inverse = torch.linspace(
        1 / (NEARER * nearest), 1 / (FARTHER * farthest), PLANES, device=look.gray.device
    )
    means, variances = _moments(look.gray[None, None])
    likeness = torch.stack([_likeness(look, other, inverse, means, variances) for other in others])
    likeness = likeness.topk(min(BEST, len(others)), 0).values.mean(0)
    best, plane = likeness.max(0)
    inner = plane.clamp(1, PLANES - 2)
    before, at, after = (likeness.gather(0, (inner + step)[None])[0] for step in (-1, 0, 1))
    curvature = before - 2 * at + after
    # the top of the parabola through three planes
    shift = torch.where(curvature.abs() > 1e-6, 0.5 * (before - after) / curvature, 0.0).clamp(-0.5, 0.5)
    spacing = inverse[1] - inverse[0]
    known = (best > LEAST_LIKENESS) & (variances[0, 0] > LEAST_VARIANCE) & (plane == inner)
    return torch.where(known, inverse[inner] + shift * spacing, 0.0), abs(float(spacing))


def _likeness(look: Look, other: Look, inverse: Tensor, means: Tensor, variances: Tensor) -> Tensor:
    """[PLANES, H, W] correlation of each pixel's window with the neighbour's at each distance; -1 outside of it."""
    here, there = look.camera, other.camera
    height, width = look.gray.shape
    device = look.gray.device
    turn = there.rotation @ here.rotation.T
    move = there.translation - turn @ here.translation
    row, column = torch.meshgrid(
        torch.arange(height, device=device) + 0.5, torch.arange(width, device=device) + 0.5, indexing="ij"
    )
    ray = ((column - here.cx) / here.fx, (row - here.cy) / here.fy)
    # Places over their distance: a ray's direction, and the way between the cameras times the inverse distance.
    x, y, z = (
        (float(t[0]) * ray[0] + float(t[1]) * ray[1] + float(t[2]))[None] + inverse[:, None, None] * float(m)
        for t, m in zip(turn, move, strict=True)
    )
    ahead = z > 1e-6
    safe = torch.where(ahead, z, 1.0)
    u, v = there.fx * x / safe + there.cx, there.fy * y / safe + there.cy
    inside = ahead & (u > 1) & (u < there.width - 1) & (v > 1) & (v < there.height - 1)
    grid = torch.stack([2 * u / there.width - 1, 2 * v / there.height - 1], -1)
    warped = nn.functional.grid_sample(
        other.gray[None, None].expand(len(inverse), -1, -1, -1),
        grid,
        padding_mode="border",
        align_corners=False,
    )
    their_means, their_variances = _moments(warped)
    covariance = _mean(warped * look.gray) - their_means * means
    correlation = covariance / torch.sqrt((variances * their_variances).clamp_min(1e-8))
    return torch.where(inside, correlation[:, 0], -1.0)


def _moments(images: Tensor) -> tuple[Tensor, Tensor]:
    """Mean and variance of the windows of images [B, 1, H, W]."""
    means = _mean(images)
    return means, _mean(images * images) - means * means


def _mean(images: Tensor) -> Tensor:
    """Mean of each pixel's window in images [B, 1, H, W]: along rows, then along columns."""
    reach = WINDOW // 2
    rows = nn.functional.avg_pool2d(images, (1, WINDOW), 1, (0, reach), count_include_pad=False)
    return nn.functional.avg_pool2d(rows, (WINDOW, 1), 1, (reach, 0), count_include_pad=False)
