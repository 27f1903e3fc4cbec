"""Made-up but plausible prediction heads: every tensor that a file of given dimensions must have, under its name."""

from collections.abc import Iterator

import numpy as np

from compgs.codec.content import Dimensions, Role
from compgs.codec.weights import QuantizedTensor

WEIGHT_EXPONENT = 10  # a weight is a whole number times 2^-10
VIEW_DIM = 4
# (whether it sees the view, outputs, blocks) of each network, by layout
NETWORKS = {
    "separate": {
        "translation": (False, 3, 1),
        "covariance": (False, 7, 1),
        "opacity": (True, 1, 1),
        "color": (True, 3, 2),
    },
    "paired": {"geometry": (False, 10, 1), "appearance": (True, 4, 1)},
    "shallow": {"geometry": (False, 10, 0), "appearance": (True, 4, 0)},
}


def head_shapes(d: Dimensions) -> dict[str, tuple[int, ...]]:
    """Shape of every tensor, by name; where no group holds residuals, those that all anchors share are among them."""
    shapes: dict[str, tuple[int, ...]] = {}
    for network, (seen, outputs, blocks) in NETWORKS[d.heads].items():
        inputs = d.reference_dim + VIEW_DIM * seen + d.residual_dim
        shapes |= {
            f"{network}.{name}": shape for name, shape in _network_shapes(inputs, outputs, d.width, blocks)
        }
    if d.channels(Role.RESIDUAL) == 0:
        shapes["residuals"] = (d.coupled_primitives, d.residual_dim)
    return shapes


def make_heads(rng: np.random.Generator, d: Dimensions) -> tuple[tuple[str, QuantizedTensor], ...]:
    """Weights that keep the size of what they are applied to, and small biases: many primitives are drawn, not all."""
    heads = []
    for name, shape in head_shapes(d).items():
        spread = _spread(name, shape)
        values = rng.standard_normal(shape) * spread * 2.0**WEIGHT_EXPONENT
        heads.append((name, QuantizedTensor(np.rint(values).astype(np.int32), WEIGHT_EXPONENT)))
    return tuple(heads)


def _spread(name: str, shape: tuple[int, ...]) -> float:
    """Standard deviation of a tensor's numbers."""
    if name == "residuals":
        return 1.0
    return 1.0 / np.sqrt(shape[0]) if len(shape) == 2 else 0.125


def _network_shapes(
    inputs: int, outputs: int, width: int, blocks: int
) -> Iterator[tuple[str, tuple[int, ...]]]:
    yield "input_weight", (inputs, width)
    yield "input_bias", (width,)
    yield "output_weight", (width, outputs)
    yield "output_bias", (outputs,)
    yield "skip_weight", (inputs, outputs)
    for b in range(blocks):
        for i in (1, 2):
            yield f"blocks.{b}.weight{i}", (width, width)
            yield f"blocks.{b}.bias{i}", (width,)
