"""The prediction networks (CompGS Sec. 3.2), behind one interface.

    t_k = phi(f, g_k)    S_k = psi(f, g_k), R_k = varphi(f, g_k)    alpha_k = kappa(v, f, g_k)    c_k = zeta(v, f, g_k)

are either separate networks (the paper), or paired into one for geometry and one for appearance, which halves weights
and time, or paired without residual blocks (shallow), which takes six tenths. `make_heads` chooses, once;
names of parameters are those of docs/bitstream_prediction.md.
"""

from abc import abstractmethod
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from compgs.gaussians import Gaussians
from compgs.model.head_weights import NETWORKS, HeadDimensions, HeadWeights, Layout
from compgs.tensors import where
from compgs.tensors.autograd import PairedPrediction
from compgs.tensors.linear import ReferenceLayer
from compgs.tensors.prediction import Heads, Prediction
from compgs.tensors.primitives import Primitives
from compgs.tensors.residual_mlp import ResidualMLP

OPACITY_BIAS = 0.15  # where opacity starts at or below zero no gradient flows


class PredictionHeads(Heads):
    """What both kinds of heads can do."""

    layout: Layout

    def __init__(self, dimensions: HeadDimensions) -> None:
        super().__init__()
        self.dimensions = dimensions

    def weights(self) -> HeadWeights:
        """The same networks for rendering, as they are now; on the CPU they share the memory of the parameters."""
        tensors = {name: p.detach().cpu().numpy() for name, p in self.named_parameters()}
        # Training may have taken reference channels away since the networks were made.
        blind = next(head for name, head in self.networks() if not NETWORKS[self.layout][name].sees)
        dimensions = replace(self.dimensions, reference=blind.anchor_dim)
        return HeadWeights(self.layout, dimensions, tensors)

    @abstractmethod
    def pass_colors(self, mean: Tensor) -> None:
        """The first three reference channels, plus `mean` [3], are the colors' logits, before anything is learned."""

    def networks(self) -> Iterator[tuple[str, ResidualMLP]]:
        """Yield the networks by the names that the file gives them."""
        for name, network in self.named_children():
            assert isinstance(network, ResidualMLP)
            yield name, network

    def readers(self, reference_step: float) -> Iterator[ReferenceLayer]:
        """The layers that take the references."""
        for _, network in self.networks():
            yield ReferenceLayer(network.input_weight, network.input_bias, 0, 0, reference_step)
            yield ReferenceLayer(network.skip_weight, network.output_bias, 0, 0, reference_step)


class PairedHeads(PredictionHeads):
    """Two networks: geometry (10 outputs) and appearance (opacity and color)."""

    layout: Layout = "paired"

    def __init__(self, dimensions: HeadDimensions) -> None:
        super().__init__(dimensions)
        self.geometry, self.appearance = _networks(self.layout, dimensions)
        _start_visible(self.appearance)

    def raw_geometry(self, f: Tensor, residuals: Tensor, index: Tensor) -> Tensor:
        out: Tensor = self.geometry(f, residuals, index)
        return out

    def raw_appearance(self, seen: Tensor, residuals: Tensor, index: Tensor) -> Tensor:
        out: Tensor = self.appearance(seen, residuals, index)
        return out

    def raw_color(
        self, raw: Tensor, chosen: Tensor | None, seen: Tensor, residuals: Tensor, index: Tensor
    ) -> Tensor:
        return (raw if chosen is None else raw.index_select(0, chosen))[:, 1:4]

    @torch.no_grad()
    def pass_colors(self, mean: Tensor) -> None:
        _pass_colors(self.appearance, 1, mean)

    def predict_drawn(
        self, primitives: Primitives, seen: Tensor, appearance_dtype: torch.dtype = torch.float32
    ) -> Prediction:
        """Predict what is drawn; on the CPU in float32 one pass of kernels computes networks and all around them."""
        if not where.runs_in_kernels(seen.device, seen.dtype, appearance_dtype):
            return super().predict_drawn(primitives, seen, appearance_dtype)
        p = primitives
        appearance, appearance_weights = self.appearance.begin(seen)
        geometry, geometry_weights = self.geometry.begin(p.references)
        means, scales, quaternions, shown, colors, index, opacities = PairedPrediction.apply(
            appearance, geometry, p.residuals, p.log_scales, p.positions, p.anchor_index, p.voxel_size,
            *appearance_weights, *geometry_weights,
        )  # fmt: skip
        return Prediction(Gaussians(means, quaternions, scales, shown, colors), index, opacities)


class ShallowHeads(PairedHeads):
    """The same with a single hidden layer each."""

    layout: Layout = "shallow"


class SeparateHeads(PredictionHeads):
    """Four networks, as in the paper: translation, covariance (scaling and quaternion), opacity, color."""

    layout = "separate"

    def __init__(self, dimensions: HeadDimensions) -> None:
        super().__init__(dimensions)
        networks = _networks(self.layout, dimensions)
        self.translation, self.covariance, self.opacity, self.color = networks
        _start_visible(self.opacity)

    def raw_geometry(self, f: Tensor, residuals: Tensor, index: Tensor) -> Tensor:
        translation = self.translation(f, residuals, index)
        return torch.cat([translation, self.covariance(f, residuals, index)], 1)

    def raw_appearance(self, seen: Tensor, residuals: Tensor, index: Tensor) -> Tensor:
        out: Tensor = self.opacity(seen, residuals, index)
        return out

    def raw_color(
        self, raw: Tensor, chosen: Tensor | None, seen: Tensor, residuals: Tensor, index: Tensor
    ) -> Tensor:
        out: Tensor = self.color(seen, residuals, index)
        return out

    @torch.no_grad()
    def pass_colors(self, mean: Tensor) -> None:
        _pass_colors(self.color, 0, mean)


LAYOUTS: dict[str, type[PairedHeads] | type[SeparateHeads]] = {
    "separate": SeparateHeads,
    "paired": PairedHeads,
    "shallow": ShallowHeads,
}


def _networks(layout: Layout, dimensions: HeadDimensions) -> list[ResidualMLP]:
    """New ones, in the order of the file."""
    d = dimensions
    return [
        ResidualMLP(shape.anchor_dim(d.reference), d.residual, shape.outputs, d.width, shape.blocks)
        for shape in NETWORKS[layout].values()
    ]


def heads_of(weights: HeadWeights) -> PredictionHeads:
    """Inverse of `PredictionHeads.weights`; without gradients, the weights are copied."""
    heads = make_heads(weights.layout, weights.dimensions).requires_grad_(False)
    for name, parameter in heads.named_parameters():
        parameter.copy_(torch.from_numpy(np.array(weights.tensors[name])))
    return heads


def make_heads(layout: str, dimensions: HeadDimensions) -> PredictionHeads:
    """New heads of a layout of the configuration or of a file: "separate", "paired" or "shallow"."""
    return LAYOUTS[layout](dimensions)


@torch.no_grad()
def _start_visible(network: ResidualMLP) -> None:
    """`network` has opacity as its first output."""
    network.output_bias[0] = OPACITY_BIAS


@torch.no_grad()
def _pass_colors(network: ResidualMLP, first: int, mean: Tensor) -> None:
    """`pass_colors` of a network whose outputs from `first` on are the color."""
    network.skip_weight[:3] = 0
    network.skip_weight[:3, first : first + 3] = torch.eye(3)
    network.output_bias[first : first + 3] = mean
