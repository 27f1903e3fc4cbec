"""The latents of a range of octree levels, group after group: a pair of encode and decode.

A file has one section of these for each range, coarse to fine, so that its beginning is a coarse scene. Nothing in a
range depends on a later one but, with contexts that see coordinates, on the positions of all anchors.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from compgs.codec.content import (
    CodedGroup,
    Dimensions,
    Role,
    conditional_tables,
    fixed_point,
    reconstruct,
)
from compgs.codec.fields import FieldReader, varint
from compgs.codec.format import LATENTS, MAX_ANCHORS, MAX_COUPLED_PRIMITIVES, MAX_SYMBOL, SECTION_NAMES
from compgs.codec.integer_network import IntegerNetwork
from compgs.codec.rans import encode_symbols, read_symbols, skip_symbols
from compgs.codec.rows import NOTHING, Rows, steps_of_rows
from compgs.codec.tables import HyperTable
from compgs.errors import CorruptSection
from compgs.ordering.order import MAXIMUM_DEPTH

Prior = IntegerNetwork | tuple[HyperTable, ...]


@dataclass(frozen=True)
class RangeHead:
    """What a range's section begins with."""

    level: int  # of the octree: the last one of the range
    anchors: int  # of the range
    coupled: int  # coupled primitives of these that exist


def encode_range(
    level: int,
    mask: np.ndarray,  # [n, K] bool, of the range's anchors
    chain: Iterable[CodedGroup],  # of these: `content.walk`
) -> bytes:
    """The section of n anchors."""
    parts = [bytes([level]), varint(len(mask)), varint(int(mask.sum()))]
    parts += [
        encode_symbols(coded.symbols.ravel(), coded.table_index.ravel(), coded.tables, coded.rows)
        for coded in chain
    ]
    return b"".join(parts)


def read_head(reader: FieldReader) -> RangeHead:
    level = reader.varint("level", 0, MAXIMUM_DEPTH)
    anchors = reader.varint("anchors", 1, MAX_ANCHORS)
    return RangeHead(level, anchors, reader.varint("coupled", 0, anchors * MAX_COUPLED_PRIMITIVES))


def decode_range(
    reader: FieldReader,  # behind the head
    dimensions: Dimensions,
    priors: Sequence[Prior],
    mask: np.ndarray,  # [n, K] bool
    places: np.ndarray,  # [n, 3]
    around: Callable[[int, IntegerNetwork], np.ndarray],  # [n, 2 + channels] of a group that sees neighbours
) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Symbols (int32) and latents (int32, Q12) of each group, [n, channels] or with RESIDUAL [p, channels]."""
    latents: list[np.ndarray] = []
    all_symbols: list[np.ndarray] = []
    for i, (shape, prior) in enumerate(zip(dimensions.groups, priors, strict=True)):
        said = around(i, prior) if shape.sees_neighbours and isinstance(prior, IntegerNetwork) else None
        means, index, tables = conditional_tables(shape, prior, latents, places, mask, said)
        context = prior.rows if isinstance(prior, IntegerNetwork) else NOTHING
        rows = Rows(shape.channels, context.inertia)
        symbols = read_symbols(reader, index.ravel(), tables, rows).reshape(index.shape)
        _check_size(reader.section, "a symbol", symbols)
        steps = steps_of_rows(context, symbols)
        if context.chain is not None:
            _check_size(reader.section, "a step", steps)
        latents.append(fixed_point(steps) if means is None else reconstruct(steps, means))
        all_symbols.append(symbols)
    reader.end()
    return all_symbols, latents


def _check_size(section: str, kind: str, values: np.ndarray) -> None:
    if values.size and (values.min() < -MAX_SYMBOL or values.max() > MAX_SYMBOL):
        raise CorruptSection(f"{section}: {kind} is not in -{MAX_SYMBOL} to {MAX_SYMBOL}")


def stream_sizes(data: bytes, dimensions: Dimensions) -> tuple[RangeHead, list[int]]:
    """Bytes of each group in a range's section; nothing is decoded."""
    reader = FieldReader(data, SECTION_NAMES[LATENTS])
    head = read_head(reader)
    sizes = []
    for shape in dimensions.groups:
        rows = head.coupled if shape.role == Role.RESIDUAL else head.anchors
        sizes.append(skip_symbols(reader, rows * shape.channels))
    reader.end()
    return head, sizes
