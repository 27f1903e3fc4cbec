"""Splats as a .glb file: binary glTF 2.0 with the extension KHR_gaussian_splatting (Khronos, ratified).

    "glTF" | 2 | bytes of the file | JSON chunk | BIN chunk

The JSON has one mesh of one primitive of points, whose attributes are columns of float32 in the BIN chunk; the reader
takes any number of them, each as often as nodes of the scene place it:

| attribute | value |
|---|---|
| POSITION | mean; where means count from (`world_offset`) is the translation of the mesh's node |
| COLOR_0 | color without harmonics, and opacity, in bytes: for viewers that show points only |
| KHR_gaussian_splatting:ROTATION | unit quaternion x-y-z-w |
| KHR_gaussian_splatting:SCALE | standard deviations, world units |
| KHR_gaussian_splatting:OPACITY | 0 to 1 |
| KHR_gaussian_splatting:SH_DEGREE_l_COEF_n | harmonics, red green blue |

Axes are left, up, forward. The reader takes columns of smaller integers where the extension allows them, and a mesh
that its nodes rotate, mirror, move and scale evenly. There is no place for `SplatArrays.antialiased`. What else a file
says of its picture is refused (`_attributes`, `_places`) or told in a note (`_passed_over`).
"""

import json
import struct
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from compgs.errors import SplatFileError
from compgs.formats.arrays import (
    COLOR_OFFSET,
    MAX_DEGREE,
    Y0,
    SplatArrays,
    check_count,
    drawable,
    joined,
    log_scales,
    logit,
    normalized,
)
from compgs.formats.frames import LEFT_UP_FORWARD, transformed, turned
from compgs.notes import note
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
_MOST_PLACEMENTS = 4096  # of splats by nodes
_INSTANCES, _VISIBILITY = "EXT_mesh_gpu_instancing", "KHR_node_visibility"
# That a file may require: attributes of integers are read without it.
_KNOWN_EXTENSIONS = {EXTENSION, _VISIBILITY, "KHR_mesh_quantization"}
# Of the extension: what is drawn here. Who does not know another may ignore it.
_HINTS = {"kernel": "ellipse", "projection": "perspective", "sortingMethod": "cameraDistance"}


def harmonic_names(degree: int) -> list[str]:
    """Attributes of degree 0 to `degree`, in the order of the coefficients."""
    return [f"{EXTENSION}:SH_DEGREE_{l}_COEF_{n}" for l in range(degree + 1) for n in range(2 * l + 1)]


_HARMONICS = harmonic_names(MAX_DEGREE)


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


def told(arrays: SplatArrays) -> str | None:
    """What becomes of splats that a file cannot hold as they are, in words."""
    if not arrays.antialiased:
        return None
    return (
        "its splats are antialiased, which .glb has no place for: programs that open it draw small ones too bright; "
        ".ply, .spz and .sog say it"
    )


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
class Placement:
    """One place that nodes give the splats of one primitive."""

    primitive: int
    matrix: np.ndarray  # [4, 4] of the nodes above the mesh


@dataclass(frozen=True, eq=False)
class GlbFile:
    """JSON and columns of a file, and where in them the splats are."""

    place: Path
    gltf: dict[str, Any]
    data: memoryview  # the BIN chunk
    bytes: int  # of the whole file
    primitives: tuple[dict[str, int], ...]  # accessors by attribute, of those with splats
    placements: tuple[Placement, ...]  # one at least
    passed_over: tuple[str, ...]  # what the file says or shows, and nothing here uses


def begins(head: bytes) -> bool:
    """Whether a file begins as a .glb does."""
    return head.startswith(MAGIC)


def check(path: Path) -> None:
    """Raises SplatFileError for what can be known without looking at the splats."""
    _open(path)


def read(path: Path) -> SplatArrays:
    """Raises SplatFileError."""
    return splats_of(_open(path))


def splats_of(file: GlbFile) -> SplatArrays:
    """All splats of a file, at the places that its nodes give them. Raises SplatFileError."""
    path = file.place
    splats = [_splats(file, attributes) for attributes in file.primitives]
    with np.errstate(invalid="ignore", over="ignore"):  # what is not finite is left out in the end
        parts = [_placed(path, splats[each.primitive], each.matrix) for each in file.placements]
    if file.passed_over:
        note(path, f"not used: {', '.join(file.passed_over)}")
    return turned(drawable(path, joined(parts)), LEFT_UP_FORWARD)


def _splats(file: GlbFile, attributes: dict[str, int]) -> SplatArrays:
    """Read the splats of one primitive, in the frame of its mesh."""
    degree = max((d for d in range(MAX_DEGREE + 1) if harmonic_names(d)[-1] in attributes), default=0)
    means = _column(file, attributes, "POSITION", 3)
    harmonics = [_column(file, attributes, name, 3) for name in harmonic_names(degree)]
    columns: dict[str, Any] = {
        "quaternions": np.roll(_column(file, attributes, f"{EXTENSION}:ROTATION", 4), 1, axis=1),
        "opacity_logits": logit(_column(file, attributes, f"{EXTENSION}:OPACITY", 1)[:, 0]),
        "log_scales": log_scales(_column(file, attributes, f"{EXTENSION}:SCALE", 3)),
        "dc": harmonics[0],
        "rest": np.stack(harmonics[1:], 1) if degree else np.zeros((len(means), 0, 3), np.float32),
    }
    return SplatArrays(means, **columns)


def component_bytes(path: Path) -> dict[str, int]:
    """Bytes of each component of a file; they sum to its size."""
    return component_bytes_of(_open(path))


def component_bytes_of(file: GlbFile) -> dict[str, int]:
    """Bytes of each component; they sum to `file.bytes`."""
    labels = {"POSITION": "positions", "ROTATION": "rotations", "SCALE": "scales", "OPACITY": "opacities"}
    sizes: dict[str, int] = {}
    for attributes in file.primitives:
        for name in attributes:
            last = name.rpartition(":")[2]
            color = last == "SH_DEGREE_0_COEF_0"
            label = "colors" if color else "harmonics" if last.startswith("SH_") else "others"
            label = labels.get(last, label)
            dtype, parts, count = _layout(file, attributes, name)[:3]
            sizes[label] = sizes.get(label, 0) + dtype.itemsize * parts * count
    return {"header": file.bytes - sum(sizes.values()), **sizes}


def _open(path: Path) -> GlbFile:
    """Chunks and structure, checked."""
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
    return described(path, gltf, data, len(content))


def described(path: Path, gltf: dict[str, Any], data: memoryview, size: int) -> GlbFile:
    """The structure of a file of `size` bytes, checked; of the attributes, that they lie within `data`."""
    try:
        primitives, placements = _find_splats(path, gltf)
        file = GlbFile(path, gltf, data, size, primitives, placements, _passed_over(gltf))
        counts = [_checked_count(file, attributes) for attributes in primitives]
        check_count(path, sum(counts[each.primitive] for each in placements), size)
    except (KeyError, IndexError, TypeError, ValueError, AttributeError, OverflowError) as error:
        raise SplatFileError(
            f"{path}: its JSON does not describe splats ({type(error).__name__}: {error})"
        ) from error
    return file


def _checked_count(file: GlbFile, attributes: dict[str, int]) -> int:
    """How many splats. Raises SplatFileError unless all that they need is there, for one number of them."""
    needed = ["POSITION", *(f"{EXTENSION}:{name}" for name in ("ROTATION", "SCALE", "OPACITY"))]
    for name in [*needed, *harmonic_names(0)]:
        if name not in attributes:
            raise SplatFileError(f"{file.place}: attribute {name} is missing")
    counts = {_layout(file, attributes, name)[2] for name in attributes}
    if len(counts) != 1 or counts == {0}:
        raise SplatFileError(
            f"{file.place}: expected attributes of one number of splats, found {sorted(counts)}"
        )
    return counts.pop()


def _find_splats(
    path: Path, gltf: dict[str, Any]
) -> tuple[tuple[dict[str, int], ...], tuple[Placement, ...]]:
    """Every primitive of splats, and each place that the scene gives it."""
    foreign = sorted(set(gltf.get("extensionsRequired", [])) - _KNOWN_EXTENSIONS)
    if foreign:
        raise SplatFileError(f"{path}: needs the extension {foreign[0]}, which is not read here")
    primitives: list[dict[str, int]] = []
    of_mesh: dict[int, list[int]] = {}
    for mesh, content in enumerate(gltf.get("meshes", [])):
        for primitive in content["primitives"]:
            if EXTENSION in primitive.get("extensions", {}):
                of_mesh.setdefault(mesh, []).append(len(primitives))
                primitives.append(_attributes(path, primitive))
    if not primitives:
        raise SplatFileError(f"{path}: holds no splats ({EXTENSION})")
    placements: list[Placement] = []
    for mesh, matrix in _places(path, gltf):
        placements += [Placement(number, matrix) for number in of_mesh.get(mesh, [])]
        if len(placements) > _MOST_PLACEMENTS:
            raise SplatFileError(f"{path}: places splats more than {_MOST_PLACEMENTS} times")
    if not placements:
        raise SplatFileError(f"{path}: its splats are in no scene")
    return tuple(primitives), tuple(placements)


def _attributes(path: Path, primitive: dict[str, Any]) -> dict[str, int]:
    """Accessors by name. Raises SplatFileError for splats that are drawn or packed in a way that is not known here."""
    extension = primitive["extensions"][EXTENSION]
    space = extension.get("colorSpace", COLOR_SPACE)
    if space != COLOR_SPACE:
        raise SplatFileError(f"{path}: colors in {space}; expected {COLOR_SPACE}")
    inner = sorted(extension.get("extensions", {}))
    attributes = dict(primitive["attributes"])
    if inner and f"{EXTENSION}:ROTATION" not in attributes:
        raise SplatFileError(
            f"{path}: its splats are packed by the extension {inner[0]}, which is not read here; export them without it"
        )
    if not all(type(index) is int and index >= 0 for index in attributes.values()):
        raise SplatFileError(f"{path}: attributes are named by {attributes}, expected numbers of accessors")
    return attributes


def _passed_over(gltf: dict[str, Any]) -> tuple[str, ...]:
    """What a file says of its splats, or shows beside them, that nothing here uses."""
    found: list[str] = []
    others = 0
    used = {"POSITION", "COLOR_0", *(f"{EXTENSION}:{name}" for name in ("ROTATION", "SCALE", "OPACITY"))}
    for primitive in (primitive for mesh in gltf["meshes"] for primitive in mesh["primitives"]):
        extension = primitive.get("extensions", {}).get(EXTENSION)
        if extension is None:
            others += 1
            continue
        for name, known in _HINTS.items():
            if extension.get(name, known) != known:
                found.append(f"{name} {extension[name]!r:.40} (drawn as {known})")
        found += [f"extension {name}" for name in sorted(extension.get("extensions", {}))]
        found += [f"attribute {name}" for name in primitive["attributes"] if name not in {*used, *_HARMONICS}]
        found += ["morph targets"] if "targets" in primitive else []
    found += [f"{others} meshes of triangles, lines or points"] if others else []
    found += [name for name in ("animations", "skins") if gltf.get(name)]
    return tuple(dict.fromkeys(found))


def _places(path: Path, gltf: dict[str, Any]) -> Iterator[tuple[int, np.ndarray]]:
    """Each node that has a mesh: which one, and the product [4, 4] of the nodes from the scene down to it."""
    nodes = gltf.get("nodes", [])
    scenes = gltf.get("scenes", [])
    roots = scenes[gltf.get("scene", 0)].get("nodes", []) if scenes else _roots(nodes)
    waiting = [(index, np.eye(4), 0) for index in reversed(roots)]
    visited = set()
    while waiting:
        index, above, depth = waiting.pop()
        if depth > _DEEPEST or index in visited or index < 0:
            raise SplatFileError(f"{path}: its nodes are not a tree")
        visited.add(index)
        node = nodes[index]
        extensions = node.get("extensions", {})
        if extensions.get(_VISIBILITY, {}).get("visible", True) is False:
            continue
        here = above @ _node_matrix(node)
        if "mesh" in node:
            if _INSTANCES in extensions:
                raise SplatFileError(
                    f"{path}: node {index} places its mesh by {_INSTANCES}, which is not read here"
                )
            yield node["mesh"], here
        waiting += [(child, here, depth + 1) for child in reversed(node.get("children", []))]


def _roots(nodes: list[dict[str, Any]]) -> list[int]:
    """Return the roots of a file without scenes: nodes that are no other's children."""
    children = {child for node in nodes for child in node.get("children", [])}
    return [index for index in range(len(nodes)) if index not in children]


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


def _placed(path: Path, arrays: SplatArrays, matrix: np.ndarray) -> SplatArrays:
    """Where the nodes put splats. Raises SplatFileError for a scale that is not even."""
    linear = matrix[:3, :3]
    if np.array_equal(linear, np.eye(3)):
        return replace(arrays, world_offset=tuple(matrix[:3, 3].tolist()))
    determinant = float(np.linalg.det(linear))
    square = abs(determinant) ** (2 / 3)
    if not (square > 0 and np.allclose(linear @ linear.T, np.eye(3) * square, rtol=0, atol=_EVEN * square)):
        raise SplatFileError(f"{path}: its node stretches the splats, which is not read here")
    if determinant > 0:
        return transformed(arrays, matrix)
    mirrored = matrix.copy()
    mirrored[:3, 0] *= -1  # what remains is a rotation, of splats that are mirrored first
    return transformed(turned(arrays, (-1, 1, 1)), mirrored)


def _layout(
    file: GlbFile, attributes: dict[str, int], name: str
) -> tuple[np.dtype, int, int, int, int, bool]:
    """Type, parts, rows, first byte, bytes from row to row, and whether integers are parts of their largest."""
    accessor = file.gltf["accessors"][attributes[name]]
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


def _column(file: GlbFile, attributes: dict[str, int], name: str, parts: int) -> np.ndarray:
    """[M, parts] float32."""
    if name not in attributes:
        raise SplatFileError(f"{file.place}: attribute {name} is missing")
    dtype, found, count, start, stride, fraction = _layout(file, attributes, name)
    if found != parts:
        raise SplatFileError(f"{file.place}: {name} has {found} parts, expected {parts}")
    rows = np.ndarray((count, parts), dtype, file.data, start, (stride, dtype.itemsize))
    if not fraction or dtype.kind == "f":
        return rows.astype(np.float32)
    return np.maximum(rows / np.float32(np.iinfo(dtype).max), -1).astype(np.float32)
