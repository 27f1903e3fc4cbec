"""The entropy model of the hybrid primitives (CompGS Sec. 3.3, Fig. 4).

`f` reference embeddings, `c` covariance parameters (log scales), `g` residual embeddings of an anchor's K coupled
primitives, flattened; `z` hyperpriors. All latents are in units of their quantization step, one row per anchor.
`bits` are total bits of an anchor's row; `losses.py` alone divides them, and says by what.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from torch import Tensor, nn

from compgs.config import EntropyConfig, ModelConfig
from compgs.entropy.conditional import code_latents
from compgs.entropy.factorized import FactorizedDensity
from compgs.entropy.network import NEGATIVE_SLOPE, OCTAVE, UNIT_SCALE, EntropyNetwork
from compgs.entropy.quantization import round_straight_through
from compgs.linear import Reader, linear

STREAMS = ("reference_hyper", "reference", "covariance", "residual_hyper", "residual")

# Starting slots are spread over this many steps: identical coupled primitives would stay identical for ever.
SLOT_SPREAD = 0.4
# Below this step, the log scales leave the range of the decoder's fixed-point numbers.
SMALLEST_COVARIANCE_STEP = 0.005
# Of scales that are set from the data, in steps: one symbol in eighty is other than zero there.
SMALLEST_SPREAD = 0.2


class HyperAnalysis(nn.Module):
    """The encoder's half of a hyperprior: y -> z. It never goes into the file."""

    def __init__(self, inputs: int, channels: int) -> None:
        super().__init__()
        self.first = nn.Linear(inputs, channels)
        self.second = nn.Linear(channels, channels)

    def forward(self, y: Tensor) -> Tensor:
        first, second = self.first, self.second
        hidden = nn.functional.leaky_relu(linear(y, first.weight.t(), first.bias), NEGATIVE_SLOPE)
        return linear(hidden, second.weight.t(), second.bias)


@dataclass(frozen=True)
class Quantized:
    """Latents as the decoder will have them, in quantization steps, and what they cost."""

    references: Tensor  # [N, reference_dim]
    covariances: Tensor  # [N, 6]
    residuals: Tensor  # [N, K * residual_dim]
    bits: dict[str, Tensor]  # stream -> [N] bits per anchor; empty when not asked for


class EntropyModel(nn.Module):
    """Hyperpriors for the embeddings, the reference as context for everything else (CompGS Sec. 3.3).

    f ──analysis──► z_f ──► (mean, scale) of f
    f_hat ──► (mean, scale) of c
    g ──analysis──► z_g ┐
    f_hat ──────────────┴──► (mean, scale) of g
    """

    def __init__(self, model: ModelConfig, entropy: EntropyConfig) -> None:
        super().__init__()
        residuals = model.coupled_primitives * model.residual_dim
        hidden = entropy.network_hidden
        self.own_residuals = model.residuals
        self.reference_analysis = HyperAnalysis(model.reference_dim, entropy.reference_hyper_dim)
        self.reference_density = FactorizedDensity(entropy.reference_hyper_dim)
        self.reference_network = EntropyNetwork(entropy.reference_hyper_dim, model.reference_dim, hidden)
        # Log scales span a few natural units, that is dozens of steps.
        self.covariance_network = EntropyNetwork(
            model.reference_dim, 6, hidden, 1.0 / entropy.covariance_step
        )
        self.residual_analysis = HyperAnalysis(residuals, entropy.residual_hyper_dim)
        self.residual_density = FactorizedDensity(entropy.residual_hyper_dim)
        self.residual_network = EntropyNetwork(
            entropy.residual_hyper_dim + model.reference_dim, residuals, hidden
        )
        self.log_covariance_step = nn.Parameter(torch.tensor(entropy.covariance_step).log())
        with torch.no_grad():
            self.residual_network.biases[-1][:residuals].uniform_(-SLOT_SPREAD, SLOT_SPREAD)

    @property
    def covariance_step(self) -> Tensor:
        """s_Sigma: learned quantization step of the log scales (Sec. 3.4)."""
        return self.log_covariance_step.exp().clamp_min(SMALLEST_COVARIANCE_STEP)

    @property
    def coded_networks(self) -> tuple[EntropyNetwork, ...]:
        """The networks that the decoder needs, and so the file holds."""
        return self.reference_network, self.covariance_network, self.residual_network

    def statistics(self) -> list[nn.Parameter]:
        """Parameters that say what latents cost, and nothing about what they are."""
        return [p for name, p in self.named_parameters() if name != "log_covariance_step" and p.requires_grad]

    @torch.no_grad()
    def fit_covariance_prior(self, log_scales: Tensor) -> None:
        """Start the covariance prior at the data's mean and spread: from zero it would start without gradient."""
        network, step = self.covariance_network, self.covariance_step
        network.weights[-1].mul_(0.1)
        channels = network.channels
        values = log_scales.double().cpu().numpy()  # numpy's sums do not depend on the number of threads
        network.biases[-1][:channels] = float(values.mean()) / (step * network.gain[0])
        network.biases[-1][channels:] = (max(float(values.std(ddof=1)), 0.1) / step).log2()

    def readers(self) -> Iterator[Reader]:
        """The layers that take the references."""
        analysis, covariance, residual = (
            self.reference_analysis.first,
            self.covariance_network,
            self.residual_network,
        )
        hyper = residual.weights[0].shape[1] - self.reference_network.channels
        yield Reader(analysis.weight, analysis.bias, 1, 0, 1.0)
        yield Reader(covariance.weights[0], covariance.biases[0], 1, 0, 1.0)
        yield Reader(residual.weights[0], residual.biases[0], 1, hyper, 1.0)

    @torch.no_grad()
    def restart_reference_scales(self, references: Tensor) -> tuple[nn.Parameter, nn.Parameter]:
        """Scales of the references as they are now, [N, reference_dim], whatever the hyperprior says of them; the two
        parameters whose second halves these are.
        """
        network = self.reference_network
        mean, _ = network(round_straight_through(self.reference_analysis(references)))
        # numpy's sums do not depend on the number of threads
        spread = (references - mean).double().cpu().numpy().std(0)
        weight, bias = network.weights[-1], network.biases[-1]
        weight[network.channels :] = 0
        bias[network.channels :] = torch.from_numpy(np.log2(np.maximum(spread, SMALLEST_SPREAD)))
        return weight, bias

    def starting_residuals(self) -> Tensor:
        """[K * residual_dim] residual embedding that a new anchor starts with, in quantization steps."""
        channels = self.residual_network.channels
        return self.residual_network.biases[-1].detach()[:channels].clone()

    @torch.no_grad()
    def expect_constant_residuals(self) -> None:
        """Residual embeddings are what the last bias says, and cost nothing: the smallest scale."""
        network = self.residual_network
        means = network.biases[-1][: network.channels].clone()
        for parameter in network.parameters():
            parameter.requires_grad_(False).zero_()
        network.biases[-1][: network.channels] = means
        network.biases[-1][network.channels :] = -UNIT_SCALE / OCTAVE

    def forward(
        self,
        references: Tensor,  # [N, reference_dim] steps
        covariances: Tensor,  # [N, 6] log scales over the covariance step
        residuals: Tensor,  # [N, K * residual_dim] steps; [1, K * residual_dim] if all anchors share them
        *,
        rate: bool,
        noise: Callable[[Tensor], Tensor] | None = None,
        network_bits: int | None = None,
        mask: Tensor | None = None,  # [N, K] bool: coupled primitives that are coded; default all
    ) -> Quantized:
        """Quantize, and estimate the bits if `rate`.

        With `noise` the likelihood sees uniform noise (training), without it the symbols themselves (the size of the
        file). `network_bits`: the networks' weights as the file will hold them.
        """
        z_f = self.reference_analysis(references)
        code = partial(code_latents, rate=rate, noise=noise, network_bits=network_bits)
        f_hat, bits_f = code(references, round_straight_through(z_f), self.reference_network)
        c_hat, bits_c = code(covariances, f_hat, self.covariance_network)
        bits = {
            "reference_hyper": _hyper_bits(self.reference_density, z_f, noise) if rate else bits_f,
            "reference": bits_f,
            "covariance": bits_c,
        }
        if self.own_residuals:
            z_g = self.residual_analysis(residuals)
            context = torch.cat([round_straight_through(z_g), f_hat], 1)
            g_hat, bits_g = code(residuals, context, self.residual_network, mask=mask)
            hyper = _hyper_bits(self.residual_density, z_g, noise) if rate else bits_g
            bits |= {"residual_hyper": hyper, "residual": bits_g}
        else:  # one row, whatever the context: the network's weights are zero
            context = residuals.new_zeros(1, self.residual_network.weights[0].shape[1])
            shared, _ = code(residuals, context, self.residual_network, rate=False)
            g_hat = shared.expand(len(f_hat), -1)
        return Quantized(f_hat, c_hat, g_hat, bits if rate else {})


def _hyper_bits(density: FactorizedDensity, z: Tensor, noise: Callable[[Tensor], Tensor] | None) -> Tensor:
    """[N] bits of hyperpriors: by the learned density in training; by the symbols' own histogram, which is what the
    file's tables hold, when the size of the file is asked for. The density is some per cent above it: it has to be as
    smooth as the noise.
    """
    if noise is not None:
        return density.bits(z + noise(z))
    if z.requires_grad:  # training with symbols: a histogram has no gradient
        return density.bits(round_straight_through(z))
    bits = z.new_zeros(len(z))
    for symbols in z.round().to(torch.int64).unbind(1):
        _, inverse, counts = torch.unique(symbols, return_inverse=True, return_counts=True)
        bits -= torch.log2(counts / len(symbols))[inverse]
    return bits
