"""Splats as a .glb file: binary glTF 2.0 with the extension KHR_gaussian_splatting (Khronos, ratified).

    "glTF" | 2 | bytes of the file | JSON chunk | BIN chunk

The JSON has one mesh of one primitive of points, whose attributes are columns of float32 in the BIN chunk:

| attribute | value |
|---|---|
| POSITION | mean; where means count from (`world_offset`) is the translation of the mesh's node |
| COLOR_0 | color without harmonics, and opacity, in bytes: for viewers that show points only |
| KHR_gaussian_splatting:ROTATION | unit quaternion x-y-z-w |
| KHR_gaussian_splatting:SCALE | standard deviations, world units |
| KHR_gaussian_splatting:OPACITY | 0 to 1 |
| KHR_gaussian_splatting:SH_DEGREE_l_COEF_n | harmonics, red green blue |

Axes are left, up, forward. The reader takes columns of smaller integers where the extension allows them, and a mesh
that its nodes rotate, move and scale evenly.
"""

import json
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from compgs.errors import SplatFileError
from compgs.formats.arrays import (
    COLOR_OFFSET,
    MAX_DEGREE,
    Y0,
    SplatArrays,
    checked,
    logit,
    normalized,
)
from compgs.formats.frames import LEFT_UP_FORWARD, transformed, turned
from compgs.numerics.rotations import rotation_from_quaternion

MAGIC = b"glTF"
EXTENSION = "KHR_gaussian_splatting"
COLOR_SPACE = "srgb_rec709_display"
JSON_CHUNK, BIN_CHUNK = 0x4E4F534A, 0x004E4942
POINTS = 0
FLOAT, UNSIGNED_BYTE = 5126, 5121
_TYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5126: "<f4"}
_PARTS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}
_DEEPEST = 64  # nodes inside nodes
_EVEN = 1e-4  # relative difference of lengths that is rounding


def harmonic_names(degree: int) -> list[str]:
    """Attributes of degree 0 to `degree`, in the order of the coefficients."""
    return [f"{EXTENSION}:SH_DEGREE_{l}_COEF_{n}" for l in range(degree + 1) for n in range(2 * l + 1)]


# writing -----------------------------------------------------------------------------------------------------------


def encoded(arrays: SplatArrays) -> bytes:
    """The content of the file."""
    arrays = turned(arrays, LEFT_UP_FORWARD)
    columns = _columns(arrays)
    data = b"".join(column.tobytes() for column in columns.values())
    text = json.dumps(_gltf(arrays, columns), separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    chunks = (
        struct.pack("<II", len(text), JSON_CHUNK) + text + struct.pack("<II", len(data), BIN_CHUNK) + data
    )
    return MAGIC + struct.pack("<II", 2, 12 + len(chunks)) + chunks


def _columns(arrays: SplatArrays) -> dict[str, np.ndarray]:
    """Attributes [M, parts] by name: float32, the color bytes; rows of all are multiples of four bytes."""
    colors = np.column_stack([COLOR_OFFSET + Y0 * arrays.dc, arrays.opacities])
    harmonics = np.concatenate([arrays.dc[:, None], arrays.rest], 1)
    columns = {
        "POSITION": arrays.means,
        f"{EXTENSION}:ROTATION": np.roll(normalized(arrays.quaternions), -1, axis=1),
        f"{EXTENSION}:SCALE": np.exp(arrays.log_scales),
        f"{EXTENSION}:OPACITY": arrays.opacities[:, None],
    }
    for i, name in enumerate(harmonic_names(arrays.degree)):
        columns[name] = harmonics[:, i]
    floats = {name: np.ascontiguousarray(column, "<f4") for name, column in columns.items()}
    return {**floats, "COLOR_0": np.rint(255 * np.clip(colors, 0, 1)).astype(np.uint8)}


def _gltf(arrays: SplatArrays, columns: dict[str, np.ndarray]) -> dict[str, Any]:
    """The JSON chunk."""
    views, accessors, offset = [], [], 0
    for i, (name, column) in enumerate(columns.items()):
        views.append({"buffer": 0, "byteOffset": offset, "byteLength": column.nbytes, "target": 34962})
        accessor: dict[str, Any] = {
            "bufferView": i,
            "componentType": UNSIGNED_BYTE if column.dtype == np.uint8 else FLOAT,
            "count": len(column),
            "type": next(kind for kind, parts in _PARTS.items() if parts == column.shape[1]),
        }
        if column.dtype == np.uint8:
            accessor["normalized"] = True
        if name == "POSITION":
            accessor |= {"min": column.min(0).tolist(), "max": column.max(0).tolist()}
        accessors.append(accessor)
        offset += column.nbytes
    node: dict[str, Any] = {"mesh": 0}
    if any(arrays.world_offset):
        node["translation"] = list(arrays.world_offset)
    splatting = {
        "kernel": "ellipse",
        "colorSpace": COLOR_SPACE,
        "sortingMethod": "cameraDistance",
        "projection": "perspective",
    }
    attributes = {name: i for i, name in enumerate(columns)}
    primitive = {"attributes": attributes, "mode": POINTS, "extensions": {EXTENSION: splatting}}
    return {
        "asset": {"version": "2.0", "generator": "compgs"},
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [node],
        "meshes": [{"primitives": [primitive]}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": offset}],
    }


# reading -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class GlbFile:
    """A file's two chunks, and where in the JSON the splats are."""

    place: Path
    gltf: dict[str, Any]
    data: memoryview  # the BIN chunk
    attributes: dict[str, int]  # accessors by name
    matrix: np.ndarray  # [4, 4] of the nodes above the mesh


def begins(head: bytes) -> bool:
    """Whether a file begins as a .glb does."""
    return head.startswith(MAGIC)


def check(path: Path) -> None:
    """Raises SplatFileError for what can be known without looking at the splats."""
    _open(path)


def read(path: Path) -> SplatArrays:
    """Raises SplatFileError."""
    file = _open(path)
    degree = max((d for d in range(MAX_DEGREE + 1) if harmonic_names(d)[-1] in file.attributes), default=0)
    means = _column(file, "POSITION", 3)
    harmonics = [_column(file, name, 3) for name in harmonic_names(degree)]
    scales = _column(file, f"{EXTENSION}:SCALE", 3)
    if not (scales >= 0).all():
        raise SplatFileError(f"{path}: {EXTENSION}:SCALE: expected positive numbers")
    columns = {
        "quaternions": np.roll(_column(file, f"{EXTENSION}:ROTATION", 4), 1, axis=1),
        "opacity_logits": logit(_column(file, f"{EXTENSION}:OPACITY", 1)[:, 0]),
        "log_scales": np.log(np.maximum(scales, np.finfo(np.float32).tiny)),
        "dc": harmonics[0],
        "rest": np.stack(harmonics[1:], 1) if degree else np.zeros((len(means), 0, 3), np.float32),
    }
    if {len(column) for column in columns.values()} != {len(means)}:
        raise SplatFileError(f"{path}: its attributes are of different numbers of splats")
    found = checked(path, SplatArrays(means, **columns))
    if not np.array_equal(file.matrix[:3, :3], np.eye(3)) or file.matrix[:3, 3].any():
        found = checked(path, _placed(file, found))
    return turned(found, LEFT_UP_FORWARD)


def component_bytes(path: Path) -> dict[str, int]:
    """Bytes of each component of a file; they sum to its size."""
    file = _open(path)
    labels = {"POSITION": "positions", "ROTATION": "rotations", "SCALE": "scales", "OPACITY": "opacities"}
    sizes: dict[str, int] = {}
    for name in file.attributes:
        last = name.rpartition(":")[2]
        label = (
            "colors" if last == "SH_DEGREE_0_COEF_0" else "harmonics" if last.startswith("SH_") else "others"
        )
        label = labels.get(last, label)
        dtype, parts, count = _layout(file, name)[:3]
        sizes[label] = sizes.get(label, 0) + dtype.itemsize * parts * count
    return {"header": path.stat().st_size - sum(sizes.values()), **sizes}


def _open(path: Path) -> GlbFile:
    """Chunks and structure, checked; of the attributes, that they lie within the file."""
    content = path.read_bytes()
    if len(content) < 20 or not begins(content):
        raise SplatFileError(f"{path}: does not begin as a .glb file does, or ends within its header")
    version, size, text_size, kind = struct.unpack_from("<IIII", content, 4)
    if version != 2 or size != len(content) or kind != JSON_CHUNK or 20 + text_size > len(content):
        raise SplatFileError(
            f"{path}: expected glTF 2 of {len(content)} bytes that begins with JSON, found version {version} of "
            f"{size} bytes; copy it again"
        )
    try:
        gltf = json.loads(content[20 : 20 + text_size])
    except (ValueError, RecursionError) as error:
        raise SplatFileError(f"{path}: its first chunk is not JSON ({error}); copy it again") from error
    data = memoryview(b"")
    if 28 + text_size <= len(content):
        length, kind = struct.unpack_from("<II", content, 20 + text_size)
        if kind != BIN_CHUNK or 28 + text_size + length > len(content):
            raise SplatFileError(f"{path}: its second chunk is not whole; copy it again")
        data = memoryview(content)[28 + text_size : 28 + text_size + length]
    try:
        attributes, matrix = _find_splats(path, gltf)
        file = GlbFile(path, gltf, data, attributes, matrix)
        needed = ["POSITION", *(f"{EXTENSION}:{name}" for name in ("ROTATION", "SCALE", "OPACITY"))]
        for name in [*needed, *harmonic_names(0)]:
            if name not in attributes:
                raise SplatFileError(f"{path}: attribute {name} is missing")
        counts = {_layout(file, name)[2] for name in attributes}
    except (KeyError, IndexError, TypeError, ValueError, AttributeError, OverflowError) as error:
        raise SplatFileError(
            f"{path}: its JSON does not describe splats ({type(error).__name__}: {error})"
        ) from error
    if len(counts) != 1 or counts == {0}:
        raise SplatFileError(f"{path}: expected attributes of one number of splats, found {sorted(counts)}")
    return file


def _find_splats(path: Path, gltf: dict[str, Any]) -> tuple[dict[str, int], np.ndarray]:
    """The attributes of the one primitive of splats, and the matrix of its place in the scene."""
    foreign = sorted(set(gltf.get("extensionsRequired", [])) - {EXTENSION})
    if foreign:
        raise SplatFileError(f"{path}: needs the extension {foreign[0]}, which is not read here")
    found = [
        (mesh, primitive)
        for mesh, content in enumerate(gltf.get("meshes", []))
        for primitive in content["primitives"]
        if EXTENSION in primitive.get("extensions", {})
    ]
    if len(found) != 1:
        raise SplatFileError(f"{path}: holds {len(found)} sets of splats ({EXTENSION}), expected one")
    mesh, primitive = found[0]
    space = primitive["extensions"][EXTENSION].get("colorSpace", COLOR_SPACE)
    if space != COLOR_SPACE:
        raise SplatFileError(f"{path}: colors in {space}; expected {COLOR_SPACE}")
    attributes = dict(primitive["attributes"])
    if not all(type(index) is int and index >= 0 for index in attributes.values()):
        raise SplatFileError(f"{path}: attributes are named by {attributes}, expected numbers of accessors")
    return attributes, _place(path, gltf, mesh)


def _place(path: Path, gltf: dict[str, Any], mesh: int) -> np.ndarray:
    """[4, 4] product of the nodes from the scene down to a mesh."""
    nodes = gltf.get("nodes", [])
    scenes = gltf.get("scenes", [])
    roots = scenes[gltf.get("scene", 0)].get("nodes", []) if scenes else range(len(nodes))
    waiting = [(index, np.eye(4), 0) for index in roots]
    visited = set()
    while waiting:
        index, above, depth = waiting.pop()
        if depth > _DEEPEST or index in visited or index < 0:
            raise SplatFileError(f"{path}: its nodes are not a tree")
        visited.add(index)
        here = above @ _node_matrix(nodes[index])
        if nodes[index].get("mesh") == mesh:
            return here
        waiting += [(child, here, depth + 1) for child in nodes[index].get("children", [])]
    raise SplatFileError(f"{path}: its splats are in no scene")


def _node_matrix(node: dict[str, Any]) -> np.ndarray:
    """[4, 4] of `matrix` (column by column), or of translation, rotation (x-y-z-w) and scale."""
    if "matrix" in node:
        matrix = np.array(node["matrix"], np.float64).reshape(4, 4).T
    else:
        matrix = np.eye(4)
        rotation = np.array(node.get("rotation", [0, 0, 0, 1]), np.float64)
        if rotation.shape != (4,) or not rotation.any():
            raise ValueError(f"rotation {node['rotation']}")
        turn = rotation_from_quaternion(np.roll(rotation, 1))
        matrix[:3, :3] = turn * np.array(node.get("scale", [1, 1, 1]), np.float64).reshape(3)
        matrix[:3, 3] = np.array(node.get("translation", [0, 0, 0]), np.float64).reshape(3)
    if not np.isfinite(matrix).all():
        raise ValueError("a node's place is not finite")
    return matrix


def _placed(file: GlbFile, arrays: SplatArrays) -> SplatArrays:
    """Where the nodes put the splats. Raises SplatFileError for a scale that is not even."""
    linear = file.matrix[:3, :3]
    if np.array_equal(linear, np.eye(3)):
        return SplatArrays(**{**vars(arrays), "world_offset": tuple(file.matrix[:3, 3].tolist())})
    determinant = float(np.linalg.det(linear))
    even = determinant > 0 and np.allclose(
        linear @ linear.T, np.eye(3) * determinant ** (2 / 3), rtol=0, atol=_EVEN * determinant ** (2 / 3)
    )
    if not even:
        raise SplatFileError(
            f"{file.place}: its node stretches or mirrors the splats, which is not read here"
        )
    return transformed(arrays, file.matrix)


def _layout(file: GlbFile, name: str) -> tuple[np.dtype, int, int, int, int, bool]:
    """Type, parts, rows, first byte, bytes from row to row, and whether integers are parts of their largest."""
    accessor = file.gltf["accessors"][file.attributes[name]]
    view = file.gltf["bufferViews"][accessor["bufferView"]]
    if "sparse" in accessor or view.get("buffer", 0) != 0 or "uri" in file.gltf["buffers"][0]:
        raise SplatFileError(f"{file.place}: {name} is sparse or in another file, which is not read here")
    dtype, parts = np.dtype(_TYPES[accessor["componentType"]]), _PARTS[accessor["type"]]
    count, width = accessor["count"], dtype.itemsize * parts
    stride = view.get("byteStride", width)
    start, inside = view.get("byteOffset", 0), accessor.get("byteOffset", 0)
    numbers = (count, stride, start, inside, view["byteLength"])
    if not all(type(number) is int and number >= 0 for number in numbers):
        raise SplatFileError(f"{file.place}: {name}: expected whole numbers of bytes, found {numbers}")
    end = inside + stride * (count - 1) + width if count else inside
    if stride < width or end > view["byteLength"] or start + view["byteLength"] > len(file.data):
        raise SplatFileError(f"{file.place}: {name} reaches beyond its part of the file; copy it again")
    return dtype, parts, count, start + inside, stride, bool(accessor.get("normalized", False))


def _column(file: GlbFile, name: str, parts: int) -> np.ndarray:
    """[M, parts] float32."""
    if name not in file.attributes:
        raise SplatFileError(f"{file.place}: attribute {name} is missing")
    dtype, found, count, start, stride, fraction = _layout(file, name)
    if found != parts:
        raise SplatFileError(f"{file.place}: {name} has {found} parts, expected {parts}")
    rows = np.ndarray((count, parts), dtype, file.data, start, (stride, dtype.itemsize))
    if not fraction or dtype.kind == "f":
        return rows.astype(np.float32)
    return np.maximum(rows / np.float32(np.iinfo(dtype).max), -1).astype(np.float32)
