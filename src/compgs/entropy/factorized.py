"""The learned factorized density of hyper-latents (CompGS Sec. 3.3, after Ballé et al. 2017).

Their factorized prior integrates a small monotone network over the unit interval of a symbol. Here the
density is piecewise constant on the unit bins of the symbols themselves: its parameters are the probabilities
that the codec's integer tables hold, so that what is trained is what is coded, and no network has to be
evaluated anywhere. For a value with uniform noise the mass of a unit interval is needed at real positions:
exactly the linear interpolation between the two bins that the interval covers.
"""

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from compgs.numerics.compiled import chunk_of, njit
from compgs.tensors import where

REACH = 24  # symbols -24 to 24 have a bin of their own
# No bin falls below this, as no symbol of an integer table has frequency 0.
SMALLEST_PROBABILITY = 2.0**-16
# Beyond the last bin each step costs this much more: about what an escape code costs, and a pull back into
# the bins.
TAIL_BITS = 2.0

_CHUNKS = 16  # partial sums of the probabilities' gradient, whatever the number of threads
_LOG2_E = math.log2(math.e)


class FactorizedDensity(nn.Module):
    """One density for each of C channels, the same for all anchors."""

    def __init__(self, channels: int, reach: int = REACH, scale: float = 2.0) -> None:
        """Starts as a logistic distribution around 0; `scale` is its scale parameter, in symbols."""
        super().__init__()
        self.reach = reach
        edges = (torch.arange(-reach, reach + 2) - 0.5) / scale
        mass = torch.sigmoid(edges[1:]) - torch.sigmoid(edges[:-1])
        self.logits = nn.Parameter(mass.clamp_min(SMALLEST_PROBABILITY).log().repeat(channels, 1))

    def probabilities(self) -> Tensor:
        """[C, 2 reach + 1] of the symbols -reach to reach; each row sums to one."""
        bins = self.logits.shape[1]
        return torch.softmax(self.logits, 1) * (1.0 - bins * SMALLEST_PROBABILITY) + SMALLEST_PROBABILITY

    def bits(
        self,
        z: Tensor,  # [N, C] symbols, or values with noise
    ) -> Tensor:  # [N] bits of each row
        """-log2 of the mass of the unit interval around z, summed over channels."""
        p = self.probabilities()
        if where.in_kernels(z, p):
            return _FusedBits.apply(z, p)
        return _torch_bits(z, p, self.reach).sum(1)


def _torch_bits(z: Tensor, p: Tensor, reach: int) -> Tensor:
    inside = z.clamp(-reach, reach)
    # Not a number has no bin; any will do, the result is not a number.
    left = torch.nan_to_num(inside.detach()).floor().clamp_max(reach - 1)
    fraction = inside - left
    column = (left + reach).long().t()
    mass = p.gather(1, column).t() * (1.0 - fraction) + p.gather(1, column + 1).t() * fraction
    return TAIL_BITS * (z.abs() - reach).clamp_min(0.0) - torch.log2(mass)


@njit(inline="always")
def _bin(z, reach):
    """Left bin (0 to 2 reach - 1), fraction of the right one, distance beyond the last bin."""
    bound = np.float32(reach)
    # In this order, not a number ends in the first bin instead of outside the table.
    inside = z if z > -bound else -bound
    inside = inside if inside < bound else bound
    left = min(int(np.floor(inside)), reach - 1)
    return left + reach, inside - np.float32(left), max(abs(z) - bound, np.float32(0))


@njit(parallel=True)
def _bits(z, p, bits, part):
    """z [N, C], p [C, bins] -> bits [N]."""
    N, C = z.shape
    reach = p.shape[1] // 2
    for i in chunk_of(N, part):
        total = np.float32(0)
        for c in range(C):
            k, f, beyond = _bin(z[i, c], reach)
            mass = p[c, k] + f * (p[c, k + 1] - p[c, k])
            total += np.float32(TAIL_BITS) * beyond - np.log2(mass)
        bits[i] = total


@njit(parallel=True)
def _bits_gradient(z, p, g, d_z, d_p, part):
    """g [N], the gradient of the bits -> d_z [N, C] and parts d_p [chunks, C, bins] (zero before)."""
    N, C = z.shape
    reach = p.shape[1] // 2
    chunks = len(d_p)
    for chunk in chunk_of(chunks, part):
        for i in range(N * chunk // chunks, N * (chunk + 1) // chunks):
            for c in range(C):
                k, f, beyond = _bin(z[i, c], reach)
                slope = p[c, k + 1] - p[c, k]
                weight = np.float32(-_LOG2_E) * g[i] / (p[c, k] + f * slope)
                d_p[chunk, c, k] += weight * (np.float32(1) - f)
                d_p[chunk, c, k + 1] += weight * f
                if beyond > 0:
                    d_z[i, c] = np.copysign(np.float32(TAIL_BITS), z[i, c]) * g[i]
                else:
                    d_z[i, c] = weight * slope


class _FusedBits(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, z: Tensor, p: Tensor) -> Tensor:
        z, p = z.contiguous(), p.contiguous()
        bits = z.new_empty(len(z))
        _bits(z.detach().numpy(), p.detach().numpy(), bits.numpy())
        ctx.save_for_backward(z, p)
        return bits

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, Tensor]:
        z, p = ctx.saved_tensors
        d_z = torch.empty_like(z)
        parts = np.zeros((_CHUNKS, *p.shape), np.float32)
        _bits_gradient(
            z.detach().numpy(), p.detach().numpy(), grads[0].contiguous().numpy(), d_z.numpy(), parts
        )
        return d_z, torch.from_numpy(parts.sum(0))
