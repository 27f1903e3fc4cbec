"""The causal chain with gradients: what an anchor's numbers cost, given its coordinates and those before them.

    y = value / step      bits = -log2 P(y + noise - mean),  P the mass of a zero-mean Gaussian on the unit interval

Means and scales are those that the integer networks will give (`chain.py`), but for their rounding in between. All
sizes are in units of the groups' learned steps.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from compgs.entropy.gaussian import gaussian_bits
from compgs.entropy.network import EntropyNetwork, leaky, round_fixed
from compgs.entropy.quantization import quantize, quantize_weights, round_straight_through
from compgs.published.cosa.shape import GROUPS, ChainShape
from compgs.tensors.linear import linear

Noise = Callable[[Tensor], Tensor]
HIDDEN = 1  # layers between coordinates and geometry context
# Below this step, numbers leave the range of the decoder's fixed point.
SMALLEST_STEP = 0.002
SMALLEST_SPREAD = 0.2  # steps, of scales that are set from the data


class ContextNetwork(nn.Module):
    """Linear layers, each with a leaky ReLU: a context, from numbers that are decoded already."""

    def __init__(self, inputs: int, outputs: int, hidden: int = 0) -> None:
        super().__init__()
        self.weights = nn.ParameterList()
        self.biases = nn.ParameterList()
        for n_in, n_out in [(inputs, outputs), *[(outputs, outputs)] * hidden]:
            bound = 1.0 / math.sqrt(n_in)
            self.weights.append(nn.Parameter(torch.empty(n_out, n_in).uniform_(-bound, bound)))
            self.biases.append(nn.Parameter(torch.empty(n_out).uniform_(-bound, bound)))

    def forward(self, x: Tensor, bits: int | None = None) -> Tensor:
        """x [N, inputs] -> [N, outputs]; with `bits`, the weights are rounded as in the file."""
        for weight, bias in self.layers(bits):
            x = linear(x, weight.t(), bias)
            x = leaky(x if bits is None else round_fixed(x))
        return x

    def layers(self, bits: int | None = None) -> list[tuple[Tensor, Tensor]]:
        """Weight [out, in] and bias [out] of each layer; rounded to `bits` bits if given."""
        weights, biases = [*self.weights], [*self.biases]
        if bits is not None:
            weights = quantize_weights(weights, [bits] * len(weights))
            biases = [round_fixed(bias) for bias in biases]
        return list(zip(weights, biases, strict=True))


@dataclass(frozen=True)
class Chained:
    """Numbers as the decoder will have them, or with noise, in steps; and what they cost."""

    values: dict[str, Tensor]  # by group: [N, channels]; offsets [N, 3 K]
    bits: dict[str, Tensor]  # by group: [N]; of offsets [N, K]; empty if not asked for


class CausalChain(nn.Module):
    """The networks of `shape.ChainShape`, and the groups' steps."""

    def __init__(self, shape: ChainShape, steps: Mapping[str, float]) -> None:
        super().__init__()
        self.shape = shape
        self.log_steps = nn.ParameterDict(
            {group: nn.Parameter(torch.tensor(math.log(steps[group]))) for group in GROUPS}
        )
        networks: dict[str, nn.Module] = {}
        for name, inputs, outputs in shape.network_sizes():
            if name in ("embedding", "anchor", "scale_embedding", "geometry"):
                networks[name] = ContextNetwork(inputs, outputs, HIDDEN if name == "geometry" else 0)
            else:
                # Log scales are dozens of steps: learned in natural units.
                gain = 1.0 / steps[name] if name in ("position_scale", "size") else 1.0
                networks[name] = EntropyNetwork(inputs, outputs // 2, mean_gain=gain)
        self.networks = nn.ModuleDict(networks)
        with torch.no_grad():  # it takes dozens of steps
            networks["scale_embedding"].weights[0].mul_(steps["position_scale"])  # type: ignore[index]

    def step(self, group: str) -> Tensor:
        """[] learned quantization step of a group."""
        return self.log_steps[group].exp().clamp_min(SMALLEST_STEP)

    def statistics(self) -> list[nn.Parameter]:
        """The networks' parameters."""
        return list(self.networks.parameters())

    @torch.no_grad()
    def fit(self, values: Mapping[str, Tensor]) -> None:
        """Let each group's Gaussians begin with the mean and spread of its values [N, channels], in natural units: far
        from them, first steps of the rate would go into nothing else."""
        for name in ("feature", "position_scale", "offset", "size"):
            network, y = self.networks[name], values[name].double() / float(self.step(name))
            assert isinstance(network, EntropyNetwork)
            c, weight, bias = network.channels, network.weights[-1], network.biases[-1]
            weight.mul_(0.1)
            bias[:c] = y.mean(0) / network.gain[:c]
            bias[c:] = y.std(0, correction=0).clamp_min(SMALLEST_SPREAD).log2()  # (in octaves)

    def forward(
        self,
        places: Tensor,  # [N, 3] coordinates, -1 to 1
        values: Mapping[str, Tensor],  # of each group, natural units
        *,
        noise: Noise | None,  # None: symbols
        network_bits: int | None,  # None: weights as they are
        everywhere: bool = True,  # noise also in the values; else in the bits alone, and the values are symbols
        rate: bool = True,
    ) -> Chained:
        """Numbers with noise or rounded, and their bits if `rate`."""
        found: dict[str, Tensor] = {}
        bits: dict[str, Tensor] = {}

        def context(name: str, *inputs: Tensor) -> Tensor:
            x = inputs[0] if len(inputs) == 1 else torch.cat(inputs, 1)
            network: ContextNetwork = self.networks[name]  # type: ignore[assignment]
            return network(x, network_bits)

        def code(name: str, y: Tensor, x: Tensor, slots: int = 1) -> tuple[Tensor, Tensor]:
            mean, scale = self._means_and_scales(name, x, network_bits)
            if noise is None:
                y_hat, distance = quantize(y, mean), round_straight_through(y - mean)
            else:
                noisy = y + noise(y)
                y_hat, distance = noisy if everywhere else quantize(y, mean), noisy - mean
            if not rate:
                return y_hat, y.new_empty(0)
            rows = len(y) * slots
            return y_hat, gaussian_bits(distance.reshape(rows, -1), scale.reshape(rows, -1)).view(
                len(y), slots
            )

        y = {group: values[group] / self.step(group) for group in GROUPS}
        geometry = context("geometry", places)
        latents: list[Tensor] = []
        latent_bits: list[Tensor] = []
        for channel in range(self.shape.latents):
            given = torch.cat([geometry, *latents], 1)
            one, cost = code(f"latent{channel}", y["latent"][:, channel : channel + 1], given)
            latents.append(one)
            latent_bits.append(cost)
        found["latent"] = torch.cat(latents, 1)
        anchor = context("anchor", geometry, context("embedding", found["latent"]))
        found["feature"], feature_bits = code("feature", y["feature"], anchor)
        found["position_scale"], scale_bits = code("position_scale", y["position_scale"], anchor)
        both = torch.cat([anchor, context("scale_embedding", found["position_scale"])], 1)
        found["offset"], offset_bits = code("offset", y["offset"], both, self.shape.coupled)
        found["size"], size_bits = code("size", y["size"], both)
        if rate:
            bits = {
                "latent": torch.cat(latent_bits, 1).sum(1),
                "feature": feature_bits.view(-1),
                "position_scale": scale_bits.view(-1),
                "offset": offset_bits,
                "size": size_bits.view(-1),
            }
        return Chained(found, bits)

    def _means_and_scales(self, name: str, x: Tensor, bits: int | None) -> tuple[Tensor, Tensor]:
        """Means [N, C] and scale indices [N, C] of a group's network."""
        network: EntropyNetwork = self.networks[name]  # type: ignore[assignment]
        inputs, weight, bias = network.inputs_of_last(x, bits)
        out = linear(inputs, weight.t(), bias)
        mean, scale = (out if bits is None else round_fixed(out)).chunk(2, 1)
        return mean, scale
