"""Integers become bytes: the mirror image of reader.py, section by section."""

from collections.abc import Iterator, Sequence
from typing import Literal

import numpy as np

from compgs.codec.content import (
    CodedGroup,
    FileContent,
    Group,
    Role,
    Surroundings,
    reordered,
    surroundings,
    walk,
)
from compgs.codec.fields import FieldReader
from compgs.codec.format import (
    FIRST_WITH_ROWS,
    HEADS,
    LATENTS,
    MASKS,
    MAX_ANCHORS,
    MAX_METADATA_BYTES,
    MAX_RANGES,
    MAX_SYMBOL,
    METADATA,
    NETWORKS,
    PADDING,
    POSITIONS,
    POSITIONS_GPCC,
    SCENE,
    TABLES,
    VIEWPOINTS,
    Section,
    container_bytes,
    pack,
)
from compgs.codec.integer_network import IntegerNetwork, first_rows
from compgs.codec.latents import encode_range, read_head
from compgs.codec.limits import least_bytes, least_bytes_of_all
from compgs.codec.mask_coder import encode_masks
from compgs.codec.octree import encode_positions
from compgs.codec.rows import RowContext, chain_length, steps_of_rows
from compgs.codec.sections import (
    HEADS as HEAD_LAYOUTS,
)
from compgs.codec.sections import (
    encode_metadata,
    encode_scene,
    encode_tables,
    version_for,
    wrong_dimension,
    wrong_number,
)
from compgs.codec.tables import LEVELS, MAX_HYPER_SYMBOLS, MAX_LOWEST
from compgs.codec.tmc3 import encode_positions_tmc3
from compgs.codec.viewpoints import encode_viewpoints
from compgs.codec.weights import encode_heads, encode_known_heads, encode_networks
from compgs.errors import NotEncodable
from compgs.ordering.order import canonical_order

Geometry = Literal["octree", "tmc3"]


def write_content(
    content: FileContent,
    geometry: Geometry = "octree",
    levels: list[int] | None = None,
    *,
    coded: Sequence[CodedGroup] | None = None,
) -> bytes:
    """The bytes of a .cgs file. Anchors may come in any order; the file has them in the canonical one.

    `geometry`: positions by the octree coder, or as in the paper by G-PCC, whose program `tmc3` writer and reader then
    need. `levels`: last octree level of each range of latents, ascending, the last one the octree's depth; those of the
    content if not given. Symbols of coupled primitives that do not exist are ignored. `coded`: what a
    `content.walk` along the groups gives, if that is known and the anchors are in canonical order; networks are then
    not evaluated again.

    Raises MissingDependency without that program, NotEncodable if the format cannot represent the content.
    """
    check_content(content)
    ordered = reordered(content, canonical_order(content.coordinates))
    assert coded is None or ordered is content, "coded groups in another order than the file's"
    content = ordered
    known = surroundings(content.coordinates, content.levels if levels is None else levels)
    networks = [g.prior for g in content.groups if isinstance(g.prior, IntegerNetwork)]
    tables = [table for g in content.groups if not isinstance(g.prior, IntegerNetwork) for table in g.prior]
    version = version_for(content)
    sections = [Section(SCENE, encode_scene(content))]
    if content.viewpoints is not None:
        sections.append(Section(VIEWPOINTS, encode_viewpoints(content.viewpoints)))
    sections += [
        _positions(content.coordinates, geometry),
        Section(MASKS, encode_masks(content.mask)),
        Section(TABLES, encode_tables(tables)),
        Section(NETWORKS, encode_networks(networks, version)),
        Section(HEADS, _heads(content, version)),
    ]
    ranges = _ranges(content, known, coded)
    padding = _padding(content, sections, ranges)
    if padding:  # before the ranges, so that the beginnings of the file that are scenes are padded, too
        sections.append(Section(PADDING, bytes(padding)))
    if content.metadata:
        ranges.append(Section(METADATA, encode_metadata(content.metadata)))
    return pack(sections + ranges, version)


def _heads(content: FileContent, version: int) -> bytes:
    """Read the heads by name, or in the order of their names where files have none."""
    if version < FIRST_WITH_ROWS:
        return encode_heads(content.heads)
    stored = dict(content.heads)
    return encode_known_heads([stored[name] for name in content.dimensions.head_shapes])


def _positions(coordinates: np.ndarray, geometry: Geometry) -> Section:
    if geometry == "octree":
        return Section(POSITIONS, encode_positions(coordinates))
    return Section(POSITIONS_GPCC, encode_positions_tmc3(coordinates))


def _ranges(content: FileContent, known: Surroundings, coded: Sequence[CodedGroup] | None) -> list[Section]:
    levels, ends = known.levels, known.ends
    assert levels[-1] == known.depth and list(ends) == sorted(set(ends)) and len(levels) <= MAX_RANGES, levels
    coded = list(walk(content.groups, content.mask, known)) if coded is None else coded
    sections = []
    for number, level in enumerate(levels):
        rows = known.rows(number)
        chain = _of_rows(content, coded, rows)
        sections.append(Section(LATENTS, encode_range(level, content.mask[rows], chain)))
    return sections


def _of_rows(content: FileContent, coded: Sequence[CodedGroup], rows: slice) -> Iterator[CodedGroup]:
    """The same groups of a range of the anchors."""
    first = first_rows(content.mask)
    existing = slice(int(first[rows.start]), int(first[rows.stop]))
    for group, whole in zip(content.groups, coded, strict=True):
        part = existing if group.shape.role == Role.RESIDUAL else rows
        yield whole.part(part)


def check_content(content: FileContent) -> None:
    """Raises NotEncodable for the first thing that the format cannot represent."""
    d = content.dimensions
    anchors = len(content.coordinates)
    if not 1 <= anchors <= MAX_ANCHORS:
        raise NotEncodable(f"{anchors} anchors, expected 1 to {MAX_ANCHORS}")
    if d.heads not in HEAD_LAYOUTS:
        raise NotEncodable(f"heads are {d.heads!r}, expected one of {HEAD_LAYOUTS}")
    problem = wrong_dimension(d) or wrong_number(content)
    if problem:
        raise NotEncodable(problem)
    _check_array("coordinates", content.coordinates, (anchors, 3), np.int32)
    _check_array("mask", content.mask, (anchors, d.coupled_primitives), np.bool_)
    for i, group in enumerate(content.groups):
        _check_group(i, group, content)
    if version_for(content) >= FIRST_WITH_ROWS:
        _check_heads(content)
    size = len(encode_metadata(content.metadata))
    if size > MAX_METADATA_BYTES:
        raise NotEncodable(f"metadata takes {size} bytes, the format holds at most {MAX_METADATA_BYTES}")


def _check_heads(content: FileContent) -> None:
    """Files without names hold exactly the tensors that their scene asks for."""
    found = {name: tensor.values.shape for name, tensor in content.heads}
    expected = content.dimensions.head_shapes
    if found != expected or len(found) < len(content.heads):
        wrong = sorted(name for name in found.keys() | expected if found.get(name) != expected.get(name))
        raise NotEncodable(f"prediction heads: expected {expected}, found others at {wrong}")


def _check_array(name: str, array: np.ndarray, shape: tuple[int, ...], dtype: type) -> None:
    if array.shape != shape or array.dtype != dtype:
        raise NotEncodable(f"{name}: {array.dtype} {array.shape}, expected {np.dtype(dtype)} {shape}")


def _check_group(index: int, group: Group, content: FileContent) -> None:
    shape, d, anchors = group.shape, content.dimensions, len(content.coordinates)
    name = f"group {index}, {shape.role.name.lower().replace('_', ' ')}"
    own = (d.coupled_primitives, shape.channels) if shape.role == Role.RESIDUAL else (shape.channels,)
    symbols = group.symbols
    _check_array(name, symbols, (anchors, *own), np.int32)
    if symbols.min() < -MAX_SYMBOL or symbols.max() > MAX_SYMBOL:
        raise NotEncodable(
            f"{name}: symbols from {symbols.min()} to {symbols.max()}, the format holds -{MAX_SYMBOL} to "
            f"{MAX_SYMBOL}; use a larger quantization step"
        )
    if isinstance(group.prior, IntegerNetwork) != shape.has_network:
        raise NotEncodable(f"{name}: expected a network where there is context, else tables")
    if isinstance(group.prior, IntegerNetwork):
        if (group.prior.follow is not None) != shape.sees_neighbours:
            raise NotEncodable(
                f"{name}: expected a network that follows neighbours where the group sees them"
            )
        _check_rows(name, group.prior.rows, symbols, version_for(content))
        found = group.prior.inputs, group.prior.outputs
        if found != d.network_size(shape):
            raise NotEncodable(
                f"{name}: its network has {found[0]} inputs and {found[1]} outputs, expected {d.network_size(shape)}"
            )
        return
    count = shape.width(d.coupled_primitives)
    if len(group.prior) != count:
        raise NotEncodable(f"{name}: {len(group.prior)} tables, expected one for each of {count} channels")
    for i, table in enumerate(group.prior):
        if not 2 <= len(table.levels) <= MAX_HYPER_SYMBOLS + 1 or abs(table.lowest) > MAX_LOWEST:
            raise NotEncodable(
                f"{name}: table {i} has {len(table.levels)} levels from symbol {table.lowest} on, "
                f"expected 2 to {MAX_HYPER_SYMBOLS + 1}"
            )
        if table.levels.min() < 0 or table.levels.max() >= LEVELS:
            raise NotEncodable(f"{name}: table {i} has a level outside 0 to {LEVELS - 1}")


def _check_rows(name: str, rows: RowContext, symbols: np.ndarray, version: int) -> None:
    channels = symbols.shape[-1]
    if rows.chain is None and rows.inertia == 0:
        return
    if version < FIRST_WITH_ROWS:
        raise NotEncodable(
            f"{name}: a chain or inertia, which scenes without an angular dilation cannot have"
        )
    if rows.chain is not None and (channels == 1 or rows.chain.shape != (chain_length(channels),)):
        raise NotEncodable(
            f"{name}: a chain of {rows.chain.shape} elements for {channels} channels, "
            f"expected {chain_length(channels)}, and several channels"
        )
    steps = steps_of_rows(rows, symbols.reshape(-1, channels))
    if steps.min() < -MAX_SYMBOL or steps.max() > MAX_SYMBOL:
        raise NotEncodable(
            f"{name}: with its chain steps from {steps.min()} to {steps.max()}, the format holds -{MAX_SYMBOL} to "
            f"{MAX_SYMBOL}; use a larger quantization step"
        )


def _padding(content: FileContent, before: list[Section], ranges: list[Section]) -> int:
    """Number of zero bytes to add before the ranges, so that the file, and its beginning up to the end of each range,
    is long enough for its content (`codec/limits.py`).
    """
    size = container_bytes(len(before) + len(ranges)) + sum(len(section.data) for section in before)
    padding = max(0, least_bytes_of_all(content) - size - len(ranges[0].data))
    anchors = 0
    for section in ranges:
        size += len(section.data)
        anchors += read_head(FieldReader(section.data, section.name)).anchors
        padding = max(padding, least_bytes(content, anchors) - size)
    return padding
