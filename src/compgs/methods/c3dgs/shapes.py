"""The shape of a splat without its size: a covariance matrix whose trace is 1, as six numbers.

A splat's scales are its size, the length of the three, times scales of length 1; these and its rotation make the shape.
Six numbers are the upper triangle, row by row: xx, xy, xz, yy, yz, zz.
"""

import torch
from torch import Tensor

ROWS, COLUMNS = (0, 0, 0, 1, 1, 2), (0, 1, 2, 1, 2, 2)


def covariances(scales: Tensor, quaternions: Tensor) -> Tensor:  # [M, 3], [M, 4] -> [M, 6]
    """Compute the covariances of scales and (unnormalized) rotations."""
    turned = rotation_matrices(quaternions) * scales[:, None]
    return (turned @ turned.transpose(1, 2))[:, ROWS, COLUMNS]


def scales_and_rotations(covariances: Tensor) -> tuple[Tensor, Tensor]:  # [M, 6] -> [M, 3], [M, 4]
    """Inverse of `covariances`: scales, those of smallest variance first, with length 1; unit quaternions."""
    matrices = covariances.new_zeros(len(covariances), 3, 3)
    matrices[:, ROWS, COLUMNS] = covariances
    matrices[:, COLUMNS, ROWS] = covariances
    variances, axes = torch.linalg.eigh(matrices.double())
    # Axes of any handedness: a rotation has determinant 1.
    axes = axes * torch.sign(torch.linalg.det(axes))[:, None, None]
    scales = torch.nn.functional.normalize(variances.clamp_min(0).sqrt(), dim=1)
    return scales.to(covariances.dtype), quaternions_of(axes).to(covariances.dtype)


def rotation_matrices(quaternions: Tensor) -> Tensor:  # [M, 4] w-x-y-z -> [M, 3, 3]
    w, x, y, z = torch.nn.functional.normalize(quaternions, dim=1).unbind(1)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return torch.stack([torch.stack(row, 1) for row in rows], 1)


def quaternions_of(matrices: Tensor) -> Tensor:  # [M, 3, 3] -> [M, 4] w-x-y-z
    """Inverse of `rotation_matrices`, w not below 0; by whichever of the four numbers is largest (Shepperd 1978)."""
    m = [[matrices[:, i, j] for j in range(3)] for i in range(3)]
    # Four times the products of all pairs of w, x, y, z.
    ww, xx = 1 + m[0][0] + m[1][1] + m[2][2], 1 + m[0][0] - m[1][1] - m[2][2]
    yy, zz = 1 - m[0][0] + m[1][1] - m[2][2], 1 - m[0][0] - m[1][1] + m[2][2]
    wx, wy, wz = m[2][1] - m[1][2], m[0][2] - m[2][0], m[1][0] - m[0][1]
    xy, xz, yz = m[0][1] + m[1][0], m[0][2] + m[2][0], m[1][2] + m[2][1]
    rows = ((ww, wx, wy, wz), (wx, xx, xy, xz), (wy, xy, yy, yz), (wz, xz, yz, zz))
    products = torch.stack([torch.stack(row, 1) for row in rows], 1)
    largest = torch.stack((ww, xx, yy, zz), 1).argmax(1)
    found = torch.nn.functional.normalize(products[torch.arange(len(products)), largest], dim=1)
    return torch.where(found[:, :1] < 0, -found, found)
