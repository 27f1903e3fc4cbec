"""The small sections: scene, hyperprior tables, metadata; each as a pair of encode and decode."""

import struct
from dataclasses import dataclass
from typing import Literal

import numpy as np

from compgs.codec.content import Dimensions, FileContent
from compgs.codec.fields import FieldReader, signed_varint, varint
from compgs.codec.format import (
    MAX_ANCHORS,
    MAX_COUPLED_PRIMITIVES,
    MAX_HYPER_DIM,
    MAX_METADATA_BYTES,
    MAX_REFERENCE_DIM,
    MAX_RESIDUAL_DIM,
    MAX_WIDTH,
)
from compgs.codec.tables import LEVELS, MAX_HYPER_SYMBOLS, MAX_LOWEST, HyperTable
from compgs.codec.weights import decode_arrays, encode_arrays
from compgs.errors import CorruptSection

HEADS: tuple[Literal["separate", "paired"], ...] = ("separate", "paired")  # their numbers in the file
# anchors, coupled primitives that exist | K, reference_dim, residual_dim, reference_hyper_dim,
# residual_hyper_dim, heads, width | voxel_size, view_distance_scale | background, reference, residual and
# covariance step
SCENE_LAYOUT = "<II BHBBBBH dd 6f"

# Of the floating-point numbers: none may be zero, subnormal or infinite as a 32-bit number, nor its product
# with a latent.
SMALLEST, LARGEST = 2.0**-64, 2.0**64

DIMENSION_LIMITS = {
    "coupled_primitives": MAX_COUPLED_PRIMITIVES,
    "reference_dim": MAX_REFERENCE_DIM,
    "residual_dim": MAX_RESIDUAL_DIM,
    "reference_hyper_dim": MAX_HYPER_DIM,
    "residual_hyper_dim": MAX_HYPER_DIM,
    "width": MAX_WIDTH,
}


@dataclass(frozen=True)
class SceneSection:
    """The numbers of `FileContent`, and how much of everything there is."""

    anchors: int
    coupled: int  # coupled primitives that exist
    dimensions: Dimensions
    voxel_size: float
    view_distance_scale: float
    background: tuple[float, float, float]
    reference_step: float
    residual_step: float
    covariance_step: float


def encode_scene(content: FileContent) -> bytes:
    d = content.dimensions
    return struct.pack(
        SCENE_LAYOUT,
        len(content.coordinates),
        int(content.mask.sum()),
        d.coupled_primitives,
        d.reference_dim,
        d.residual_dim,
        d.reference_hyper_dim,
        d.residual_hyper_dim,
        HEADS.index(d.heads),
        d.width,
        content.voxel_size,
        content.view_distance_scale,
        *content.background,
        content.reference_step,
        content.residual_step,
        content.covariance_step,
    )


def decode_scene(data: bytes, section: str) -> SceneSection:
    reader = FieldReader(data, section)
    (
        anchors,
        coupled,
        k,
        reference,
        residual,
        reference_hyper,
        residual_hyper,
        heads,
        width,
        voxel,
        distance,
        *rest,
    ) = reader.struct(SCENE_LAYOUT, "fields")
    reader.end()
    if not 1 <= anchors <= MAX_ANCHORS:
        raise CorruptSection(f"{section}: {anchors} anchors, expected 1 to {MAX_ANCHORS}")
    if coupled > anchors * k:
        raise CorruptSection(f"{section}: {coupled} coupled primitives, expected at most {k} for each anchor")
    if heads >= len(HEADS):
        raise CorruptSection(f"{section}: heads are {heads}, expected 0 to {len(HEADS) - 1}")
    d = Dimensions(k, reference, residual, reference_hyper, residual_hyper, HEADS[heads], width)
    for name, limit in DIMENSION_LIMITS.items():
        if not 1 <= getattr(d, name) <= limit:
            raise CorruptSection(f"{section}: {name} is {getattr(d, name)}, expected 1 to {limit}")
    result = SceneSection(anchors, coupled, d, voxel, distance, (rest[0], rest[1], rest[2]), *rest[3:])
    problem = wrong_number(result)
    if problem:
        raise CorruptSection(f"{section}: {problem}")
    return result


def wrong_number(scene: SceneSection | FileContent) -> str:
    """What is wrong with the scene's floating-point numbers; empty if nothing is."""
    for name in ("voxel_size", "view_distance_scale", "reference_step", "residual_step", "covariance_step"):
        if not SMALLEST <= getattr(scene, name) <= LARGEST:
            return f"{name} is {getattr(scene, name)}, expected {SMALLEST:.3g} to {LARGEST:.3g}"
    if len(scene.background) != 3 or not all(abs(value) <= LARGEST for value in scene.background):
        return f"background is {scene.background}, expected three numbers up to {LARGEST:.3g}"
    return ""


def encode_hyper_tables(tables: tuple[HyperTable, ...]) -> bytes:
    """Ranges, then levels: a symbol's as the difference from its predecessor's, the escape's as it is."""
    ranges = [varint(len(table.levels)) + signed_varint(table.lowest) for table in tables]
    differences = [
        np.append(np.diff(t.levels[:-1].astype(np.int32), prepend=0), t.levels[-1]) for t in tables
    ]
    return b"".join(ranges) + encode_arrays([np.concatenate(differences)])


def decode_hyper_tables(data: bytes, section: str, count: int) -> tuple[HyperTable, ...]:
    reader = FieldReader(data, section)
    sizes, lowest = [], []
    for i in range(count):
        sizes.append(reader.varint(f"symbols of table {i}", 2, MAX_HYPER_SYMBOLS + 1))
        lowest.append(reader.signed_varint(f"lowest symbol of table {i}", -MAX_LOWEST, MAX_LOWEST))
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
    return tuple(tables)


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
