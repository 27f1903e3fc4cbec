"""The three networks of an anchor: two layers each, all K coupled primitives at once (Scaffold-GS, Sec. 3.2)."""

import math
from collections.abc import Mapping

import torch
from torch import Tensor, nn

from compgs.model.constants import VIEW_DIM
from compgs.published.anchors import NETWORKS, tensor_name
from compgs.tensors.linear import linear

OPACITY_BIAS = 0.15  # where opacity starts at or below zero no gradient flows


class ViewNetworks(nn.Module):
    """Opacity [K], color [3 K], scale and rotation [7 K] of an anchor's coupled primitives from its feature, and from
    where it is seen.

    Parameters are held by the names that files give them: `opacity_weight1` [inputs, width], `opacity_bias1` ...
    """

    def __init__(self, feature_dim: int, coupled: int, width: int) -> None:
        super().__init__()
        for name, channels in NETWORKS.items():
            sizes = ((feature_dim + VIEW_DIM, width), (width, channels * coupled))
            for layer, (inputs, outputs) in enumerate(sizes, 1):
                bound = 1.0 / math.sqrt(inputs)
                for kind, shape in (("weight", (inputs, outputs)), ("bias", (outputs,))):
                    values = torch.empty(shape).uniform_(-bound, bound)
                    setattr(self, tensor_name(name, kind, layer), nn.Parameter(values))
        with torch.no_grad():
            self.get_parameter(tensor_name("opacity", "bias", 2)).abs_().add_(OPACITY_BIAS)

    def weights(self) -> dict[str, Tensor]:
        """Return the weights by name."""
        return dict(self.named_parameters())

    def of(self, name: str) -> list[nn.Parameter]:
        """The parameters of one network."""
        return [p for key, p in self.named_parameters() if key.startswith(f"{name}_")]


def applied(weights: Mapping[str, Tensor], name: str, seen: Tensor) -> Tensor:
    """Raw outputs [V, channels * K] of a network, for `seen` [V, feature_dim + 4]: feature and view embedding."""

    def layer(x: Tensor, number: int) -> Tensor:
        weight, bias = (weights[tensor_name(name, kind, number)] for kind in ("weight", "bias"))
        return linear(x, weight, bias)

    return layer(torch.relu(layer(seen, 1)), 2)
