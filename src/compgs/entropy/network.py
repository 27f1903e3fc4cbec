"""The trainable twin of the codec's integer networks."""

import math
from collections.abc import Iterator
from typing import Any

import torch
from torch import Tensor, nn

from compgs.entropy.quantization import quantize_weights
from compgs.tensors.linear import ReferenceLayer, linear

# A power of two, so that the decoder's leaky ReLU is a shift.
NEGATIVE_SLOPE = 2.0**-6
# The scale outputs are octaves around one quantization step; the codec's tables hold twelve scales an octave, number
# 60 being one step (entropy.gaussian).
OCTAVE = 12.0
UNIT_SCALE = 60.0


# Fractional bits of the decoder's fixed-point numbers (codec.integer_network).
FRACTION_BITS = 12


class _RoundHalfUp(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        return torch.floor(x + 0.5)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> Tensor:
        return grads[0]


def round_half_up(x: Tensor) -> Tensor:
    """The nearest whole number, straight-through; of two the larger, as in the decoder."""
    rounded: Tensor = _RoundHalfUp.apply(x)
    return rounded


def round_fixed(x: Tensor) -> Tensor:
    """The nearest number that the decoder's fixed point can hold, straight-through; of two the larger, as there: few
    weights have so many digits that none of their sums lies half-way.
    """
    return round_half_up(x * 2.0**FRACTION_BITS) * 2.0**-FRACTION_BITS


class EntropyNetwork(nn.Module):
    """Means and scale indices of C Gaussian-distributed symbols from already decoded latents (CompGS Sec. 3.3).

    Without blocks one linear layer; with them a residual multi-layer perceptron (Sec. 3.4):

        x [N, inputs] ─► linear ─► leaky ReLU ─► h
        blocks times:     h ─► h + linear(leaky ReLU(linear(h)))
        [h, x] ─► linear ─► mean [N, C], scale index [N, C]

    The last layer takes the input too: that is the linear skip, in the same sum of products. `mean_gain` sets the unit
    in which the means are learned, so that one learning rate serves embeddings (means of a few steps) and log scales
    (means of dozens of steps). Gains are folded into the last layer: `layers` gives the weights that the file will
    hold, and with `bits` everything is rounded as the decoder rounds it.
    """

    gain: Tensor
    offset: Tensor

    def __init__(
        self, inputs: int, channels: int, blocks: int = 0, width: int = 0, mean_gain: float = 1.0
    ) -> None:
        super().__init__()
        hidden = [(inputs, width), *[(width, width)] * (2 * blocks)] if blocks else []
        self.channels = channels
        self.blocks = blocks
        self.weights = nn.ParameterList()
        self.biases = nn.ParameterList()
        for n_in, n_out in [*hidden, (inputs + (width if blocks else 0), 2 * channels)]:
            bound = 1.0 / math.sqrt(n_in)
            self.weights.append(nn.Parameter(torch.empty(n_out, n_in).uniform_(-bound, bound)))
            self.biases.append(nn.Parameter(torch.zeros(n_out)))
        gain = torch.full((2 * channels,), mean_gain)
        gain[channels:] = OCTAVE
        offset = torch.zeros(2 * channels)
        offset[channels:] = UNIT_SCALE
        self.register_buffer("gain", gain)
        self.register_buffer("offset", offset)

    def make_constant(self) -> None:
        """Means and scales that depend on nothing: of a single layer, biases are all that is learned."""
        assert not self.blocks
        nn.init.zeros_(self.weights[0].requires_grad_(False))

    @property
    def per_channel(self) -> tuple[nn.Parameter, ...]:
        """Parameters [C] beside the last layer's rows."""
        return ()

    def readers(self, first: int) -> Iterator[ReferenceLayer]:
        """The layers that take the input; what is meant begins at its channel `first`."""
        yield ReferenceLayer(self.weights[0], self.biases[0], 1, first, 1.0)
        if self.blocks:
            skip = len(self.biases[0]) + first
            yield ReferenceLayer(self.weights[-1], self.biases[-1], 1, skip, 1.0)

    def keep_channels(self, kept: Tensor) -> None:
        """Follow the last layer's weights and biases, which have lost the rows of all channels but those `kept` [C]."""
        both = kept.repeat(2).to(self.gain.device)
        self.gain, self.offset = self.gain[both], self.offset[both]
        self.channels = int(kept.sum())

    def layers(self, bits: int | None = None) -> list[tuple[Tensor, Tensor]]:
        """Effective (weight [out, in], bias [out]) of each layer; rounded to `bits` bits if given."""
        weights, biases = [*self.weights], [*self.biases]
        weights[-1] = weights[-1] * self.gain[:, None]
        biases[-1] = biases[-1] * self.gain + self.offset
        if bits is not None:
            weights = quantize_weights(weights, [bits] * len(weights))
            biases = [round_fixed(bias) for bias in biases]
        return list(zip(weights, biases, strict=True))

    def inputs_of_last(self, x: Tensor, bits: int | None = None) -> tuple[Tensor, Tensor, Tensor]:
        """What the last layer takes of x [N, inputs], and its weight [2 C, in] and bias [2 C]."""
        *hidden, (weight, bias) = self.layers(bits)
        if not hidden:
            return x, weight, bias

        def affine(h: Tensor, layer: tuple[Tensor, Tensor]) -> Tensor:
            y = linear(h, layer[0].t(), layer[1])
            return y if bits is None else round_fixed(y)

        h = leaky(affine(x, hidden[0]))
        for first, second in zip(hidden[1::2], hidden[2::2], strict=True):
            h = h + affine(leaky(affine(h, first)), second)
        return torch.cat([h, x], 1), weight, bias

    def forward(self, x: Tensor, bits: int | None = None) -> tuple[Tensor, Tensor]:
        """x [N, inputs] -> means [N, C] in quantization steps, scale indices [N, C] (see entropy.gaussian)."""
        x, weight, bias = self.inputs_of_last(x, bits)
        y = torch.addmm(bias, x, weight.t())
        mean, scale = (y if bits is None else round_fixed(y)).chunk(2, 1)
        return mean, scale


def leaky(x: Tensor) -> Tensor:
    """Leaky ReLU with the decoder's slope."""
    return nn.functional.leaky_relu(x, NEGATIVE_SLOPE)
