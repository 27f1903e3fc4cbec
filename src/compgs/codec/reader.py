"""Bytes become integers: the mirror image of writer.py, section by section. Nothing is taken on trust."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np

from compgs.codec.content import (
    Dimensions,
    FileContent,
    Group,
    Latents,
    Role,
    Surroundings,
    scatter_existing,
    surroundings,
)
from compgs.codec.fields import FieldReader
from compgs.codec.format import (
    FIRST_WITH_ROWS,
    HEADS,
    LATENTS,
    MASKS,
    METADATA,
    NETWORKS,
    PADDING,
    POSITIONS,
    POSITIONS_GPCC,
    SCENE,
    SECTION_NAMES,
    TABLES,
    VIEWPOINTS,
    Section,
    container_bytes,
    section_ends,
    unpack,
    version_of,
)
from compgs.codec.integer_network import IntegerNetwork
from compgs.codec.latents import Prior, RangeHead, decode_range, read_head, stream_sizes
from compgs.codec.limits import (
    FLAGS,
    HEAD_PRODUCTS,
    NETWORK_PRODUCTS,
    NODES,
    SYMBOLS,
    check_amount,
    most,
    symbols,
)
from compgs.codec.mask_coder import decode_masks
from compgs.codec.octree import decode_positions
from compgs.codec.sections import SceneSection, decode_metadata, decode_scene, decode_tables
from compgs.codec.tmc3 import decode_positions_tmc3
from compgs.codec.viewpoints import Viewpoints, decode_viewpoints
from compgs.codec.weights import QuantizedTensor, decode_heads, decode_known_heads, decode_networks
from compgs.errors import CorruptSection
from compgs.numerics.threads import THREADS
from compgs.ordering.order import level_counts, represented


@dataclass(frozen=True)
class SectionInfo:
    """What a section, or a group of latents in all ranges, costs."""

    name: str
    bytes: int
    bits_per_anchor: float
    bits_per_coupled: float  # per coupled primitive that exists


@dataclass(frozen=True)
class RangeInfo:
    """A prefix of the file that is a scene, and where it ends."""

    level: int  # of the octree
    anchors: int  # up to this level
    bytes: int  # of the file up to here
    coupled: int  # coupled primitives up to this level


@dataclass(frozen=True)
class FileInfo:
    """What can be said about a file without decoding it. The sections' bytes, "container" included, sum to
    `bytes`.
    """

    version: int
    bytes: int
    anchors: int
    coupled: int  # coupled primitives that exist
    dimensions: Dimensions
    scene: SceneSection
    sections: tuple[SectionInfo, ...]
    ranges: tuple[RangeInfo, ...]
    metadata: dict[str, str]

    @property
    def bits_per_anchor(self) -> float:
        return 8.0 * self.bytes / self.anchors


def group_names(dimensions: Dimensions) -> list[str]:
    """What people call the groups; a side group is named after the next one that takes it. No two share a name: of
    several of a kind all but the first have their number.
    """
    names = {
        Role.REFERENCE: "reference embeddings",
        Role.LOG_SCALES: "log scales",
        Role.RESIDUAL: "residual embeddings",
    }
    result = []
    for i, shape in enumerate(dimensions.groups):
        if shape.role != Role.SIDE:
            result.append(names[shape.role])
            continue
        users = [g.role for g in dimensions.groups if i in g.context]
        kind = {Role.REFERENCE: "reference ", Role.RESIDUAL: "residual "}.get(
            users[0] if users else shape.role, ""
        )
        result.append(f"{kind}hyperprior")
    counted = [(name, result[: i + 1].count(name)) for i, name in enumerate(result)]
    return [name if count == 1 else f"{name} {count}" for name, count in counted]


def read_content(data: bytes) -> FileContent:
    """The content of a .cgs file, anchors in canonical order.

    Raises NotACompGSFile, UnsupportedVersion, TruncatedSection or CorruptSection; the message names the
    section.
    """
    return read_latents(data)[0]


def read_latents(
    data: bytes, *, keep_symbols: bool = True, prefix: bool = False
) -> tuple[FileContent, Latents]:
    """The content, and its latents, which the entropy decoder needs anyway (`dequantize` would compute them again).

    `prefix`: the file may end early; of the anchors, those whose ranges are there. Not `keep_symbols`: symbols are
    empty in the content; with all of them the peak of memory would be above three times the size of the model.
    """
    sections = unpack(data, prefix=prefix)
    by_number = {section.number: section.data for section in sections}
    version = version_of(data)
    scene = decode_scene(by_number[SCENE], SECTION_NAMES[SCENE], version)
    d = scene.dimensions
    ranges = [section for section in sections if section.number == LATENTS]
    heads_of_ranges = [read_head(FieldReader(r.data, r.name)) for r in ranges]
    anchors = sum(head.anchors for head in heads_of_ranges) if prefix else scene.anchors
    check_amount(SYMBOLS, symbols(d, anchors), len(data), SECTION_NAMES[SCENE])
    check_amount(FLAGS, scene.anchors * d.coupled_primitives, len(data), SECTION_NAMES[SCENE])
    if any(by_number.get(PADDING, b"")):
        raise CorruptSection(f"{SECTION_NAMES[PADDING]}: expected zero bytes")
    metadata = decode_metadata(by_number[METADATA], SECTION_NAMES[METADATA]) if METADATA in by_number else {}
    coupled = sum(head.coupled for head in heads_of_ranges) if prefix else scene.coupled
    read_positions = partial(_positions, by_number, scene.anchors, most(NODES, len(data)))
    read_others = partial(_others, by_number, scene, version, anchors, coupled, len(data))
    if prefix:  # only the positions prove that there are so many anchors
        coordinates, others = read_positions(), read_others()
    else:
        coordinates, others = THREADS.both(read_positions, read_others)
    mask, priors = others.mask, others.priors
    if int(mask.sum()) != scene.coupled:
        raise CorruptSection(
            f"masks: {int(mask.sum())} coupled primitives exist, the scene section promises {scene.coupled}"
        )
    complete = len(ranges) == sum(number == LATENTS for number, _ in section_ends(data))
    counts = level_counts(coordinates)
    _check_ranges(heads_of_ranges, counts, mask, whole=complete)
    known = surroundings(coordinates, [head.level for head in heads_of_ranges], counts)
    whole = anchors == scene.anchors
    stands_for = None if whole else represented(coordinates, heads_of_ranges[-1].level)
    coordinates, mask = coordinates[:anchors], mask[:anchors]
    all_symbols, latents = _decode_ranges(ranges, heads_of_ranges, d, priors, mask, known, keep_symbols)
    content = FileContent(
        coupled_primitives=d.coupled_primitives,
        residual_dim=d.residual_dim,
        heads_layout=d.heads,
        width=d.width,
        voxel_size=scene.voxel_size,
        world_offset=scene.world_offset,
        view_distance_scale=scene.view_distance_scale,
        background=scene.background,
        angular_dilation=scene.angular_dilation,
        coordinates=coordinates,
        mask=mask,
        groups=tuple(map(Group, d.groups, priors, all_symbols)),
        heads=others.heads,
        viewpoints=others.viewpoints,
        levels=known.levels if whole else None,
        stands_for=stands_for,
        metadata=metadata,
    )
    return content, latents


class _Others(NamedTuple):
    """What a decoder may read while it reads the positions."""

    viewpoints: Viewpoints | None
    priors: list[Prior]
    heads: tuple[tuple[str, QuantizedTensor], ...]
    mask: np.ndarray  # [N, K] bool


def _others(
    sections: dict[int, bytes],
    scene: SceneSection,
    version: int,
    anchors: int,  # that have arrived
    coupled: int,  # coupled primitives of these
    file_bytes: int,
) -> _Others:
    d = scene.dimensions
    viewpoints = None
    if VIEWPOINTS in sections:
        viewpoints = decode_viewpoints(sections[VIEWPOINTS], SECTION_NAMES[VIEWPOINTS])
    tables = decode_tables(sections[TABLES], SECTION_NAMES[TABLES], d.table_count)

    def check_products(limit: tuple[str, int, int], rows: int, number: int, weights: int) -> None:
        check_amount(limit, rows * weights, file_bytes, SECTION_NAMES[number])

    networks = decode_networks(
        sections[NETWORKS],
        SECTION_NAMES[NETWORKS],
        d.network_sizes,
        partial(check_products, NETWORK_PRODUCTS, anchors, NETWORKS),
        d.networks_that_follow,
        d.channels_of_networks,
        version,
    )
    check_heads = partial(check_products, HEAD_PRODUCTS, coupled, HEADS)
    if version >= FIRST_WITH_ROWS:
        heads = decode_known_heads(sections[HEADS], SECTION_NAMES[HEADS], d.head_shapes, check_heads)
    else:
        heads = decode_heads(sections[HEADS], SECTION_NAMES[HEADS], check_heads)
    mask = decode_masks(sections[MASKS], scene.anchors, d.coupled_primitives)
    return _Others(viewpoints, _priors(d, iter(networks), iter(tables)), heads, mask)


def _positions(sections: dict[int, bytes], anchors: int, most_nodes: int) -> np.ndarray:  # [N, 3] int32
    if POSITIONS in sections:
        return decode_positions(sections[POSITIONS], anchors, most_nodes)
    return decode_positions_tmc3(sections[POSITIONS_GPCC], anchors)


def _priors(d: Dimensions, networks: Iterator, tables: Iterator) -> list[Prior]:
    """What each group is coded with, from the networks and tables of the file."""
    return [
        next(networks)
        if shape.has_network
        else tuple(next(tables) for _ in range(shape.width(d.coupled_primitives)))
        for shape in d.groups
    ]


def _check_ranges(heads: list[RangeHead], counts: np.ndarray, mask: np.ndarray, *, whole: bool) -> None:
    """The ranges must be those of the octree's levels, and all of them where the file has arrived `whole`."""
    place, first = SECTION_NAMES[LATENTS], 0
    levels = [head.level for head in heads]
    if levels != sorted(set(levels)) or levels[-1] >= len(counts):
        raise CorruptSection(f"{place}: levels are {levels}, expected ascending ones up to {len(counts) - 1}")
    if whole and levels[-1] != len(counts) - 1:
        raise CorruptSection(f"{place}: the last level is {levels[-1]}, expected {len(counts) - 1}")
    for head in heads:
        end = int(counts[head.level])
        coupled = int(mask[first:end].sum())
        if (head.anchors, head.coupled) != (end - first, coupled):
            raise CorruptSection(
                f"{place}: up to level {head.level} {head.anchors} anchors with {head.coupled} coupled primitives, "
                f"expected {end - first} with {coupled}"
            )
        first = end


def _decode_ranges(
    ranges: list[Section],
    heads: list[RangeHead],
    d: Dimensions,
    priors: list[Prior],
    mask: np.ndarray,
    known: Surroundings,
    keep_symbols: bool,
) -> tuple[list[np.ndarray], Latents]:
    """Symbols of each group as `Group` has them (empty if they are not kept), and latents."""
    coupled = sum(head.coupled for head in heads)
    rows = [coupled if shape.role == Role.RESIDUAL else len(mask) for shape in d.groups]
    latents = tuple(np.empty((n, g.channels), np.int32) for n, g in zip(rows, d.groups, strict=True))
    kept = [
        np.empty((n if keep_symbols else 0, g.channels), np.int32)
        for n, g in zip(rows, d.groups, strict=True)
    ]
    anchor = primitive = 0
    for number, (section, head) in enumerate(zip(ranges, heads, strict=True)):
        reader = FieldReader(section.data, section.name)
        read_head(reader)
        part = known.rows(number)

        def around(
            group: int, network: IntegerNetwork, number: int = number, end: int = anchor
        ) -> np.ndarray:
            return known.around(number, network, latents[group][:end])

        parts = decode_range(reader, d, priors, mask[part], known.places[part], around)
        for i, shape in enumerate(d.groups):
            to = slice(primitive, primitive + head.coupled) if shape.role == Role.RESIDUAL else part
            latents[i][to] = parts[1][i]
            if keep_symbols:
                kept[i][to] = parts[0][i]
        anchor, primitive = anchor + head.anchors, primitive + head.coupled
    symbols_of = [
        scatter_existing(kept[i], mask) if keep_symbols and shape.role == Role.RESIDUAL else kept[i]
        for i, shape in enumerate(d.groups)
    ]
    return symbols_of, latents


def file_info(data: bytes) -> FileInfo:
    """Bytes and bits by section and group; verifies the checksums, decodes the scene section and the ranges' heads."""
    sections = unpack(data)
    by_number = {section.number: section.data for section in sections}
    scene = decode_scene(by_number[SCENE], SECTION_NAMES[SCENE], version_of(data))
    check_amount(SYMBOLS, symbols(scene.dimensions, scene.anchors), len(data), SECTION_NAMES[SCENE])
    flags = scene.anchors * scene.dimensions.coupled_primitives
    check_amount(FLAGS, flags, len(data), SECTION_NAMES[SCENE])
    metadata = decode_metadata(by_number[METADATA], SECTION_NAMES[METADATA]) if METADATA in by_number else {}
    names = group_names(scene.dimensions)
    streams = [0] * len(names)
    sizes: list[tuple[str, int]] = []
    ranges: list[RangeInfo] = []
    at, anchors, coupled, heads = container_bytes(len(sections)), 0, 0, 0
    for section in sections:
        at += len(section.data)
        if section.number != LATENTS:
            sizes.append((section.name, len(section.data)))
            continue
        head, parts = stream_sizes(section.data, scene.dimensions)
        anchors, coupled = anchors + head.anchors, coupled + head.coupled
        heads += len(section.data) - sum(parts)
        streams = [a + b for a, b in zip(streams, parts, strict=True)]
        ranges.append(RangeInfo(head.level, anchors, at, coupled))
    sizes += [*zip(names, streams, strict=True), ("container", container_bytes(len(sections)) + heads)]
    return FileInfo(
        version=version_of(data),
        bytes=len(data),
        anchors=scene.anchors,
        coupled=scene.coupled,
        dimensions=scene.dimensions,
        scene=scene,
        sections=tuple(
            SectionInfo(name, size, 8.0 * size / scene.anchors, 8.0 * size / max(scene.coupled, 1))
            for name, size in sizes
        ),
        ranges=tuple(ranges),
        metadata=metadata,
    )
