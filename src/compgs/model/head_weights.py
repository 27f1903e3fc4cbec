"""The prediction networks of a scene as named arrays: which networks there are, their shapes, and their kernels."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from compgs.model.arrays import MLPArrays
from compgs.model.constants import VIEW_DIM
from compgs.model.inference import HeadArrays, PairedArrays, SeparateArrays

Layout = Literal["separate", "paired", "shallow"]


@dataclass(frozen=True)
class HeadDimensions:
    """Channels of what the networks take, and of their hidden layers."""

    reference: int
    residual: int
    width: int


@dataclass(frozen=True)
class NetworkShape:
    """A residual MLP among the heads."""

    sees: bool  # whether it takes the view embedding, after the reference embedding
    outputs: int
    blocks: int

    def anchor_dim(self, reference: int) -> int:
        """Inputs that are the anchor's."""
        return reference + VIEW_DIM * self.sees


# Of each layout, in the order of the file. Outputs: opacity and color; translation, scaling and quaternion.
NETWORKS: dict[Layout, dict[str, NetworkShape]] = {
    "separate": {
        "translation": NetworkShape(False, 3, 1),
        "covariance": NetworkShape(False, 7, 1),
        "opacity": NetworkShape(True, 1, 1),
        "color": NetworkShape(True, 3, 2),
    },
    "paired": {"geometry": NetworkShape(False, 10, 1), "appearance": NetworkShape(True, 4, 1)},
    "shallow": {"geometry": NetworkShape(False, 10, 0), "appearance": NetworkShape(True, 4, 0)},
}


def weight_shapes(layout: Layout, dimensions: HeadDimensions) -> dict[str, tuple[int, ...]]:
    """Return the shapes of all weights of a layout, by name (docs/bitstream_prediction.md)."""
    shapes: dict[str, tuple[int, ...]] = {}
    width = dimensions.width
    for network, shape in NETWORKS[layout].items():
        inputs = shape.anchor_dim(dimensions.reference) + dimensions.residual
        own: dict[str, tuple[int, ...]] = {"input_weight": (inputs, width), "input_bias": (width,)}
        own |= {"output_weight": (width, shape.outputs), "output_bias": (shape.outputs,)}
        own["skip_weight"] = (inputs, shape.outputs)
        for block in range(shape.blocks):
            for layer in (1, 2):
                own[f"blocks.{block}.weight{layer}"] = (width, width)
                own[f"blocks.{block}.bias{layer}"] = (width,)
        shapes |= {f"{network}.{name}": size for name, size in own.items()}
    return shapes


@dataclass(frozen=True, eq=False)
class HeadWeights:
    """The weights of all networks, float32."""

    layout: Layout
    dimensions: HeadDimensions
    tensors: Mapping[str, np.ndarray]  # by name; their shapes are `weight_shapes`

    def arrays(self) -> HeadArrays:
        """Return the arrays that the kernels take."""
        networks = [
            MLPArrays.of(self._of(network), shape.anchor_dim(self.dimensions.reference))
            for network, shape in NETWORKS[self.layout].items()
        ]
        return SeparateArrays(*networks) if self.layout == "separate" else PairedArrays(*networks)

    def _of(self, network: str) -> dict[str, np.ndarray]:
        """The weights of a network, without its name in front of theirs."""
        start = f"{network}."
        return {n.removeprefix(start): t for n, t in self.tensors.items() if n.startswith(start)}
