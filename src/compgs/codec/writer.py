"""Integers become bytes: the mirror image of reader.py, section by section."""

from dataclasses import replace
from typing import Literal

import numpy as np

from compgs.codec.anchor_order import canonical_order
from compgs.codec.content import (
    COVARIANCE_DIM,
    FileContent,
    channel_index,
    fixed_point,
    gather_existing,
    reconstruct,
    residual_context,
)
from compgs.codec.format import (
    COVARIANCE,
    FREE_SYMBOLS,
    HEADS,
    HYPER_TABLES,
    MASKS,
    MAX_ANCHORS,
    MAX_METADATA_BYTES,
    MAX_SYMBOL,
    METADATA,
    NETWORKS,
    PADDING,
    POSITIONS,
    POSITIONS_GPCC,
    REFERENCE,
    REFERENCE_HYPER,
    RESIDUAL,
    RESIDUAL_HYPER,
    SCENE,
    SYMBOLS_PER_BYTE,
    Section,
    container_bytes,
    pack,
)
from compgs.codec.integer_network import entropy_parameters
from compgs.codec.mask_coder import encode_masks
from compgs.codec.octree import encode_positions
from compgs.codec.rans import encode_symbols
from compgs.codec.sections import (
    DIMENSION_LIMITS,
    encode_hyper_tables,
    encode_metadata,
    encode_scene,
    wrong_number,
)
from compgs.codec.sections import (
    HEADS as HEAD_LAYOUTS,
)
from compgs.codec.tables import (
    LEVELS,
    MAX_HYPER_SYMBOLS,
    MAX_LOWEST,
    HyperTable,
    channel_tables,
    gaussian_tables,
)
from compgs.codec.tmc3 import encode_positions_tmc3
from compgs.codec.weights import NETWORKS as NETWORK_NAMES
from compgs.codec.weights import encode_heads, encode_networks
from compgs.errors import NotEncodable

Geometry = Literal["octree", "tmc3"]


def write_content(content: FileContent, geometry: Geometry = "octree") -> bytes:
    """The bytes of a .cgs file. Anchors may come in any order; the file has them in the canonical one.

    `geometry`: positions by the octree coder, or as in the paper by G-PCC, whose program `tmc3` writer and reader then
    need. Symbols of coupled primitives that do not exist are ignored.

    Raises MissingDependency without that program, NotEncodable if the format cannot represent the content.
    """
    check_content(content)
    content = _reordered(content, canonical_order(content.coordinates))
    gaussian = gaussian_tables()
    anchors = len(content.coordinates)
    networks = content.networks

    def hyper_stream(symbols: np.ndarray, tables: tuple[HyperTable, ...]) -> bytes:
        index = channel_index(anchors, len(tables))
        return encode_symbols(symbols.ravel(), index.ravel(), channel_tables(tables))

    sections = [
        Section(SCENE, encode_scene(content)),
        _positions(content.coordinates, geometry),
        Section(MASKS, encode_masks(content.mask)),
        Section(
            HYPER_TABLES, encode_hyper_tables(content.reference_hyper_tables + content.residual_hyper_tables)
        ),
        Section(NETWORKS, encode_networks(networks)),
        Section(HEADS, encode_heads(content.heads)),
        Section(REFERENCE_HYPER, hyper_stream(content.reference_hyper, content.reference_hyper_tables)),
    ]
    means, index = entropy_parameters(networks["reference"], fixed_point(content.reference_hyper))
    sections.append(Section(REFERENCE, encode_symbols(content.reference.ravel(), index.ravel(), gaussian)))
    reference = reconstruct(content.reference, means)

    _, index = entropy_parameters(networks["covariance"], reference)
    sections.append(Section(COVARIANCE, encode_symbols(content.covariance.ravel(), index.ravel(), gaussian)))

    sections.append(
        Section(RESIDUAL_HYPER, hyper_stream(content.residual_hyper, content.residual_hyper_tables)),
    )
    context = residual_context(content.residual_hyper, reference)
    _, index = entropy_parameters(networks["residual"], context, content.mask)
    symbols = gather_existing(content.residual, content.mask)
    sections.append(Section(RESIDUAL, encode_symbols(symbols.ravel(), index.ravel(), gaussian)))

    if content.metadata:
        sections.append(Section(METADATA, encode_metadata(content.metadata)))
    sections.sort(key=lambda section: section.number)
    padding = _padding(content, sections)
    return pack([*sections, Section(PADDING, bytes(padding))] if padding else sections)


def _positions(coordinates: np.ndarray, geometry: Geometry) -> Section:
    if geometry == "octree":
        return Section(POSITIONS, encode_positions(coordinates))
    return Section(POSITIONS_GPCC, encode_positions_tmc3(coordinates))


def check_content(content: FileContent) -> None:
    """Raises NotEncodable for the first thing that the format cannot represent."""
    d = content.dimensions
    anchors = len(content.coordinates)
    if not 1 <= anchors <= MAX_ANCHORS:
        raise NotEncodable(f"{anchors} anchors, expected 1 to {MAX_ANCHORS}")
    for name, limit in DIMENSION_LIMITS.items():
        if not 1 <= getattr(d, name) <= limit:
            raise NotEncodable(f"{name} is {getattr(d, name)}, expected 1 to {limit}")
    if d.heads not in HEAD_LAYOUTS:
        raise NotEncodable(f"heads are {d.heads!r}, expected one of {HEAD_LAYOUTS}")
    problem = wrong_number(content)
    if problem:
        raise NotEncodable(problem)
    shapes = {
        "coordinates": (anchors, 3),
        "mask": (anchors, d.coupled_primitives),
        "reference_hyper": (anchors, d.reference_hyper_dim),
        "reference": (anchors, d.reference_dim),
        "covariance": (anchors, COVARIANCE_DIM),
        "residual_hyper": (anchors, d.residual_hyper_dim),
        "residual": (anchors, d.coupled_primitives, d.residual_dim),
    }
    for name, shape in shapes.items():
        array = getattr(content, name)
        dtype = np.bool_ if name == "mask" else np.int32
        if array.shape != shape or array.dtype != dtype:
            raise NotEncodable(f"{name} is {array.dtype} {array.shape}, expected {np.dtype(dtype)} {shape}")
        if name in ("coordinates", "mask"):
            continue  # their coders judge them
        if array.min() < -MAX_SYMBOL or array.max() > MAX_SYMBOL:
            raise NotEncodable(
                f"{name}: symbols from {array.min()} to {array.max()}, the format holds -{MAX_SYMBOL} to "
                f"{MAX_SYMBOL}; use a larger quantization step"
            )
    for name, count in (("reference_hyper", d.reference_hyper_dim), ("residual_hyper", d.residual_hyper_dim)):
        _check_hyper_tables(name, getattr(content, f"{name}_tables"), count)
    sizes = d.network_sizes()
    if set(content.networks) != set(NETWORK_NAMES):
        raise NotEncodable(
            f"entropy networks are {sorted(content.networks)}, expected {sorted(NETWORK_NAMES)}"
        )
    for name, network in content.networks.items():
        if (network.inputs, network.outputs) != sizes[name]:
            raise NotEncodable(
                f"{name} network: {network.inputs} inputs, {network.outputs} outputs, expected {sizes[name]}"
            )
    size = len(encode_metadata(content.metadata))
    if size > MAX_METADATA_BYTES:
        raise NotEncodable(f"metadata takes {size} bytes, the format holds at most {MAX_METADATA_BYTES}")


def _check_hyper_tables(name: str, tables: tuple[HyperTable, ...], count: int) -> None:
    if len(tables) != count:
        raise NotEncodable(f"{name}: {len(tables)} tables, expected one for each of {count} channels")
    for i, table in enumerate(tables):
        if not 2 <= len(table.levels) <= MAX_HYPER_SYMBOLS + 1 or abs(table.lowest) > MAX_LOWEST:
            raise NotEncodable(
                f"{name}: table {i} has {len(table.levels)} levels from symbol {table.lowest} on, "
                f"expected 2 to {MAX_HYPER_SYMBOLS + 1}"
            )
        if table.levels.min() < 0 or table.levels.max() >= LEVELS:
            raise NotEncodable(f"{name}: table {i} has a level outside 0 to {LEVELS - 1}")


def _reordered(content: FileContent, order: np.ndarray) -> FileContent:
    if (order[1:] > order[:-1]).all():
        return content
    rows = ("coordinates", "mask", "reference_hyper", "reference", "covariance", "residual_hyper", "residual")
    return replace(content, **{name: getattr(content, name)[order] for name in rows})


def _padding(content: FileContent, sections: list[Section]) -> int:
    """Zero bytes to add to a file that says more symbols than its size allows."""
    symbols = len(content.coordinates) * content.dimensions.symbols_per_anchor()
    needed = -(-max(0, symbols - FREE_SYMBOLS) // SYMBOLS_PER_BYTE)
    size = container_bytes(len(sections)) + sum(len(section.data) for section in sections)
    return max(0, needed - size)
