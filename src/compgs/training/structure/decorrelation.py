"""References in their principal axes: the same scene in fewer bits.

Every channel of a reference embedding is quantized and coded for itself, given a hyperprior of a few channels: what
channels have in common is paid for more than once. All that reads references, the prediction heads and the entropy
model, begins with a linear layer. So for any orthonormal U

    references U,    weights U^T in those layers

is the same scene, with rounding errors of the same size. Of all U the principal axes of the references (the
Karhunen-Loeve transform; Goyal 2001, "Theoretical foundations of transform coding") leave Gaussian channels the least
bits, and the file needs nothing new: the weights that it holds anyway absorb U. References change and anchors are added
while training goes on, so this is done several times in a run.

Adam moves all channels alike. But the first axes hold most of the information and would learn too slowly, while the
last ones hardly leave zero and would only wander. So the learning rates follow the spread of the channels.
"""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from compgs.tensors import where
from compgs.tensors.linear import transposed_product
from compgs.trained_model import TrainedModel
from compgs.training.optimizers import replace_parameter
from compgs.training.run.restoring import check_tensor


@torch.no_grad()
def principal_axes(references: Tensor) -> Tensor:
    """[C, C] orthonormal columns: the axes of references [N, C], largest variance first. They are not unique where
    variances are equal, as with fewer anchors than channels.
    """
    centered = references - references.mean(0)
    if where.in_kernels(centered):
        scatter = transposed_product(centered, centered)
    else:
        scatter = centered.t() @ centered
    axes = np.linalg.eigh(scatter.double().cpu().numpy())[1]
    return torch.from_numpy(axes[:, ::-1].copy()).to(references)


@torch.no_grad()
def channel_rates(references: Tensor) -> Tensor:
    """[C] learning rates of the channels of references [N, C], in quantization steps, as multiples of their group's:
    they go with the root of the spread. Rates a seventh higher and lower came out alike (docs/results/decisions.md).
    """
    return torch.from_numpy(np.maximum(1.75 * np.sqrt(_spread(references)), 0.6)).to(references)


class ChannelRates:
    """The channels' learning rates, as multiples of their group's, once references have been turned."""

    def __init__(self, model: TrainedModel, turned_at: frozenset[int]) -> None:
        """`turned_at`: steps of the run at which references are turned."""
        self.model = model
        self.turned_at = turned_at
        self.values: Tensor | None = None  # [reference_dim]; None: all channels have the same

    def follow(self) -> None:
        """Take the rates that the references ask for now."""
        self.values = channel_rates(self.model.references)

    @contextmanager
    def applied(self) -> Iterator[None]:
        """A step of the optimizer inside moves each channel by its own rate."""
        references, rates = self.model.references.detach(), self.values
        if rates is None:
            yield
            return
        before = references.clone()
        yield
        torch.lerp(before, references, rates, out=references)

    def tensors(self) -> dict[str, Tensor]:
        """The rates, for a checkpoint, if there are some."""
        return {} if self.values is None else {"reference_rates": self.values}

    def state(self) -> dict[str, Any]:
        """Nothing beside the tensors."""
        return {}

    def restore(self, tensors: Mapping[str, Tensor], state: Mapping[str, Any]) -> None:
        """Inverse of `tensors`. Raises ValueError, KeyError."""
        if any(at < state["step"] for at in self.turned_at):
            values = tensors["reference_rates"]
            check_tensor(values, (self.model.reference_dim,), torch.float32, "reference_rates")
            self.values = values.to(self.model.device)


@torch.no_grad()
def decorrelate(model: TrainedModel, optimizer: torch.optim.Optimizer) -> None:
    """Turn the references into their principal axes, and the layers that read them and Adam's moments accordingly."""
    axes = principal_axes(model.references)
    for parameter, dimension, first in _along_references(model):
        _turn(parameter.data, dimension, first, axes)
        state = optimizer.state.get(parameter, {})
        if "exp_avg" in state:
            _turn(state["exp_avg"], dimension, first, axes)
            # As if gradients of different channels had nothing in common: more than the squares is not known.
            _turn(state["exp_avg_sq"], dimension, first, axes.square())
    for parameter in model.entropy.restart_reference_scales(model.references, model.around):
        state = optimizer.state.get(parameter, {})
        if "exp_avg" in state:
            state["exp_avg"][model.reference_dim :] = 0


@torch.no_grad()
def drop_silent_channels(model: TrainedModel, optimizer: torch.optim.Optimizer) -> None:
    """Remove the channels that hardly say anything: symbols, and the weights of all that reads them, cost bytes. What
    they are on average goes into biases.
    """
    spread = _spread(model.references)
    # With a spread of 0.3 steps one symbol in ten is other than zero; 0.25 and 0.35 came out alike.
    kept = torch.from_numpy(spread >= min(0.3, spread.max()))
    silent = torch.nonzero(~kept.to(model.device)).view(-1)
    average = model.references.index_select(1, silent).mean(0)
    for reader in model.readers():
        columns = reader.weight.movedim(reader.dimension, -1)[..., reader.first + silent]
        reader.bias.add_(columns @ (average * reader.unit))
    keep_channels(model, kept, optimizer)


@torch.no_grad()
def keep_channels(
    model: TrainedModel,
    kept: Tensor,  # [reference_dim] bool
    optimizer: torch.optim.Optimizer | None = None,
) -> None:
    """The same model without the other channels of its references, and Adam's moments without them."""
    both = kept.repeat(2)  # means and scales
    changes: list[tuple[Tensor, int, int, Tensor]] = [(model.references, 1, 0, kept)]
    for network in model.entropy.reference_networks:
        changes += [(network.weights[-1], 0, 0, both), (network.biases[-1], 0, 0, both)]
        changes += [(parameter, 0, 0, kept) for parameter in network.per_channel]
    changes += [(reader.weight, reader.dimension, reader.first, kept) for reader in model.readers()]
    for parameter, dimension, first, entries in changes:
        change = partial(_narrowed, dimension=dimension, first=first, kept=entries)
        replace_parameter(model, optimizer, parameter, change)
    for network in model.entropy.reference_networks:
        network.keep_channels(kept)
    for _, head in model.heads.networks():
        head.anchor_dim -= len(kept) - model.reference_dim


def _spread(references: Tensor) -> np.ndarray:
    """[C] standard deviations of the channels of references [N, C]."""
    # numpy's sums do not depend on the number of threads
    return references.double().cpu().numpy().std(0)


def _along_references(model: TrainedModel) -> Iterator[tuple[Tensor, int, int]]:
    """Parameters with a dimension along the references' channels: that dimension, and where these begin in it."""
    yield model.references, 1, 0
    for network in model.entropy.reference_networks:
        yield network.weights[-1], 0, 0  # rows of the means; those of the scales come after them
        yield network.biases[-1], 0, 0
    for reader in model.readers():
        yield reader.weight, reader.dimension, reader.first


def _turn(x: Tensor, dimension: int, first: int, matrix: Tensor) -> None:
    """x <- x times matrix [C, C] along `dimension`, of which the C entries from `first` on are meant."""
    part = x.narrow(dimension, first, len(matrix))
    part.copy_((part.movedim(dimension, -1) @ matrix).movedim(-1, dimension))


def _narrowed(x: Tensor, dimension: int, first: int, kept: Tensor) -> Tensor:
    """x without those of the C entries from `first` on along `dimension` that are not `kept` [C]."""
    all_kept = torch.ones(x.shape[dimension], dtype=torch.bool)
    all_kept[first : first + len(kept)] = kept
    return x.index_select(dimension, torch.nonzero(all_kept).view(-1).to(x.device))
