"""Splats as a .gltf file: the JSON of `glb` as text, its columns in a file beside it, or in the text as base64.

Only read here. Buffers become one, as they are in a .glb file, and the rest is read as that.
"""

import base64
import binascii
import json
from pathlib import Path, PurePosixPath
from typing import Any
from urllib.parse import unquote

from compgs.errors import SplatFileError
from compgs.formats import glb
from compgs.formats.arrays import SplatArrays

# Keys of which a glTF file has some at its top, and no other JSON that is read here.
_MARKS = tuple(
    f'"{key}"'.encode()
    for key in (
        "accessors",
        "bufferViews",
        "buffers",
        "meshes",
        "scenes",
        "extensionsUsed",
        "extensionsRequired",
    )
)
_DATA, _BASE64 = "data:", ";base64,"
_ALIGNED = 4  # bytes, the largest number of a column


def begins(head: bytes) -> bool:
    """Whether a file begins as a .gltf does."""
    return head.lstrip().startswith(b"{") and any(mark in head for mark in _MARKS)


def check(path: Path) -> None:
    """Raises SplatFileError for what can be known without looking at the splats."""
    _open(path)


def read(path: Path) -> SplatArrays:
    """Raises SplatFileError."""
    return glb.splats_of(_open(path))


def component_bytes(path: Path) -> dict[str, int]:
    """Bytes of each component; they sum to the size of the file and of those that it names."""
    return glb.component_bytes_of(_open(path))


def _open(path: Path) -> glb.GlbFile:
    content = path.read_bytes()
    try:
        gltf = json.loads(content)
        if not isinstance(gltf, dict):
            raise TypeError("expected an object")
        buffers = [_buffer(path, buffer) for buffer in gltf.get("buffers", [])]
        views = gltf.get("bufferViews", [])
        starts, data = _concatenated(buffers)
        moved = [_moved(path, view, buffers, starts) for view in views]
    except RecursionError as error:
        raise SplatFileError(f"{path}: is not JSON ({error}); copy it again") from error
    except (KeyError, IndexError, TypeError, AttributeError, ValueError) as error:
        raise SplatFileError(f"{path}: does not describe splats ({type(error).__name__}: {error})") from error
    files = {buffer["uri"] for buffer in gltf.get("buffers", []) if not buffer["uri"].startswith(_DATA)}
    size = len(content) + sum(_beside(path, uri).stat().st_size for uri in files)
    joined = {**gltf, "buffers": [{"byteLength": len(data)}], "bufferViews": moved}
    return glb.described(path, joined, memoryview(data), size)


def _buffer(path: Path, buffer: dict[str, Any]) -> bytes:
    """Its bytes. Raises SplatFileError where there are fewer than it promises."""
    if "uri" not in buffer:
        raise SplatFileError(f"{path}: a buffer without 'uri', as in .glb files; export the scene again")
    uri, length = buffer["uri"], buffer["byteLength"]
    if uri.startswith(_DATA):
        kind, found, text = uri.partition(_BASE64)
        if not found:
            raise SplatFileError(f"{path}: a buffer as {kind[:40]!r}, expected {_DATA}...{_BASE64}...")
        name = "a buffer"
        try:
            data = base64.b64decode(text, validate=True)
        except binascii.Error as error:
            raise SplatFileError(f"{path}: {name}: is no base64 ({error}); copy it again") from error
    else:
        file = _beside(path, uri)
        if not file.is_file():
            raise SplatFileError(
                f"{path}: {file.name}, which it names, is missing; copy both into one folder"
            )
        name, data = file.name, file.read_bytes()
    if type(length) is not int or not 0 <= length <= len(data):
        raise SplatFileError(f"{path}: {name}: {length} bytes are promised, found {len(data)}; copy it again")
    return data[:length]


def _beside(path: Path, uri: str) -> Path:
    """The file that a relative address names. Raises SplatFileError for one that is not below the folder."""
    name = unquote(uri)
    parts = PurePosixPath(name).parts
    if not parts or parts[0] == "/" or ".." in parts or ":" in name or "\\" in name or "\0" in name:
        raise SplatFileError(f"{path}: {uri[:80]!r} is not the name of a file below its folder")
    return path.parent / name


def _concatenated(buffers: list[bytes]) -> tuple[list[int], bytes]:
    """Where each begins, and all of them, one after the other."""
    starts, parts, length = [], [], 0
    for buffer in buffers:
        starts.append(length)
        parts += [buffer, bytes(-len(buffer) % _ALIGNED)]
        length += len(buffer) + len(parts[-1])
    return starts, b"".join(parts)


def _moved(path: Path, view: dict[str, Any], buffers: list[bytes], starts: list[int]) -> dict[str, Any]:
    """A part of one buffer as a part of all of them. Raises SplatFileError for one that is not within its own."""
    index, offset, length = view["buffer"], view.get("byteOffset", 0), view["byteLength"]
    numbers = index, offset, length
    whole = all(type(number) is int and number >= 0 for number in numbers)
    if not whole or index >= len(buffers) or offset + length > len(buffers[index]):
        raise SplatFileError(
            f"{path}: a part of {length} bytes at byte {offset} is not within buffer {index}"
        )
    return {**view, "buffer": 0, "byteOffset": starts[index] + offset}
