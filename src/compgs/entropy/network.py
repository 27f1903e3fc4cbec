"""The trainable twin of the codec's integer networks."""

import itertools
import math

import torch
from torch import Tensor, nn

from compgs.entropy.quantization import quantize_weight, round_straight_through
from compgs.linear import linear

# A power of two, so that the decoder's leaky ReLU is a shift.
NEGATIVE_SLOPE = 2.0**-6
# The scale outputs are octaves around one quantization step; the codec's tables hold twelve scales an octave, number
# 60 being one step (entropy.gaussian).
OCTAVE = 12.0
UNIT_SCALE = 60.0


# Fractional bits of the decoder's fixed-point numbers (codec.integer_network).
FRACTION_BITS = 12


def round_fixed(x: Tensor) -> Tensor:
    """The nearest number that the decoder's fixed point can hold, straight-through."""
    return round_straight_through(x * 2.0**FRACTION_BITS) * 2.0**-FRACTION_BITS


class EntropyNetwork(nn.Module):
    """Means and scale indices of C Gaussian-distributed symbols from already decoded latents (CompGS Sec. 3.3).

        x [N, inputs] ─► linear ─► (leaky ReLU ─► linear) ... ─► mean [N, C], scale index [N, C]

    `mean_gain` sets the unit in which the means are learned, so that one learning rate serves embeddings (means of
    a few steps) and log scales (means of dozens of steps). Gains are folded into the last layer: `layers` gives the
    weights that the file will hold, and with `bits` everything is rounded as the decoder rounds it.
    """

    gain: Tensor
    offset: Tensor

    def __init__(self, inputs: int, channels: int, hidden: int = 0, mean_gain: float = 1.0) -> None:
        super().__init__()
        sizes = [inputs, hidden, 2 * channels] if hidden else [inputs, 2 * channels]
        self.channels = channels
        self.weights = nn.ParameterList()
        self.biases = nn.ParameterList()
        for n_in, n_out in itertools.pairwise(sizes):
            bound = 1.0 / math.sqrt(n_in)
            self.weights.append(nn.Parameter(torch.empty(n_out, n_in).uniform_(-bound, bound)))
            self.biases.append(nn.Parameter(torch.zeros(n_out)))
        gain = torch.full((2 * channels,), mean_gain)
        gain[channels:] = OCTAVE
        offset = torch.zeros(2 * channels)
        offset[channels:] = UNIT_SCALE
        self.register_buffer("gain", gain)
        self.register_buffer("offset", offset)

    def keep_channels(self, kept: Tensor) -> None:
        """Follow the last layer's weights and biases, which have lost the rows of all channels but those `kept` [C]."""
        both = kept.repeat(2).to(self.gain.device)
        self.gain, self.offset = self.gain[both], self.offset[both]
        self.channels = int(kept.sum())

    def layers(self, bits: int | None = None) -> list[tuple[Tensor, Tensor]]:
        """Effective (weight [out, in], bias [out]) of each layer; rounded to `bits` bits if given."""
        result = []
        for i, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            if i == len(self.weights) - 1:
                weight = weight * self.gain[:, None]
                bias = bias * self.gain + self.offset
            if bits is not None:
                weight, bias = quantize_weight(weight, bits), round_fixed(bias)
            result.append((weight, bias))
        return result

    def inputs_of_last(self, x: Tensor, bits: int | None = None) -> tuple[Tensor, Tensor, Tensor]:
        """x [N, inputs] through all layers but the last; then the last one's weight [2 C, in] and bias [2 C]."""
        *hidden, (weight, bias) = self.layers(bits)
        for hidden_weight, hidden_bias in hidden:
            y = linear(x, hidden_weight.t(), hidden_bias)
            x = nn.functional.leaky_relu(y if bits is None else round_fixed(y), NEGATIVE_SLOPE)
        return x, weight, bias

    def forward(self, x: Tensor, bits: int | None = None) -> tuple[Tensor, Tensor]:
        """x [N, inputs] -> means [N, C] in quantization steps, scale indices [N, C] (see entropy.gaussian)."""
        x, weight, bias = self.inputs_of_last(x, bits)
        y = torch.addmm(bias, x, weight.t())
        mean, scale = (y if bits is None else round_fixed(y)).chunk(2, 1)
        return mean, scale
