"""The entropy model of the hybrid primitives (CompGS Sec. 3.3, Fig. 4).

`f` reference embeddings, `c` covariance parameters (log scales), `g` residual embeddings of an anchor's K coupled
primitives, flattened; `z` hyperpriors. All latents are in units of their quantization step, one row per anchor.
`bits` are total bits of an anchor's row; `losses.py` alone divides them, and says by what.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Literal

import numpy as np
import torch
from torch import Tensor, nn

from compgs.config import EntropyConfig, ModelConfig
from compgs.entropy.conditional import code_latents
from compgs.entropy.contexts import Hyperprior, NoContext
from compgs.entropy.neighbour_network import NeighbourNetwork
from compgs.entropy.network import EntropyNetwork
from compgs.ordering.neighbours import BESIDES
from compgs.tensors.linear import ReferenceLayer

STREAMS = ("reference_hyper", "reference", "covariance", "residual_hyper", "residual")

# Starting slots are spread over this many steps: identical coupled primitives would stay identical for ever.
SLOT_SPREAD = 0.4
# Below this step, the log scales leave the range of the decoder's fixed-point numbers.
SMALLEST_COVARIANCE_STEP = 0.005
# Of scales that are set from the data, in steps: one symbol in eighty is other than zero there.
SMALLEST_SPREAD = 0.2


@dataclass(frozen=True)
class Quantized:
    """Latents as the decoder will have them, in quantization steps, and what they cost."""

    references: Tensor  # [N, reference_dim]
    covariances: Tensor  # [N, 6]
    residuals: Tensor  # [N, K * residual_dim]
    bits: dict[str, Tensor]  # stream -> [N] bits per anchor, as training pays for; empty when not asked for
    # [N] of the references in the file, if they are coded around neighbours; [S] of a sample, if that was asked for
    neighbour_bits: Tensor | None = None

    @property
    def bits_in_file(self) -> dict[str, Tensor]:
        """Bits [N] of the streams that the file has."""
        if self.neighbour_bits is None:
            return self.bits
        others = {name: b for name, b in self.bits.items() if name not in ("reference_hyper", "reference")}
        return {"reference": self.neighbour_bits, **others}

    def latents(self) -> tuple[Tensor, Tensor, Tensor]:
        """References, covariances and residuals."""
        return self.references, self.covariances, self.residuals

    def cut(self) -> "Quantized":
        """The same latents as leaves of another graph: gradients of what is made of them end there."""
        references, covariances, residuals = (latent.detach().requires_grad_() for latent in self.latents())
        return Quantized(references, covariances, residuals, {})

    def of(self, part: Tensor | None) -> "Quantized":
        """Return the rows `part` [V] int64, without `neighbour_bits`; None: everything."""
        if part is None:
            return self
        references, covariances, residuals = (latent.index_select(0, part) for latent in self.latents())
        bits = {name: of_stream.index_select(0, part) for name, of_stream in self.bits.items()}
        return Quantized(references, covariances, residuals, bits)


class EntropyModel(nn.Module):
    """The references as context for everything else; neighbours or a hyperprior for them, or none (CompGS Sec. 3.3).

    f ──analysis──► z_f ──► (mean, scale) of f        or        f_hat of neighbours ──► (mean, scale) of f
    f_hat ──► (mean, scale) of c

    Residual embeddings, which here all anchors share, pass through: the file holds them beside the heads.
    """

    def __init__(self, model: ModelConfig, entropy: EntropyConfig) -> None:
        super().__init__()
        self.slots = model.coupled_primitives
        self.residual_channels = model.coupled_primitives * model.residual_dim
        shape = entropy.network_blocks, model.width
        self.reference_context: Hyperprior | NoContext
        if model.reference_context == "none":
            self.reference_context = NoContext()
            self.reference_network = EntropyNetwork(NoContext.outputs, model.reference_dim)
            self.reference_network.make_constant()
        else:
            hyper = entropy.reference_hyper_dim
            self.reference_context = Hyperprior("reference_hyper", model.reference_dim, hyper)
            self.reference_network = EntropyNetwork(hyper, model.reference_dim, *shape)
        follows = model.reference_context == "neighbours"
        self.neighbour_network = NeighbourNetwork(model.reference_dim) if follows else None
        # Log scales span a few natural units, that is dozens of steps.
        self.covariance_network = EntropyNetwork(
            model.reference_dim, 6, *shape, mean_gain=1.0 / entropy.steps.covariance
        )
        self.log_covariance_step = nn.Parameter(torch.full((6,), entropy.steps.covariance).log())

    @property
    def context_of_references(self) -> Literal["neighbours", "hyperprior", "none"]:
        """Names what the file knows of references before they are decoded."""
        if self.neighbour_network is not None:
            return "neighbours"
        return "hyperprior" if isinstance(self.reference_context, Hyperprior) else "none"

    @property
    def covariance_step(self) -> Tensor:
        """s_Sigma [6]: learned quantization steps of the log scales (Sec. 3.4)."""
        return self.log_covariance_step.exp().clamp_min(SMALLEST_COVARIANCE_STEP)

    @property
    def coded_networks(self) -> tuple[EntropyNetwork, ...]:
        """The networks that the decoder needs, and so the file holds."""
        return self.neighbour_network or self.reference_network, self.covariance_network

    @property
    def reference_networks(self) -> tuple[EntropyNetwork, ...]:
        """All that say what to expect of the references."""
        own = self.reference_network
        return (own,) if self.neighbour_network is None else (own, self.neighbour_network)

    @property
    def channels(self) -> dict[str, int]:
        """Symbols that each stream codes for an anchor, by the stream's name."""
        return {
            **self.reference_context.channels,
            "reference": self.reference_network.channels,
            "covariance": self.covariance_network.channels,
        }

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

    def readers(self) -> Iterator[ReferenceLayer]:
        """The layers that take the references."""
        yield from self.reference_context.readers()
        yield from self.covariance_network.readers(0)

    def starting_residuals(self) -> Tensor:
        """[K * residual_dim] residual embeddings that training starts from, in quantization steps."""
        return torch.empty(self.residual_channels).uniform_(-SLOT_SPREAD, SLOT_SPREAD)

    @torch.no_grad()
    def restart_reference_scales(
        self, references: Tensor, around: Callable[[], Tensor | None] = lambda: None
    ) -> list[nn.Parameter]:
        """Scales of the references as they are now, [N, reference_dim], whatever the hyperprior or neighbours say of
        them, and without a hyperprior their means; the parameters whose second halves the scales are. `around`: what
        neighbours have by then (`forward`).
        """
        network, context, neighbours = self.reference_network, self.reference_context, self.neighbour_network
        if isinstance(context, NoContext):
            _start_means(network, references)
        mean, _ = network(context.decoded(context(references)))
        restarted = _start_scales(network, references - mean)
        if neighbours is not None:
            _start_means(neighbours, references)
            known = around()
            assert known is not None
            deviations = references - neighbours.centre - neighbours.moved(known)
            restarted += _start_scales(neighbours, deviations, known[:, :BESIDES])
        return restarted

    def forward(
        self,
        references: Tensor,  # [N, reference_dim] steps
        covariances: Tensor,  # [N, 6] log scales over the covariance step
        residuals: Tensor,  # [N, K * residual_dim] steps; [1, K * residual_dim] if all anchors share them, uncoded
        *,
        rate: bool,
        noise: Callable[[Tensor], Tensor] | None = None,
        network_bits: int | None = None,
        mask: Tensor | None = None,  # [N, K] bool: coupled primitives that are coded; default all
        # [S, 2 + reference_dim] `Neighbourhood.around`, if references see neighbours and `rate`
        around: Tensor | None = None,
        sample: Tensor | None = None,  # [S] int64: the anchors that `around` is of; None: all N
    ) -> Quantized:
        """Quantize, and estimate the bits if `rate`.

        With `noise` the likelihood sees uniform noise (training), without it the symbols themselves (the size of the
        file). `network_bits`: the networks' weights as the file will hold them. Where references see neighbours, the
        rate that leads them is that of the hyperprior; the network of the neighbours learns beside it.
        """
        code = partial(code_latents, rate=rate, noise=noise, network_bits=network_bits)
        neighbours, bits, bits_n = self.neighbour_network, {}, None
        if neighbours is None or rate:
            z = self.reference_context(references)
            f_hat, bits_f = code(references, self.reference_context.decoded(z), self.reference_network)
            bits = {**(self.reference_context.bits(z, noise) if rate else {}), "reference": bits_f}
        if neighbours is not None:
            f_hat, bits_n = neighbours.code(
                references, around, sample, code, rate=rate, noise=noise, bits=network_bits
            )
        c_hat, bits["covariance"] = code(covariances, f_hat, self.covariance_network)
        g_hat, bits_g = self.code_residuals(residuals, f_hat, code, rate=rate, noise=noise, mask=mask)
        return Quantized(f_hat, c_hat, g_hat, {**bits, **bits_g} if rate else {}, bits_n)

    def code_residuals(
        self,
        residuals: Tensor,
        f_hat: Tensor,  # [N, reference_dim]
        code: "Coder",
        *,
        rate: bool,
        noise: Callable[[Tensor], Tensor] | None,
        mask: Tensor | None,
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """g_hat [N, K * residual_dim], and bits [N] of the streams that this takes; arguments as of `forward`."""
        return residuals.expand(len(f_hat), -1), {}


class OwnResidualsEntropyModel(EntropyModel):
    """The same where each anchor has its own residual embeddings, as in the paper.

    g ──analysis──► z_g ┐
    f_hat ──────────────┴──► (mean, scale) of g
    """

    def __init__(self, model: ModelConfig, entropy: EntropyConfig) -> None:
        super().__init__(model, entropy)
        hyper = self.slots  # one channel for each coupled primitive (Ref.)
        self.residual_hyperprior = Hyperprior("residual_hyper", self.residual_channels, hyper)
        self.residual_network = EntropyNetwork(
            model.reference_dim + hyper,
            self.residual_channels,
            entropy.network_blocks,
            model.width,
        )
        with torch.no_grad():
            self.residual_network.biases[-1][: self.residual_channels].uniform_(-SLOT_SPREAD, SLOT_SPREAD)

    @property
    def coded_networks(self) -> tuple[EntropyNetwork, ...]:
        return *super().coded_networks, self.residual_network

    @property
    def channels(self) -> dict[str, int]:
        own = {**self.residual_hyperprior.channels, "residual": self.residual_channels}
        return {**super().channels, **own}

    def readers(self) -> Iterator[ReferenceLayer]:
        yield from super().readers()
        yield from self.residual_network.readers(0)

    def starting_residuals(self) -> Tensor:
        """[K * residual_dim] residual embeddings that a new anchor starts with: what the prior expects."""
        return self.residual_network.biases[-1].detach()[: self.residual_channels].clone()

    def code_residuals(
        self,
        residuals: Tensor,
        f_hat: Tensor,
        code: "Coder",
        *,
        rate: bool,
        noise: Callable[[Tensor], Tensor] | None,
        mask: Tensor | None,
    ) -> tuple[Tensor, dict[str, Tensor]]:
        z_g = self.residual_hyperprior(residuals)
        context = torch.cat([f_hat, self.residual_hyperprior.decoded(z_g)], 1)
        g_hat, bits_g = code(residuals, context, self.residual_network, mask=mask)
        hyper = self.residual_hyperprior.bits(z_g, noise) if rate else {}
        return g_hat, {**hyper, "residual": bits_g}


def _start_means(network: EntropyNetwork, references: Tensor) -> None:
    # numpy's sums do not depend on the number of threads
    means = torch.from_numpy(references.double().cpu().numpy().mean(0))
    network.biases[-1][: network.channels] = means.to(network.biases[-1])


def _start_scales(
    network: EntropyNetwork, deviations: Tensor, known: Tensor | None = None
) -> list[nn.Parameter]:
    """The parameters whose second halves they are. What is `known` [N, inputs] goes on to say of all channels alike
    what it said on average; None: nothing.
    """
    weight, bias = network.weights[-1], network.biases[-1]
    spread = np.maximum(deviations.double().cpu().numpy().std(0), SMALLEST_SPREAD)
    scales = weight[network.channels :]
    scales[:] = 0 if known is None else scales.mean(0)
    said = (
        0.0
        if known is None
        else float(scales[0].double().cpu().numpy() @ known.double().cpu().numpy().mean(0))
    )
    bias[network.channels :] = torch.from_numpy(np.log2(spread) - said)
    return [weight, bias]


Coder = Callable[..., tuple[Tensor, Tensor]]  # `code_latents` with what a whole step has in common


def make_entropy_model(model: ModelConfig, entropy: EntropyConfig) -> EntropyModel:
    """The one for a model's kind of residual embeddings: chosen here, once."""
    return (OwnResidualsEntropyModel if model.residuals else EntropyModel)(model, entropy)
