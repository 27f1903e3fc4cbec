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
AT_ONCE = 8  # planes whose arrays are in memory: 2 MB each, which a processor's cache holds
WINDOW = 5  # pixels
LEAST_LIKENESS = 0.55  # correlation; what agrees by chance is left to `fusion`
LEAST_VARIANCE = 1e-4  # of gray in the window: 2.5 of 255 levels, above a photograph's noise
NEARER, FARTHER = 0.7, 8.0  # than the nearest and the farthest of the sparse points in view


def swept(look: Look, others: Sequence[Look], nearest: float, farthest: float) -> tuple[Tensor, float]:
    """[H, W] inverse distance along the axis of each pixel, 0 where it is not known; and that of two planes in a row.

    `others`: two at least. `nearest` and `farthest`: world units, of what is known to be in view.
    """
    inverse = torch.linspace(
        1 / (NEARER * nearest), 1 / (FARTHER * farthest), PLANES, device=look.gray.device
    )
    means, variances = _moments(look.gray[None])
    likeness = torch.cat(
        [
            _mean_of_best_two([_likeness(look, other, planes, means, variances) for other in others])
            for planes in inverse.split(AT_ONCE)
        ]
    )
    best, plane = likeness.max(0)
    inner = plane.clamp(1, PLANES - 2)
    before, at, after = (likeness.gather(0, (inner + step)[None])[0] for step in (-1, 0, 1))
    curvature = before - 2 * at + after
    # the top of the parabola through three planes
    shift = torch.where(curvature.abs() > 1e-6, 0.5 * (before - after) / curvature, 0.0).clamp(-0.5, 0.5)
    spacing = inverse[1] - inverse[0]
    known = (best > LEAST_LIKENESS) & (variances[0] > LEAST_VARIANCE) & (plane == inner)
    return torch.where(known, inverse[inner] + shift * spacing, 0.0), abs(float(spacing))


def _likeness(look: Look, other: Look, inverse: Tensor, means: Tensor, variances: Tensor) -> Tensor:
    """[D, H, W] correlation of each pixel's window with the neighbour's at D distances; -1 outside of it."""
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
    )[:, 0]
    their_means, their_variances = _moments(warped)
    covariance = _mean(warped * look.gray) - their_means * means
    correlation = covariance / torch.sqrt((variances * their_variances).clamp_min(1e-8))
    return torch.where(inside, correlation, -1.0)


def _mean_of_best_two(likeness: Sequence[Tensor]) -> Tensor:
    """Mean of the two highest of two arrays or more, for each pixel. (`topk` takes ten times as long on a CPU.)"""
    best, second = torch.maximum(likeness[0], likeness[1]), torch.minimum(likeness[0], likeness[1])
    for other in likeness[2:]:
        second = torch.maximum(second, torch.minimum(best, other))
        best = torch.maximum(best, other)
    return (best + second) / 2


def _moments(images: Tensor) -> tuple[Tensor, Tensor]:
    """Mean and variance of the windows of images [B, H, W]."""
    means = _mean(images)
    return means, _mean(images * images) - means * means


def _mean(images: Tensor) -> Tensor:
    """Mean of each pixel's window, as far as there are pixels, in images [B, H, W]: along rows, then along columns."""
    return _mean_along(1, _mean_along(2, images))


def _mean_along(side: int, images: Tensor) -> Tensor:
    """Mean of the `WINDOW` pixels around each, along one side of images [B, H, W], as a sum of moved images.
    (`avg_pool2d` gives the same bits, and takes ten times as long on a CPU.)
    """
    count, reach = images.shape[side], WINDOW // 2
    padded = nn.functional.pad(images, (reach, reach) if side == 2 else (0, 0, reach, reach))
    total = padded.narrow(side, 0, count).clone()
    for moved in range(1, WINDOW):
        total += padded.narrow(side, moved, count)
    place = torch.arange(count, device=images.device)
    pixels = (place + reach).clamp(max=count - 1) - (place - reach).clamp(min=0) + 1
    return total.div_(pixels if side == 2 else pixels[:, None])
