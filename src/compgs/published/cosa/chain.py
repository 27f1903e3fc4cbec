"""The causal chain in integers: encoder and decoder walk along it by one function, so that they cannot drift apart.

Everything that says which table a symbol is coded with is a network in fixed point (`codec/integer_network.py`), from
numbers that are decoded already. Values are Q12, in units of their group's step.
"""

from collections.abc import Callable, Mapping

import numpy as np

from compgs.codec.content import fixed_point
from compgs.codec.integer_network import FRACTION_BITS, IntegerNetwork, entropy_parameters, evaluate
from compgs.published.cosa.shape import ChainShape

# (group, means Q12, tables of the Gaussians) -> symbols, all [N, channels]; of offsets [P, 3], of those that exist.
Code = Callable[[str, np.ndarray, np.ndarray], np.ndarray]


def coordinate_inputs(coordinates: np.ndarray, origin: np.ndarray, depth: int) -> np.ndarray:
    """[N, 3] voxels -> [N, 3] int32 Q12, -1 to 1: where an anchor is in a cube of 2^depth voxels at `origin` [3]."""
    side = np.int64(1) << depth
    offsets = np.clip(coordinates.astype(np.int64) - origin, 0, side - 1)
    return ((((2 * offsets + 1) << FRACTION_BITS) >> depth) - (1 << FRACTION_BITS)).astype(np.int32)


def walk(
    shape: ChainShape,
    networks: Mapping[str, IntegerNetwork],
    places: np.ndarray,  # [N, 3] `coordinate_inputs`
    mask: np.ndarray,  # [N, K] bool: coupled primitives that exist
    code: Code,
) -> dict[str, np.ndarray]:  # of each group: Q12, [N, channels]; of offsets [P, 3]
    """Code all groups, each given those before."""

    def group(name: str, network: str, context: np.ndarray, slots: np.ndarray | None = None) -> np.ndarray:
        means, tables = entropy_parameters(networks[network], context, slots)
        return means + fixed_point(code(name, means, tables))

    geometry = evaluate(networks["geometry"], places)
    latents = np.zeros((len(places), 0), np.int32)
    for channel in range(shape.latents):
        found = group("latent", f"latent{channel}", np.concatenate([geometry, latents], 1))
        latents = np.concatenate([latents, found], 1)
    embedding = evaluate(networks["embedding"], latents)
    anchor = evaluate(networks["anchor"], np.concatenate([geometry, embedding], 1))
    feature = group("feature", "feature", anchor)
    position_scale = group("position_scale", "position_scale", anchor)
    both = np.concatenate([anchor, evaluate(networks["scale_embedding"], position_scale)], 1)
    offset = group("offset", "offset", both, mask)
    size = group("size", "size", both)
    return {
        "latent": latents,
        "feature": feature,
        "position_scale": position_scale,
        "offset": offset,
        "size": size,
    }
