"""The small sections: scene, tables, metadata; each as a pair of encode and decode."""

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import starmap

import numpy as np

from compgs.codec.content import LOG_SCALES, Dimensions, FileContent, GroupShape, Role
from compgs.codec.fields import FieldReader, signed_varint, varint
from compgs.codec.format import (
    FIRST_WITH_DILATION,
    FIRST_WITH_NEIGHBOURS,
    FIRST_WITH_ROWS,
    LARGEST_DILATION,
    MAX_ANCHORS,
    MAX_COUPLED_PRIMITIVES,
    MAX_GROUPS,
    MAX_METADATA_BYTES,
    MAX_REFERENCE_DIM,
    MAX_RESIDUAL_DIM,
    MAX_SIDE_DIM,
    MAX_WIDTH,
    OLDEST_VERSION,
    SMALLEST_DILATION,
)
from compgs.codec.tables import LEVELS, MAX_HYPER_SYMBOLS, MAX_LOWEST, MAX_TABLES, HyperTable
from compgs.codec.weights import decode_arrays, encode_arrays
from compgs.errors import CorruptSection
from compgs.model.head_weights import Layout

HEADS: tuple[Layout, ...] = ("separate", "paired", "shallow")  # their numbers in the file
# anchors, coupled primitives that exist | K, residual_dim, heads, width | voxel_size, world_offset,
# view_distance_scale | background
SCENE_LAYOUT = "<II BBBH ddddd fff"
DILATION_LAYOUT = "<f"  # behind it, from FIRST_WITH_DILATION on

# Of the floating-point numbers: none may be zero, subnormal or infinite as a 32-bit number, nor its product
# with a latent.
SMALLEST, LARGEST = 2.0**-64, 2.0**64
SEES_COORDINATES = 1  # bit of a group's context; bit i + 1 is group i, of itself what neighbours have

CHANNEL_LIMITS = {
    Role.SIDE: MAX_SIDE_DIM,
    Role.REFERENCE: MAX_REFERENCE_DIM,
    Role.LOG_SCALES: LOG_SCALES,
    Role.RESIDUAL: MAX_RESIDUAL_DIM,
}


@dataclass(frozen=True)
class SceneSection:
    """The numbers of `FileContent`, and how much of everything there is."""

    anchors: int
    coupled: int  # coupled primitives that exist
    dimensions: Dimensions
    voxel_size: float
    world_offset: tuple[float, float, float]
    view_distance_scale: float
    background: tuple[float, float, float]
    angular_dilation: float | None


def encode_scene(content: FileContent) -> bytes:
    d = content.dimensions
    fields = struct.pack(
        SCENE_LAYOUT,
        len(content.coordinates),
        int(content.mask.sum()),
        d.coupled_primitives,
        d.residual_dim,
        HEADS.index(d.heads),
        d.width,
        content.voxel_size,
        *content.world_offset,
        content.view_distance_scale,
        *content.background,
    )
    if content.angular_dilation is not None:
        fields += struct.pack(DILATION_LAYOUT, content.angular_dilation)
    return fields + bytes([len(d.groups)]) + b"".join(starmap(_encode_group, enumerate(d.groups)))


def version_for(content: FileContent) -> int:
    """Choose the version of the format for what a file holds: the newest, but for scenes of files that had no angular
    dilation.
    """
    if content.angular_dilation is not None:
        return FIRST_WITH_ROWS
    sees_neighbours = any(group.shape.sees_neighbours for group in content.groups)
    return FIRST_WITH_NEIGHBOURS if sees_neighbours else OLDEST_VERSION


def _encode_group(index: int, shape: GroupShape) -> bytes:
    taken = (*shape.context, index) if shape.sees_neighbours else shape.context
    context = SEES_COORDINATES * shape.sees_coordinates + sum(2 << i for i in taken)
    steps = struct.pack(f"<{len(shape.steps)}f", *shape.steps)
    return bytes([shape.role]) + varint(shape.channels) + varint(context) + varint(len(shape.steps)) + steps


def decode_scene(data: bytes, section: str, version: int) -> SceneSection:
    reader = FieldReader(data, section)
    anchors, coupled, k, residual_dim, heads, width, *numbers = reader.struct(SCENE_LAYOUT, "fields")
    if not 1 <= anchors <= MAX_ANCHORS:
        raise CorruptSection(f"{section}: {anchors} anchors, expected 1 to {MAX_ANCHORS}")
    if coupled > anchors * k:
        raise CorruptSection(f"{section}: {coupled} coupled primitives, expected at most {k} for each anchor")
    if heads >= len(HEADS):
        raise CorruptSection(f"{section}: heads are {heads}, expected 0 to {len(HEADS) - 1}")
    dilation: float | None = None
    if version >= FIRST_WITH_DILATION:
        (dilation,) = reader.struct(DILATION_LAYOUT, "angular_dilation")
    count = reader.varint("groups", 1, MAX_GROUPS)
    groups = tuple(_decode_group(reader, i, version) for i in range(count))
    reader.end()
    d = Dimensions(k, residual_dim, HEADS[heads], width, groups)
    voxel, x, y, z, distance, *background = numbers
    scene = SceneSection(
        anchors,
        coupled,
        d,
        voxel,
        (x, y, z),
        distance,
        (background[0], background[1], background[2]),
        dilation,
    )
    problem = wrong_dimension(d) or wrong_number(scene)
    if problem:
        raise CorruptSection(f"{section}: {problem}")
    return scene


def _decode_group(reader: FieldReader, index: int, version: int) -> GroupShape:
    role = Role(reader.varint(f"role of group {index}", 0, max(Role)))
    channels = reader.varint(f"channels of group {index}", 1, CHANNEL_LIMITS[role])
    most = (4 if version >= FIRST_WITH_NEIGHBOURS else 2) << index
    context = reader.varint(f"context of group {index}", 0, most - 1)
    count = reader.varint(f"steps of group {index}", 0, channels)
    steps = reader.struct(f"<{count}f", f"steps of group {index}")
    inputs = tuple(i for i in range(index) if context >> (i + 1) & 1)
    neighbours = bool(context >> (index + 1) & 1)
    return GroupShape(role, channels, steps, inputs, bool(context & SEES_COORDINATES), neighbours)


def wrong_dimension(d: Dimensions) -> str:
    """What is wrong with sizes and groups; empty if nothing is."""
    limits = {
        "coupled_primitives": MAX_COUPLED_PRIMITIVES,
        "residual_dim": MAX_RESIDUAL_DIM,
        "width": MAX_WIDTH,
    }
    for name, limit in limits.items():
        if not 1 <= getattr(d, name) <= limit:
            return f"{name} is {getattr(d, name)}, expected 1 to {limit}"
    if not 1 <= len(d.groups) <= MAX_GROUPS:
        return f"{len(d.groups)} groups, expected 1 to {MAX_GROUPS}"
    for i, group in enumerate(d.groups):
        if not 1 <= group.channels <= CHANNEL_LIMITS[group.role]:
            return f"group {i} has {group.channels} channels, expected 1 to {CHANNEL_LIMITS[group.role]}"
        if len(group.steps) not in ((0,) if group.role == Role.SIDE else (1, group.channels)):
            return f"group {i} has {len(group.steps)} steps for {group.channels} channels"
        if any(not SMALLEST <= step <= LARGEST for step in group.steps):
            return f"a step of group {i} is not in {SMALLEST:.3g} to {LARGEST:.3g}"
        if any(d.groups[j].role == Role.RESIDUAL for j in group.context):
            return f"group {i} takes latents of coupled primitives, which no other group may"
        if group.sees_neighbours and group.role == Role.RESIDUAL:
            return f"group {i} takes what neighbours have of coupled primitives, which no group may"
        if not group.has_network and group.width(d.coupled_primitives) > MAX_TABLES:
            return f"group {i} has {group.width(d.coupled_primitives)} tables, expected at most {MAX_TABLES}"
    if not 1 <= d.channels(Role.REFERENCE) <= MAX_REFERENCE_DIM:
        return f"the references have {d.channels(Role.REFERENCE)} channels, expected 1 to {MAX_REFERENCE_DIM}"
    if d.channels(Role.LOG_SCALES) != LOG_SCALES:
        return f"the log scales have {d.channels(Role.LOG_SCALES)} channels, expected {LOG_SCALES}"
    if d.channels(Role.RESIDUAL) not in (0, d.residual_dim):
        return f"the residuals have {d.channels(Role.RESIDUAL)} channels, expected none or {d.residual_dim}"
    return ""


def wrong_number(scene: SceneSection | FileContent) -> str:
    """What is wrong with the scene's floating-point numbers; empty if nothing is."""
    for name in ("voxel_size", "view_distance_scale"):
        if not SMALLEST <= getattr(scene, name) <= LARGEST:
            return f"{name} is {getattr(scene, name)}, expected {SMALLEST:.3g} to {LARGEST:.3g}"
    for name in ("background", "world_offset"):
        values = getattr(scene, name)
        if len(values) != 3 or not all(abs(value) <= LARGEST for value in values):
            return f"{name} is {values}, expected three numbers up to {LARGEST:.3g}"
    dilation = scene.angular_dilation
    if dilation is not None and not SMALLEST_DILATION <= dilation <= LARGEST_DILATION:
        return f"angular_dilation is {dilation}, expected {SMALLEST_DILATION:.3g} to {LARGEST_DILATION:.3g}"
    return ""


def encode_tables(tables: Sequence[HyperTable]) -> bytes:
    """Ranges, then levels: a symbol's as the difference from its predecessor's, the escape's as it is."""
    if not tables:
        return b""
    ranges = [varint(len(table.levels)) + signed_varint(table.lowest) for table in tables]
    differences = [
        np.append(np.diff(t.levels[:-1].astype(np.int32), prepend=0), t.levels[-1]) for t in tables
    ]
    return b"".join(ranges) + encode_arrays([np.concatenate(differences)])


def decode_tables(data: bytes, section: str, count: int) -> list[HyperTable]:
    reader = FieldReader(data, section)
    sizes, lowest = [], []
    for i in range(count):
        sizes.append(reader.varint(f"symbols of table {i}", 2, MAX_HYPER_SYMBOLS + 1))
        lowest.append(reader.signed_varint(f"lowest symbol of table {i}", -MAX_LOWEST, MAX_LOWEST))
    if count == 0:
        reader.end()
        return []
    (differences,) = decode_arrays(reader, [(sum(sizes),)])
    tables = []
    at = 0
    for i in range(count):
        part = differences[at : at + sizes[i]].astype(np.int64)
        levels = np.append(np.cumsum(part[:-1]), part[-1])
        if levels.min() < 0 or levels.max() >= LEVELS:
            raise CorruptSection(f"{section}: a level of table {i} is not in 0 to {LEVELS - 1}")
        tables.append(HyperTable(lowest[i], levels.astype(np.uint8)))
        at += sizes[i]
    return tables


def encode_metadata(metadata: dict[str, str]) -> bytes:
    """Number of entries, then keys and values, each with its length, sorted by key."""
    parts = [varint(len(metadata))]
    for key, value in sorted((key.encode(), value.encode()) for key, value in metadata.items()):
        parts += [varint(len(key)), key, varint(len(value)), value]
    return b"".join(parts)


def decode_metadata(data: bytes, section: str) -> dict[str, str]:
    if len(data) > MAX_METADATA_BYTES:
        raise CorruptSection(f"{section}: {len(data)} bytes, expected at most {MAX_METADATA_BYTES}")
    reader = FieldReader(data, section)
    entries = []
    for i in range(reader.varint("entries", 0, MAX_METADATA_BYTES)):
        key = reader.bytes(reader.varint(f"length of key {i}", 0, MAX_METADATA_BYTES), f"key {i}")
        value = reader.bytes(reader.varint(f"length of value {i}", 0, MAX_METADATA_BYTES), f"value {i}")
        entries.append((key, value))
    reader.end()
    keys = [key for key, _ in entries]
    if keys != sorted(set(keys)):
        raise CorruptSection(f"{section}: the keys are not in ascending order, each once")
    try:
        return {key.decode(): value.decode() for key, value in entries}
    except UnicodeDecodeError as error:
        raise CorruptSection(f"{section}: an entry is not UTF-8") from error
