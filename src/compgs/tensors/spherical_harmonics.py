"""Colors of splats on torch tensors, with gradients; `model/spherical_harmonics.py` says what is meant.

On the CPU in float32 the kernels do it, in one pass each way; elsewhere the plain torch here.
"""

from typing import Any

import torch
from torch import Tensor

from compgs.model import spherical_harmonics_kernels as kernels
from compgs.model.degrees import MAX_DEGREE, coefficients
from compgs.model.spherical_harmonics import COLOR_OFFSET, Y0, harmonics
from compgs.tensors import where


def dc_from_color(colors: Tensor) -> Tensor:
    """The coefficient of degree 0 that gives a color (display RGB) in all directions."""
    return (colors - COLOR_OFFSET) / Y0


def harmonic_basis(directions: Tensor, degree: int) -> Tensor:  # [M, 3] unit -> [M, (degree + 1)^2]
    """The basis functions in the order of the file."""
    x, y, z = directions.unbind(1)
    return torch.stack([torch.full_like(x, Y0), *harmonics(x, y, z, degree)], 1)


def view_colors(
    means: Tensor,  # [M, 3] world units
    dc: Tensor,  # [M, 3] coefficients of degree 0
    rest: Tensor,  # [M, K, 3] of the degrees above, K at least (degree + 1)^2 - 1; what is beyond is not used
    center: Tensor,  # [3] of the camera, world units
    degree: int,
    visible: Tensor | None = None,  # [M] bool: splats to look at, the others become black; default all
) -> Tensor:  # [M, 3] display RGB, not below 0
    """What a camera sees of each splat; gradients go to means and coefficients."""
    assert 0 <= degree <= MAX_DEGREE and rest.shape[1] >= coefficients(degree) - 1, (degree, rest.shape)
    if where.in_kernels(means):
        if visible is None:
            visible = torch.ones(len(means), dtype=torch.bool)
        colors: Tensor = _ViewColors.apply(means, dc, rest, center, degree, visible)
        return colors
    return view_colors_reference(means, dc, rest, center, degree, visible)


def view_colors_reference(
    means: Tensor, dc: Tensor, rest: Tensor, center: Tensor, degree: int, visible: Tensor | None = None
) -> Tensor:
    """`view_colors` in plain torch, on any device and in any precision."""
    directions = torch.nn.functional.normalize(means - center, dim=1)
    basis = harmonic_basis(directions, degree)
    used = rest[:, : basis.shape[1] - 1]
    colors = COLOR_OFFSET + Y0 * dc + (basis[:, 1:, None] * used).sum(1)
    colors = colors.clamp_min(0)
    return colors if visible is None else torch.where(visible[:, None], colors, 0.0)


class _ViewColors(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, means: Tensor, dc: Tensor, rest: Tensor, center: Tensor, degree: int, visible: Tensor
    ) -> Tensor:
        means, dc, rest, center, visible = (
            t.detach().contiguous() for t in (means, dc, rest, center, visible)
        )
        colors = torch.empty_like(means)
        kernels.view_colors(
            means.numpy(),
            dc.numpy(),
            rest.numpy(),
            center.numpy(),
            visible.numpy(),
            degree,
            colors.numpy(),
        )
        ctx.save_for_backward(means, dc, rest, center, colors)
        ctx.degree = degree
        return colors

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        means, dc, rest, center, colors = ctx.saved_tensors
        d_means, d_dc, d_rest = (torch.empty_like(t) for t in (means, dc, rest))
        kernels.view_colors_gradient(
            means.numpy(),
            rest.numpy(),
            center.numpy(),
            ctx.degree,
            colors.detach().numpy(),
            gradients[0].contiguous().numpy(),
            d_means.numpy(),
            d_dc.numpy(),
            d_rest.numpy(),
        )
        return d_means, d_dc, d_rest, None, None, None
