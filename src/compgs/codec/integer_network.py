"""Entropy networks that give the same integers everywhere (docs/bitstream.md, "Networks").

Activations are fixed-point numbers with 12 fractional bits ("Q12"), weights are integers, rounding is a shift
and the non-linearity a shift and a maximum:

    y = ((W x + 2^(shift - 1)) >> shift) + bias;    rectify: y = max(y, y >> 6);    y = clamp(y, -2^23, 2^23 -
    1)

Evaluated in float64: every product and partial sum is an integer below 2^53, so floating point is exact in
any order, on any device, and as fast as the machine's matrix product.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numba import njit, prange

FRACTION_BITS = 12
ACTIVATION_LIMIT = 1 << 23  # activations are in [-2^23, 2^23 - 1]
SLOPE_BITS = 6  # leaky ReLU of slope 2^-6
MAX_SHIFT = 30
BIAS_LIMIT = 1 << 31  # absolute value of a bias
ACCUMULATOR_LIMIT = 1 << 52
SCALE_TABLES = 128
BLOCK_ROWS = 2048  # rows evaluated at a time: memory, not results, depends on it


@dataclass(frozen=True)
class IntegerLayer:
    """One affine layer in fixed point."""

    weight: np.ndarray  # [out, in] int32
    bias: np.ndarray  # [out] int64, Q12
    shift: int  # 0 ... 30: weights are in units of 2^-shift
    rectify: bool  # leaky ReLU after it


@dataclass(frozen=True)
class IntegerNetwork:
    """Layers one after the other. Raises ValueError if they do not fit or could leave 53 bits."""

    layers: tuple[IntegerLayer, ...]

    def __post_init__(self) -> None:
        if not self.layers:
            raise ValueError("an integer network needs at least one layer")
        width = self.layers[0].weight.shape[-1]
        for i, layer in enumerate(self.layers):
            if layer.weight.ndim != 2 or layer.weight.shape[1] != width or 0 in layer.weight.shape:
                raise ValueError(f"layer {i}: weight has shape {layer.weight.shape}, expected [out, {width}]")
            width = layer.weight.shape[0]
            if layer.bias.shape != (width,):
                raise ValueError(f"layer {i}: bias has shape {layer.bias.shape}, expected [{width}]")
            if not 0 <= layer.shift <= MAX_SHIFT:
                raise ValueError(f"layer {i}: shift is {layer.shift}, expected 0 to {MAX_SHIFT}")
            if int(np.abs(layer.bias.astype(np.int64)).max()) >= BIAS_LIMIT:
                raise ValueError(f"layer {i}: a bias reaches 2^31")
            largest = int(np.abs(layer.weight.astype(np.int64)).max())
            if layer.weight.shape[1] * largest * ACTIVATION_LIMIT >= ACCUMULATOR_LIMIT:
                raise ValueError(
                    f"layer {i}: {layer.weight.shape[1]} inputs with weights up to {largest} can exceed 2^52"
                )

    @property
    def inputs(self) -> int:
        return self.layers[0].weight.shape[1]

    @property
    def outputs(self) -> int:
        return self.layers[-1].weight.shape[0]


def evaluate(
    network: IntegerNetwork,
    x: np.ndarray,  # [N, inputs] integers, Q12; values outside the activations' range are clamped to it
) -> np.ndarray:  # [N, outputs] int32, Q12
    """The network's outputs, exactly: they do not depend on batch size, order, threads or device."""
    assert x.ndim == 2 and x.shape[1] == network.inputs
    out = np.empty((len(x), network.outputs), np.int32)
    last = network.layers[-1]
    for start, sums in _last_sums(network, x):
        _finish(sums, last.bias, last.shift, last.rectify)
        out[start : start + len(sums)] = sums
    return out


def entropy_parameters(
    network: IntegerNetwork,
    x: np.ndarray,  # [N, inputs] Q12: what the decoder knows by then
) -> tuple[np.ndarray, np.ndarray]:  # [N, C] int32 means Q12, [N, C] uint8 Gaussian tables
    """Means and scale tables of a stream's C channels (CompGS Sec. 3.3): the outputs are [means | scales].

    table = clamp((scale + 2048) >> 12, 0, 127): a scale output of one is a twelfth of an octave.
    """
    assert x.ndim == 2 and x.shape[1] == network.inputs
    channels = network.outputs // 2
    means = np.empty((len(x), channels), np.int32)
    index = np.empty((len(x), channels), np.uint8)
    last = network.layers[-1]
    for start, sums in _last_sums(network, x):
        block = slice(start, start + len(sums))
        _finish_parameters(sums, last.bias, last.shift, last.rectify, means[block], index[block])
    return means, index


def _last_sums(network: IntegerNetwork, x: np.ndarray) -> Iterator[tuple[int, np.ndarray]]:
    """(first row, W x of the last layer as float64) of one block of rows after the other."""
    weights = [np.ascontiguousarray(layer.weight.T, np.float64) for layer in network.layers]
    for start in range(0, len(x), BLOCK_ROWS):
        block = x[start : start + BLOCK_ROWS]
        block = np.clip(block, -ACTIVATION_LIMIT, ACTIVATION_LIMIT - 1).astype(np.float64)
        for weight, layer in zip(weights[:-1], network.layers[:-1], strict=True):
            block = block @ weight
            _finish(block, layer.bias, layer.shift, layer.rectify)
        yield start, block @ weights[-1]


@njit(cache=True, inline="always")
def _activation(a, bias, half, scale, rectify):
    """Rounding shift, bias, leaky ReLU and clamp of an integer held in a float: floor(a / 2^s) is a >> s."""
    y = np.floor((a + half) * scale) + bias
    if rectify:
        y = max(y, np.floor(y * (1.0 / (1 << SLOPE_BITS))))
    return min(max(y, -float(ACTIVATION_LIMIT)), float(ACTIVATION_LIMIT - 1))


@njit(cache=True, parallel=True)
def _finish(sums, bias, shift, rectify):
    scale = 1.0 / (1 << shift)
    half = float(1 << (shift - 1)) if shift > 0 else 0.0
    for n in prange(sums.shape[0]):
        for c in range(sums.shape[1]):
            sums[n, c] = _activation(sums[n, c], float(bias[c]), half, scale, rectify)


@njit(cache=True, parallel=True)
def _finish_parameters(sums, bias, shift, rectify, means, index):
    scale = 1.0 / (1 << shift)
    half = float(1 << (shift - 1)) if shift > 0 else 0.0
    channels = means.shape[1]
    for n in prange(sums.shape[0]):
        for c in range(channels):
            means[n, c] = np.int32(_activation(sums[n, c], float(bias[c]), half, scale, rectify))
        for c in range(channels):
            i = channels + c
            y = np.int32(_activation(sums[n, i], float(bias[i]), half, scale, rectify))
            table = (y + (1 << (FRACTION_BITS - 1))) >> FRACTION_BITS
            index[n, c] = min(max(table, 0), SCALE_TABLES - 1)
