"""What is known of an anchor before its embedding is decoded (CompGS Sec. 3.3).

The paper sends a hyperprior z of a few channels beforehand (`Hyperprior`; Ballé et al. 2018). References in their
principal axes (`training/structure/decorrelation.py`) have little left that z could say of all channels at once: it
hardly saves what it costs, and with its network and tables it costs more, by 2 % of a file of 30 kB and 5 % of one of 4
kB. So small files have none (`NoContext`, rule `no_context`), and others have what anchors around have, which costs
nothing and says more (`entropy/neighbourhood.py`). But training goes on to pay by a hyperprior: it says of each anchor
by itself how far from the others it may be, where neighbours would have all of them alike.
"""

from collections.abc import Callable, Iterator
from typing import ClassVar

import torch
from torch import Tensor, nn

from compgs.entropy.factorized import FactorizedDensity
from compgs.entropy.network import leaky
from compgs.entropy.quantization import round_straight_through
from compgs.tensors.linear import ReferenceLayer, linear

Noise = Callable[[Tensor], Tensor]


class HyperAnalysis(nn.Module):
    """The encoder's half of a hyperprior: y -> z. It never goes into the file."""

    def __init__(self, inputs: int, channels: int) -> None:
        super().__init__()
        self.first = nn.Linear(inputs, channels)
        self.second = nn.Linear(channels, channels)

    def forward(self, y: Tensor) -> Tensor:
        first, second = self.first, self.second
        hidden = leaky(linear(y, first.weight.t(), first.bias))
        return linear(hidden, second.weight.t(), second.bias)


class Hyperprior(nn.Module):
    """y ──analysis──► z ──Q──► z_hat, which the file holds as a stream of its own."""

    def __init__(self, stream: str, inputs: int, channels: int) -> None:
        super().__init__()
        self.stream = stream
        self.outputs = channels
        self.analysis = HyperAnalysis(inputs, channels)
        self.density = FactorizedDensity(channels)

    @property
    def channels(self) -> dict[str, int]:
        """Symbols that it adds to an anchor, by stream."""
        return {self.stream: self.outputs}

    def readers(self) -> Iterator[ReferenceLayer]:
        """The layers that take the embedding."""
        first = self.analysis.first
        yield ReferenceLayer(first.weight, first.bias, 1, 0, 1.0)

    def forward(self, y: Tensor) -> Tensor:
        """z [N, channels] of the embeddings y [N, inputs], in quantization steps, before it is rounded."""
        z: Tensor = self.analysis(y)
        return z

    def decoded(self, z: Tensor) -> Tensor:
        """z_hat [N, channels], straight-through: what is known of an anchor before its embedding."""
        return round_straight_through(z)

    def bits(self, z: Tensor, noise: Noise | None) -> dict[str, Tensor]:
        """[N] bits of z: by the learned density in training; by the symbols' own histogram, which is what the file's
        tables hold, when the size of the file is asked for. The density is some per cent above it: it has to be as
        smooth as the noise.
        """
        if noise is not None:
            return {self.stream: self.density.bits(z + noise(z))}
        if z.requires_grad:  # training with symbols: a histogram has no gradient
            return {self.stream: self.density.bits(round_straight_through(z))}
        bits = z.new_zeros(len(z))
        for symbols in z.round().to(torch.int64).unbind(1):
            _, inverse, counts = torch.unique(symbols, return_inverse=True, return_counts=True)
            bits -= torch.log2(counts / len(symbols))[inverse]
        return {self.stream: bits}


class NoContext(nn.Module):
    """Nothing is known: one mean and one scale for each channel, the biases of a network whose weights are zero.

    The file has that network take the anchors' coordinates (docs/bitstream.md, Scene), of which it makes nothing.
    """

    outputs = 3
    channels: ClassVar[dict[str, int]] = {}

    def readers(self) -> Iterator[ReferenceLayer]:
        """No layer takes the embedding."""
        return iter(())

    def forward(self, y: Tensor) -> Tensor:
        """[N, 3] zeros."""
        return y.new_zeros(len(y), self.outputs)

    def decoded(self, z: Tensor) -> Tensor:
        return z

    def bits(self, z: Tensor, noise: Noise | None) -> dict[str, Tensor]:
        return {}
