"""Sparse points of a .ply file: what nerfstudio writes beside its poses."""

import codecs
from pathlib import Path

import numpy as np

from compgs.errors import SceneError
from compgs.scene.capture import usable_positions
from compgs.scene.views import Points

_TYPES = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("float", "float32"), "f4"),
    **dict.fromkeys(("double", "float64"), "f8"),
}
_GRAY = 128
HARMONICS = ("f_dc_0", "f_dc_1", "f_dc_2")
COLOR_NAMES = (
    ("red", "green", "blue"),
    ("diffuse_red", "diffuse_green", "diffuse_blue"),
    ("r", "g", "b"),
    HARMONICS,
)
Y0 = 0.28209479177387814  # 1 / (2 sqrt(pi)): the constant harmonic


def read_ply_points(file: Path) -> Points:
    """Positions and colors (else gray) of the vertices, ascii or binary. Raises SceneError."""
    try:
        data = file.read_bytes().removeprefix(codecs.BOM_UTF8)
    except OSError as error:
        raise SceneError(f"{file}: cannot be read ({error.strerror or error})") from error
    end = data.find(b"end_header")
    newline = data.find(b"\n", end)
    if not data.startswith(b"ply") or end < 0 or newline < 0:
        raise SceneError(f"{file}: is not a .ply file; export the points again")
    try:
        order, count, columns = _header(data[:end].decode("ascii"))
        body = data[newline + 1 :]
        if order == "ascii":
            lines = body.split(b"\n")[:count]
            table = np.array([line.split()[: len(columns)] for line in lines], dtype=np.float64)
            rows = {name: table.reshape(count, len(columns))[:, i] for i, (name, _) in enumerate(columns)}
        else:
            vertices = np.frombuffer(body, np.dtype([(n, order + t) for n, t in columns]), count)
            rows = {name: vertices[name] for name, _ in columns}
        with np.errstate(invalid="ignore"):  # what is no number is left out below
            positions = np.stack([rows[axis] for axis in "xyz"], axis=1).astype(np.float64)
    except (ValueError, KeyError, IndexError) as error:
        raise SceneError(
            f"{file}: vertices with x, y, z were expected ({error}); export them again"
        ) from error
    colors = _colors(rows, dict(columns), count)
    finite = usable_positions(positions)
    return Points(positions[finite], colors[finite])


def _colors(rows: dict[str, np.ndarray], types: dict[str, str], count: int) -> np.ndarray:
    """[P, 3] uint8, by the range of the values that are there; gray without any.

    Programs write 0 to 255, 0 to 65535 (16 bits) or 0 to 1 (floating point); splats have the constant term of their
    harmonics.
    """
    names = next((found for found in COLOR_NAMES if all(name in rows for name in found)), None)
    if names is None:
        return np.full((count, 3), _GRAY, dtype=np.uint8)
    with np.errstate(invalid="ignore", over="ignore"):
        values = np.nan_to_num(np.stack([rows[name] for name in names], axis=1).astype(np.float64))
        if names == HARMONICS:
            values = 255 * (0.5 + Y0 * values)
        elif types[names[0]] == "u2":
            values = values / 257
        elif types[names[0]].startswith("f") and values.size and values.max() <= 1:
            values = 255 * values
        return np.clip(np.round(values), 0, 255).astype(np.uint8)


def _header(text: str) -> tuple[str, int, list[tuple[str, str]]]:
    """(byte order or `ascii`, number of vertices, (name, type) of their properties)."""
    columns: list[tuple[str, str]] = []
    order, count, element = "", 0, ""
    for line in text.splitlines():
        words = line.split()
        if words[:1] == ["format"]:
            order = {"ascii": "ascii", "binary_little_endian": "<", "binary_big_endian": ">"}[words[1]]
        elif words[:1] == ["element"]:
            if not columns and words[1] != "vertex":
                raise ValueError(f"the first element is {words[1]}")
            element, count = words[1], int(words[2]) if words[1] == "vertex" else count
        elif words[:1] == ["property"] and element == "vertex":
            columns.append((words[-1], _TYPES[words[1]]))
    if not order or count < 0:
        raise ValueError("the header is incomplete")
    return order, count, columns
