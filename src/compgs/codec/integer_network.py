"""Entropy networks that give the same integers everywhere (docs/bitstream.md, "Networks").

Activations are fixed-point numbers with 12 fractional bits ("Q12"), weights are integers, rounding is a shift
and the non-linearity a shift and a maximum:

    y = ((W x + 2^(shift - 1)) >> shift) + bias;    rectify: y = max(y, y >> 6);
    adds: y = y + the activations that the layer before took;    y = clamp(y, -2^23, 2^23 - 1)

The last layer may take the network's own inputs, too, behind the activations before it: a linear skip.

Evaluated in float64: every product and partial sum is an integer below 2^53, so floating point is exact in
any order, on any device, and as fast as the machine's matrix product.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from compgs.codec.rows import NOTHING, RowContext
from compgs.numerics.compiled import chunk_of, njit, rows_a_thread

FRACTION_BITS = 12
ACTIVATION_LIMIT = 1 << 23  # activations are in [-2^23, 2^23 - 1]
SLOPE_BITS = 6  # leaky ReLU of slope 2^-6
MAX_SHIFT = 30
BIAS_LIMIT = 1 << 31  # absolute value of a bias
ACCUMULATOR_LIMIT = 1 << 52
FOLLOW_LIMIT = 1 << 28
SCALE_TABLES = 128
BLOCK_ROWS = 1 << 15  # rows evaluated at a time: memory, not results, depends on it
TASK_ROWS = 64  # rows that a thread takes at a time


@dataclass(frozen=True)
class IntegerLayer:
    """One affine layer in fixed point."""

    weight: np.ndarray  # [out, in] int32
    bias: np.ndarray  # [out] int64, Q12
    shift: int  # 0 ... 30: weights are in units of 2^-shift
    rectify: bool  # leaky ReLU after it
    adds: bool = False  # the end of a residual branch: adds the inputs of the layer before


@dataclass(frozen=True)
class Follow:
    """How means follow what neighbours have, channel by channel (docs/bitstream.md, "Neighbours")."""

    weight: np.ndarray  # [C] int32
    shift: int  # 0 ... 30: weights are in units of 2^-shift

    def __post_init__(self) -> None:
        if not 0 <= self.shift <= MAX_SHIFT:
            raise ValueError(f"follow: shift is {self.shift}, expected 0 to {MAX_SHIFT}")
        if self.weight.ndim != 1 or int(np.abs(self.weight.astype(np.int64)).max(initial=0)) >= FOLLOW_LIMIT:
            raise ValueError("follow: a weight reaches 2^28")


@dataclass(frozen=True)
class IntegerNetwork:
    """Layers one after the other. Raises ValueError if they do not fit or could leave 53 bits."""

    layers: tuple[IntegerLayer, ...]
    skip: bool = (
        False  # the last of several layers takes the network's inputs behind the activations before it
    )
    follow: Follow | None = None  # of a group that sees neighbours
    rows: RowContext = NOTHING

    def __post_init__(self) -> None:
        if not self.layers:
            raise ValueError("an integer network needs at least one layer")
        if self.skip and len(self.layers) == 1:
            raise ValueError("a skip needs layers to pass by, found a single one")
        width = self.layers[0].weight.shape[-1]
        for i, layer in enumerate(self.layers):
            last = i == len(self.layers) - 1
            if self.skip and last:
                width += self.inputs
            if layer.adds and (i == 0 or last or self.layers[i - 1].weight.shape[1] != layer.weight.shape[0]):
                raise ValueError(
                    f"layer {i}: {layer.weight.shape[0]} outputs cannot be added to what the layer before takes"
                )
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

        if self.follow is not None and 2 * len(self.follow.weight) != width:
            raise ValueError(f"follow: {len(self.follow.weight)} channels, the network has {width // 2}")

    @property
    def products(self) -> int:
        """Multiplications that a row takes: the number of weights."""
        return sum(layer.weight.size for layer in self.layers)

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
    out = np.empty((len(x), network.outputs), np.int32)
    for start, block in _inputs_of_last(network, x):
        out[start : start + len(block)] = _affine(network.layers[-1], block, block)
    return out


def entropy_parameters(
    network: IntegerNetwork,
    x: np.ndarray,  # [N, inputs] Q12: what the decoder knows by then
    mask: np.ndarray | None = None,  # [N, K] bool: only the channels of these slots are wanted
) -> tuple[np.ndarray, np.ndarray]:
    """Means (Q12, int32) and Gaussian tables (uint8) of the symbols (CompGS Sec. 3.3).

    Both are [N, C] or, with a mask, [P, C / K], one row for each slot that exists.

    The outputs are [means | scales]; table = clamp((scale + 2048) >> 12, 0, 127): a scale output of one is a
    twelfth of an octave.
    """
    channels = network.outputs // 2
    if mask is None:
        mask = np.ones((len(x), 1), np.bool_)
    rows = first_rows(mask)
    means = np.empty((int(rows[-1]), channels // mask.shape[1]), np.int32)
    index = np.empty(means.shape, np.uint8)
    last = network.layers[-1]
    for start, block in _inputs_of_last(network, x):
        part = slice(start, start + len(block))
        _parameters(
            block, _matrix(last), last.bias, last.shift, last.rectify, mask[part], rows[part], means, index
        )
    return means, index


def centre_of(network: IntegerNetwork) -> np.ndarray:
    """[C] int64, Q12: biases of the last layer's means, around which latents that see neighbours lie in whole steps."""
    return network.layers[-1].bias[: network.outputs // 2].astype(np.int64)


def follow_neighbours(network: IntegerNetwork, around: np.ndarray, means: np.ndarray) -> None:
    """Move means [N, C] by what neighbours have, [N, C], both int32, Q12: whole steps from the centre."""
    follow = network.follow
    assert follow is not None
    half = 1 << (follow.shift - 1) if follow.shift > 0 else 0
    _follow(follow.weight.astype(np.int64), half, follow.shift, centre_of(network), around, means)


@njit(parallel=True, max_threads=rows_a_thread(2048))
def _follow(weight, half, shift, centre, around, means, part):
    rounding = 1 << (FRACTION_BITS - 1)
    for n in chunk_of(len(means), part):
        for c in range(len(weight)):
            moved = np.int64(means[n, c]) - centre[c] + ((weight[c] * around[n, c] + half) >> shift)
            mean = centre[c] + (((moved + rounding) >> FRACTION_BITS) << FRACTION_BITS)
            means[n, c] = min(max(mean, -ACTIVATION_LIMIT), ACTIVATION_LIMIT - 1)


def first_rows(mask: np.ndarray) -> np.ndarray:  # [N + 1] int64
    """Row of each anchor's first existing slot [N, K], and the number of all behind them."""
    rows = np.zeros(len(mask) + 1, np.int64)
    np.cumsum(np.count_nonzero(mask, axis=1), out=rows[1:])
    return rows


def _inputs_of_last(network: IntegerNetwork, x: np.ndarray) -> Iterator[tuple[int, np.ndarray]]:
    """(first row, inputs of the last layer) of one block of rows after the other."""
    assert x.ndim == 2 and x.shape[1] == network.inputs
    for start in range(0, len(x), BLOCK_ROWS):
        inputs = np.ascontiguousarray(x[start : start + BLOCK_ROWS])
        before, block = inputs, inputs
        for layer in network.layers[:-1]:
            before, block = block, _affine(layer, block, before)
        yield start, np.concatenate([block, inputs], 1) if network.skip else block


def _affine(layer: IntegerLayer, x: np.ndarray, before: np.ndarray) -> np.ndarray:
    """A layer's outputs [N, out] int32; `before` [N, out]: what its branch began with, if it adds that."""
    out = np.empty((len(x), len(layer.bias)), np.int32)
    added = before if layer.adds else np.empty((0, len(layer.bias)), np.int32)
    _layer(x, _matrix(layer), layer.bias, layer.shift, layer.rectify, added, out)
    return out


def _matrix(layer: IntegerLayer) -> np.ndarray:
    """[inputs rounded up to 4, outputs] float64."""
    inputs = layer.weight.shape[1]
    matrix = np.zeros((-(-inputs // 4) * 4, layer.weight.shape[0]))
    matrix[:inputs] = layer.weight.T
    return matrix


@njit(inline="always")
def _clamped(x):
    v = min(np.int64(x), ACTIVATION_LIMIT - 1)
    return max(v, -ACTIVATION_LIMIT)


@njit(inline="always")
def _sums(x, weight, inputs, sums):
    """W x of one row. Four inputs at a time, so that each sum is loaded and stored once for four products."""
    for i in range(len(x)):
        inputs[i] = _clamped(x[i])
    sums[:] = 0.0
    for i in range(0, len(inputs), 4):
        a, b, c, d = inputs[i], inputs[i + 1], inputs[i + 2], inputs[i + 3]
        for o in range(len(sums)):
            sums[o] += (a * weight[i, o] + b * weight[i + 1, o]) + (
                c * weight[i + 2, o] + d * weight[i + 3, o]
            )


@njit(inline="always")
def _activation(a, bias, half, scale, rectify):
    """Rounding shift, bias, leaky ReLU and clamp of an integer held in a float: floor(a / 2^s) is a >> s."""
    y = np.floor((a + half) * scale) + bias
    if rectify:
        y = max(y, np.floor(y * (1.0 / (1 << SLOPE_BITS))))
    return min(max(y, -float(ACTIVATION_LIMIT)), float(ACTIVATION_LIMIT - 1))


@njit(parallel=True, max_threads=rows_a_thread(512))
def _layer(x, weight, bias, shift, rectify, added, out, part):
    """added [N, out] or [0, out]: nothing."""
    scale = 1.0 / (1 << shift)
    half = float(1 << (shift - 1)) if shift > 0 else 0.0
    for block in chunk_of((len(x) + TASK_ROWS - 1) // TASK_ROWS, part):
        sums = np.empty(out.shape[1])
        inputs = np.zeros(len(weight))
        for n in range(block * TASK_ROWS, min((block + 1) * TASK_ROWS, len(x))):
            _sums(x[n], weight, inputs, sums)
            for c in range(out.shape[1]):
                y = _activation(sums[c], float(bias[c]), half, scale, rectify)
                if len(added) > 0:
                    y = float(_clamped(np.int64(y) + _clamped(added[n, c])))
                out[n, c] = np.int32(y)


@njit(parallel=True, max_threads=rows_a_thread(512))
def _parameters(x, weight, bias, shift, rectify, mask, rows, means, index, part):
    scale = 1.0 / (1 << shift)
    half = float(1 << (shift - 1)) if shift > 0 else 0.0
    slots, channels = mask.shape[1], means.shape[1]
    for block in chunk_of((len(x) + TASK_ROWS - 1) // TASK_ROWS, part):
        sums = np.empty(weight.shape[1])
        inputs = np.zeros(len(weight))
        for n in range(block * TASK_ROWS, min((block + 1) * TASK_ROWS, len(x))):
            _sums(x[n], weight, inputs, sums)
            row = rows[n]
            for k in range(slots):
                if not mask[n, k]:
                    continue
                for c in range(channels):
                    i = k * channels + c
                    means[row, c] = np.int32(_activation(sums[i], float(bias[i]), half, scale, rectify))
                for c in range(channels):
                    i = (slots + k) * channels + c
                    y = np.int32(_activation(sums[i], float(bias[i]), half, scale, rectify))
                    table = (y + (1 << (FRACTION_BITS - 1))) >> FRACTION_BITS
                    index[row, c] = min(max(table, 0), SCALE_TABLES - 1)
                row += 1
