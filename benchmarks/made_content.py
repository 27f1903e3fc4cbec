"""Made-up but plausible file contents: for the codec's tests, golden files and benchmark."""

from dataclasses import replace

import numpy as np
from made_heads import make_heads

from compgs.codec.content import (
    LOG_SCALES,
    Dimensions,
    FileContent,
    Group,
    GroupShape,
    Role,
    code_group,
    fixed_point,
    surroundings,
)
from compgs.codec.integer_network import FRACTION_BITS, Follow, IntegerLayer, IntegerNetwork
from compgs.codec.rows import RowContext, chain_length
from compgs.codec.tables import hyper_tables
from compgs.config import Heads
from compgs.ordering.order import canonical_order

WEIGHT_SHIFT = 10
RANDOM_ROWS = 16384


def paper_groups(
    reference: int = 32, residual: int = 8, reference_hyper: int = 4, residual_hyper: int = 10
) -> tuple[GroupShape, ...]:
    """The paper's chain (Sec. 3.3), by numbers of channels; residual 0: all anchors share their residual embeddings."""
    chain = (
        GroupShape(Role.SIDE, reference_hyper),
        GroupShape(Role.REFERENCE, reference, (1.0,), (0,)),
        GroupShape(Role.LOG_SCALES, LOG_SCALES, (0.0625,), (1,)),
    )
    if residual == 0:
        return chain
    own = GroupShape(Role.SIDE, residual_hyper), GroupShape(Role.RESIDUAL, residual, (1.0,), (1, 3))
    return (*chain, *own)


def make_dimensions(
    coupled_primitives: int = 10,
    groups: tuple[GroupShape, ...] | None = None,
    heads: Heads = "paired",
    width: int = 32,
    residual_dim: int = 8,
) -> Dimensions:
    """The paper's, but for what is given. `residual_dim` counts only without a group of residuals."""
    groups = paper_groups() if groups is None else groups
    coded = sum(g.channels for g in groups if g.role == Role.RESIDUAL)
    return Dimensions(coupled_primitives, coded or residual_dim, heads, width, groups)


def make_content(
    anchors: int,
    seed: int = 0,
    dimensions: Dimensions | None = None,
    *,
    kept: float = 0.8,  # share of coupled primitives that exist
    blocks: int = 0,  # residual blocks of the entropy networks; 0: one linear layer
    hidden: int = 8,  # width of their hidden layers
    symbols: bool = True,  # False: zero symbols, and networks that are sure of it
    angular_dilation: float | None = None,
    row_context: bool = False,  # chains and inertia; only with an angular dilation
) -> FileContent:
    """Content whose symbols follow its own networks' predictions, as a trained model's do."""
    d = dimensions or make_dimensions()
    rng = np.random.default_rng(seed)
    coordinates = make_coordinates(anchors, rng)
    if any(shape.sees_neighbours for shape in d.groups):
        coordinates = coordinates[canonical_order(coordinates)]
    mask = rng.random((anchors, d.coupled_primitives)) < kept
    # Symbols of all slots are drawn; a mask of ones here keeps the draw apart from the mask.
    everything = np.ones_like(mask)
    known = surroundings(coordinates)
    latents: list[np.ndarray] = []
    groups = []
    for shape in d.groups:
        rows = anchors * (d.coupled_primitives if shape.role == Role.RESIDUAL else 1)
        if shape.has_network:
            prior: IntegerNetwork | tuple = _network(rng, *d.network_size(shape), blocks, hidden, symbols)
            if shape.sees_neighbours:
                follow = rng.integers(-600, 900, shape.channels).astype(np.int32)
                prior = replace(prior, follow=Follow(follow, WEIGHT_SHIFT))
            if row_context:
                prior = replace(prior, rows=_row_context(rng, shape.channels))
            coded = code_group(
                shape,
                prior,
                latents,
                known,
                everything,
                lambda rows, means, index: _draw(rng, index, symbols),
            )
            drawn = coded.symbols
            latents.append(coded.latents)
        else:
            spread = np.linspace(0.5, 6.0, shape.channels)
            drawn = np.rint(rng.standard_normal((rows, shape.channels)) * spread * symbols).astype(np.int32)
            prior = hyper_tables(
                np.full((shape.width(d.coupled_primitives), 49), 1.0 / 49), drawn.reshape(anchors, -1)
            )
            latents.append(fixed_point(drawn))
        if shape.role == Role.RESIDUAL:
            drawn = drawn.reshape(anchors, d.coupled_primitives, shape.channels) * mask[:, :, None]
        groups.append(Group(shape, prior, drawn))
    return FileContent(
        coupled_primitives=d.coupled_primitives,
        residual_dim=d.residual_dim,
        heads_layout=d.heads,
        width=d.width,
        voxel_size=0.015625,
        world_offset=(0.0, 0.0, 0.0),
        view_distance_scale=3.0,
        background=(0.0, 0.5, 1.0),
        angular_dilation=angular_dilation,
        coordinates=coordinates,
        mask=mask,
        groups=tuple(groups),
        heads=make_heads(rng, d),
        metadata={"creator": "made up"},
    )


def _draw(rng: np.random.Generator, index: np.ndarray, symbols: bool) -> np.ndarray:
    drawn = np.zeros(index.shape, np.int32)
    for start in range(0, len(index) if symbols else 0, RANDOM_ROWS):
        scales = np.exp2(index[start : start + RANDOM_ROWS] / np.float32(12) - np.float32(5))
        noise = rng.standard_normal(scales.shape, np.float32)
        drawn[start : start + RANDOM_ROWS] = np.rint(noise * scales)
    return drawn


def make_coordinates(anchors: int, rng: np.random.Generator) -> np.ndarray:  # [N, 3] int32
    """Distinct voxels near a few curved surfaces, in no order."""
    found = np.zeros((0, 3), np.int32)
    extent = 4.0 * np.sqrt(anchors) + 8.0
    while len(found) < anchors:
        directions = rng.standard_normal((anchors + 16, 3))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        radii = extent * rng.choice([0.2, 0.5, 1.0], len(directions)) + rng.standard_normal(len(directions))
        points = np.rint(directions * radii[:, None]).astype(np.int32)
        found = np.unique(np.concatenate([found, points]), axis=0)
    return np.ascontiguousarray(found[rng.permutation(len(found))[:anchors]])


def _row_context(rng: np.random.Generator, channels: int) -> RowContext:
    chain = rng.integers(-24, 25, chain_length(channels)).astype(np.int32) if channels > 1 else None
    return RowContext(chain, int(rng.integers(1, 20)))


def _network(
    rng: np.random.Generator, inputs: int, outputs: int, blocks: int, hidden: int, spread: bool
) -> IntegerNetwork:
    """Means within a few steps, scales between a quarter of a step and a few steps."""
    layers = []
    taken = inputs
    for i in range(1 + 2 * blocks if blocks else 0):
        n_in = inputs if i == 0 else hidden
        weight = rng.standard_normal((hidden, n_in)) / np.sqrt(n_in)
        layers.append(
            _layer(weight, np.zeros(hidden), rectify=i % 2 == 1 or i == 0, adds=i % 2 == 0 and i > 0)
        )
        taken = hidden + inputs
    channels = outputs // 2
    weight = rng.standard_normal((outputs, taken)) / np.sqrt(taken) * 0.3
    bias = np.concatenate([rng.uniform(-1, 1, channels), rng.uniform(36, 72, channels) * spread])
    weight[channels:] *= spread
    layers.append(_layer(weight, bias, rectify=False))
    return IntegerNetwork(tuple(layers), skip=blocks > 0)


def _layer(weight: np.ndarray, bias: np.ndarray, *, rectify: bool, adds: bool = False) -> IntegerLayer:
    return IntegerLayer(
        weight=np.rint(weight * (1 << WEIGHT_SHIFT)).astype(np.int32),
        bias=np.rint(bias * (1 << FRACTION_BITS)).astype(np.int64),
        shift=WEIGHT_SHIFT,
        rectify=rectify,
        adds=adds,
    )
