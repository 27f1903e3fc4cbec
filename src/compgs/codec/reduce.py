"""A smaller file from a file, without training: fewer coupled primitives, coarser covariances, a part of the anchors.

All work on what the file holds and leave alone what other symbols are conditioned on: references and hyperpriors keep
their symbols, so that everything that is kept decodes to what it was. Only where anchors see neighbours, and some of
these go, are there other symbols for the same. Residual embeddings keep their step: most
of their symbols are 0, 1 or -1, and a coarser step either leaves those where they are or loses them all (measured in
docs/results/tried.md).
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from compgs.codec.content import (
    COORDINATES,
    LOG_SCALES,
    FileContent,
    Group,
    Latents,
    Role,
    StepsOf,
    code_group,
    conditional_tables,
    dequantize,
    reordered,
    surroundings,
)
from compgs.codec.integer_network import BIAS_LIMIT, FRACTION_BITS, IntegerNetwork
from compgs.codec.rows import symbols_of_rows
from compgs.codec.tables import SCALES_PER_OCTAVE
from compgs.errors import NotEncodable
from compgs.ordering.order import canonical_order, octree_depth, octree_origin


def without_coupled(content: FileContent, kept: np.ndarray) -> FileContent:
    """The content with only the coupled primitives that are `kept`, [P] bool in the file's order, and their anchors.

    Raises NotEncodable where latents depend on where an anchor is in the octree, and that is another one then.
    """
    mask = content.mask.copy()
    mask[mask] = kept
    sees_neighbours = any(group.shape.sees_neighbours for group in content.groups)
    return _with_mask(content, mask, dequantize(content) if sees_neighbours else None)


def divided(content: FileContent, latents: Latents, part_of: np.ndarray) -> Iterator[FileContent]:
    """The parts of a content, in the order of their numbers: each has the anchors that are given its number, but for
    those without a coupled primitive. Every part has to have one.

    `latents`: those of the content; part_of: [N] int, of its anchors; what is negative goes into no part.
    Raises NotEncodable as `without_coupled`.
    """
    for number in np.unique(part_of[part_of >= 0]):
        yield _with_mask(content, content.mask & (part_of == number)[:, None], latents)


def _with_mask(content: FileContent, mask: np.ndarray, latents: Sequence[np.ndarray] | None) -> FileContent:
    """The content with the coupled primitives of the mask [N, K], and the anchors that have any.

    `latents`: `dequantize` of the content, where a group sees neighbours.
    """
    anchors = mask.any(1)

    def narrowed(group: Group) -> Group:
        symbols = group.symbols
        if group.shape.role == Role.RESIDUAL:
            symbols = symbols * mask[:, :, None]
        return replace(group, symbols=symbols[anchors])

    smaller = replace(
        content,
        coordinates=content.coordinates[anchors],
        mask=mask[anchors],
        groups=tuple(map(narrowed, content.groups)),
        levels=None,  # the octree may be another one
    )
    if any(map(_depends_on_place, content.groups)) and not _same_octree(content, smaller):
        raise NotEncodable(
            "latents depend on where an anchor is in the whole scene, so no part of it can stand alone; "
            "keep the file, or train again"
        )
    if latents is None:
        return smaller
    order = canonical_order(smaller.coordinates)
    own = [
        x if group.shape.role == Role.RESIDUAL else x[anchors][order]
        for group, x in zip(content.groups, latents, strict=True)
    ]
    return with_latents(reordered(smaller, order), own)


def _depends_on_place(group: Group) -> bool:
    """Whether a group's means or scales follow the coordinates in the octree. Files of this program with one mean a
    channel have a network that takes the coordinates, with weights of zero.
    """
    if not group.shape.sees_coordinates or not isinstance(group.prior, IntegerNetwork):
        return False
    return bool(group.prior.layers[0].weight[:, :COORDINATES].any())


def _same_octree(one: FileContent, other: FileContent) -> bool:
    if len(other.coordinates) == 0:
        return True
    origin, its = octree_origin(one.coordinates), octree_origin(other.coordinates)
    depths = octree_depth(one.coordinates - origin), octree_depth(other.coordinates - its)
    return bool((origin == its).all()) and depths[0] == depths[1]


def with_latents(content: FileContent, latents: Sequence[np.ndarray]) -> FileContent:
    """The content, in canonical order, with the symbols that have these latents (Q12; of RESIDUAL groups any) though
    other neighbours are there. They exist: latents lie whole steps from what neighbours cannot change.
    """
    known = surroundings(content.coordinates, content.levels)
    groups = list(content.groups)
    for i, group in enumerate(groups):
        if group.shape.sees_neighbours:
            before, steps_of = latents[:i], _steps_of(latents[i])
            coded = code_group(group.shape, group.prior, before, known, content.mask, steps_of)
            groups[i] = replace(group, symbols=coded.symbols)
    return replace(content, groups=tuple(groups))


def _steps_of(latents: np.ndarray) -> StepsOf:
    def steps_of(rows: slice, means: np.ndarray | None, _: np.ndarray) -> np.ndarray:
        assert means is not None
        return (latents[rows] - means) >> FRACTION_BITS

    return steps_of


def with_coarser_covariances(content: FileContent, ratio: float) -> FileContent:
    """Log scales in steps that are `ratio` times as large.

    Raises NotEncodable if other latents are conditioned on them.
    In the new unit, means are the old ones over the ratio, and scales, counted in twelfths of an octave, are lower by
    12 log2(ratio): both go into the network's last layer. Symbols are rounded again, from the values that the file had.
    """
    index = next(i for i, g in enumerate(content.groups) if g.shape.role == Role.LOG_SCALES)
    group = content.groups[index]
    taken = group.shape.sees_neighbours or any(index in other.shape.context for other in content.groups)
    if taken or group.shape.channels < LOG_SCALES or not isinstance(group.prior, IntegerNetwork):
        raise NotEncodable("log scales: other latents depend on them; coarser ones need another training")
    steps = tuple(float(np.float32(step * ratio)) for step in group.shape.steps)
    ratios = np.broadcast_to(np.array(steps) / np.array(group.shape.steps), LOG_SCALES)
    latents = dequantize(content)
    network = rescaled(group.prior, ratios)
    shape = replace(group.shape, steps=steps)
    coded = replace(group, shape=shape, prior=network)
    places = surroundings(content.coordinates).places
    means, _, _ = conditional_tables(shape, network, latents, places, content.mask)
    steps = np.rint((latents[index] / ratios - means) / (1 << FRACTION_BITS)).astype(np.int32)
    groups = list(content.groups)
    groups[index] = replace(coded, symbols=symbols_of_rows(network.rows, steps))
    return replace(content, groups=tuple(groups))


def rescaled(network: IntegerNetwork, ratios: np.ndarray) -> IntegerNetwork:
    """The network for symbols in units that are `ratios` [C] times as large."""
    *first, last = network.layers
    channels = len(last.bias) // 2
    weight, bias = last.weight.astype(np.float64), last.bias.astype(np.float64)
    weight[:channels] /= ratios[:, None]
    bias[:channels] /= ratios
    bias[channels:] -= SCALES_PER_OCTAVE * np.log2(ratios) * (1 << FRACTION_BITS)
    bias = bias.clip(1 - BIAS_LIMIT, BIAS_LIMIT - 1)
    layer = replace(last, weight=np.rint(weight).astype(np.int32), bias=np.rint(bias).astype(np.int64))
    return replace(network, layers=(*first, layer))
