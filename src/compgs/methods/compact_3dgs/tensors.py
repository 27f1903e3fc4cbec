"""The hash grid and the color network on torch tensors, with gradients (`hash_grid.py`, `color_network.py`)."""

import functools
from typing import Any

import torch
from torch import Tensor

from compgs.published.compact_3dgs.color_network import DIRECTION_DEGREE
from compgs.published.compact_3dgs.hash_grid import PRIMES, GridLayout, grid_features, grid_gradient
from compgs.tensors import where
from compgs.tensors.spherical_harmonics import harmonic_basis


def features(places: Tensor, grid: Tensor, layout: GridLayout) -> Tensor:
    """[V, levels x F] of places [V, 3]; gradients go to the grid. On the CPU in float32 by kernels."""
    if where.in_kernels(grid):
        found: Tensor = _Features.apply(places, grid, layout)
        return found
    return features_reference(places, grid, layout)


def features_reference(places: Tensor, grid: Tensor, layout: GridLayout) -> Tensor:
    """The same in plain torch, on any device and in any precision."""
    parts = []
    for cells, entries, first in zip(layout.cells, layout.entries, layout.offsets, strict=True):
        scaled = places * int(cells)
        cell = scaled.detach().long().clamp(0, int(cells) - 1)
        within = scaled - cell
        total = torch.zeros(len(places), layout.features, dtype=grid.dtype, device=grid.device)
        for step in corners(places.device):
            weight = torch.where(step.bool(), within, 1 - within).prod(1)
            x, y, z = (cell + step).unbind(1)
            side = int(cells) + 1
            if side**3 <= int(entries):
                row = x + side * (y + side * z)
            else:
                row = (x ^ (y * PRIMES[1]) ^ (z * PRIMES[2])) & (int(entries) - 1)
            total = total + weight[:, None].to(grid.dtype) * grid[int(first) + row]
        parts.append(total)
    return torch.cat(parts, 1)


@functools.lru_cache(maxsize=16)
def corners(device: torch.device) -> Tensor:
    """[8, 3] int64: steps from a node of a grid to the corners of its cell; kept, as a copy to a GPU waits for it to
    finish its work.
    """
    return torch.tensor([[corner & 1, (corner >> 1) & 1, corner >> 2] for corner in range(8)], device=device)


class _Features(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, places: Tensor, grid: Tensor, layout: GridLayout) -> Tensor:
        ctx.save_for_backward(places)
        ctx.layout = layout
        return torch.from_numpy(grid_features(places.numpy(), grid.detach().numpy(), layout))

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[None, Tensor, None]:
        (places,) = ctx.saved_tensors
        return None, torch.from_numpy(grid_gradient(places.numpy(), gradients[0].numpy(), ctx.layout)), None


def color_coefficients(
    means: Tensor,  # [V, 3] world units; the grid is looked up at them without a gradient
    center: Tensor,  # [3] of the camera
    grid: Tensor,
    weights: list[Tensor],
    layout: GridLayout,
    middle: Tensor,  # [3] world units
    unit: float,  # world units
) -> Tensor:  # [V, 3] of degree 0
    """What the network makes of places and directions."""
    with torch.no_grad():
        places = contracted((means - middle) / unit)
    directions = torch.nn.functional.normalize(means - center, dim=1)
    hidden = torch.cat([features(places, grid, layout), harmonic_basis(directions, DIRECTION_DEGREE)], 1)
    for matrix in weights[:-1]:
        hidden = (hidden @ matrix).relu()
    return hidden @ weights[-1]


def contracted(points: Tensor) -> Tensor:
    """[V, 3] in the unit cube; see `color_network.contracted`."""
    far = points.norm(dim=1, keepdim=True).clamp_min(1)
    return ((2 - 1 / far) * points / far * 0.25 + 0.5).clamp(0, 1)
