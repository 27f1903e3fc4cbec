"""Splats as a .compressed.ply file (SuperSplat, PlayCanvas): 16 bytes each, and a byte for a harmonic. Only read here.

    header | chunks | vertices | sh

A chunk holds the ranges of 256 splats, in float32; the splats of it lie between them.

| element | properties | value |
|---|---|---|
| chunk | min_x ... max_z | range of the positions |
| | min_scale_x ... max_scale_z | range of the log scales |
| | min_r ... max_b | range of the colors in all directions; 0 to 1 where a file has none |
| vertex | packed_position | 11, 10, 11 bits, from the top: x, y, z between the chunk's |
| | packed_rotation | 2 bits: which of w-x-y-z is the largest; 10 bits each: the others, (v / 1023 - 1/2) sqrt(2) |
| | packed_scale | 11, 10, 11 bits |
| | packed_color | 8 bits each: red, green, blue between the chunk's; opacity / 255 |
| sh | f_rest_0 ... | a byte each, channel by channel: 0 is -4, 255 is 4, between them (v + 1/2) / 32 - 4 |

Axes, and the comment that says how splats are drawn, are those of other .ply files.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from compgs.errors import SplatFileError
from compgs.formats import ply
from compgs.formats.arrays import (
    COLOR_OFFSET,
    MAX_DEGREE,
    Y0,
    SplatArrays,
    drawable,
    harmonics_above_dc,
    logit,
)
from compgs.notes import note

CHUNK = 256  # splats that share their ranges
_POSITIONS = tuple(f"{end}_{axis}" for end in ("min", "max") for axis in "xyz")
_SCALES = tuple(f"{end}_scale_{axis}" for end in ("min", "max") for axis in "xyz")
_COLORS = tuple(f"{end}_{channel}" for end in ("min", "max") for channel in "rgb")
_PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
_HARMONIC_RANGE = 4.0
_SQRT2 = 2**0.5
_REMEDY = "save it again with SuperSplat, or as an uncompressed 3DGS .ply"


@dataclass(frozen=True)
class Layout:
    """Where in the file which element is, checked against its size."""

    count: int  # splats
    degree: int  # of the harmonics
    rows: dict[str, np.dtype]  # of chunk, vertex and, where there are harmonics, sh
    starts: dict[str, int]  # bytes before the first row of each
    bytes: int  # of the whole file
    antialiased: bool
    unused: tuple[str, ...]  # elements and properties that say nothing here


def begins(head: bytes) -> bool:
    """Whether a file begins as a .compressed.ply does: its chunks come before its vertices."""
    if not ply.begins(head):
        return False
    elements = [words for line in head.split(b"\n") if (words := line.split())[:1] == [b"element"]]
    return bool(elements) and elements[0][1:2] == [b"chunk"]


def check(path: Path) -> None:
    """Raises SplatFileError for what can be known without reading the splats."""
    _layout(path)


def read(path: Path) -> SplatArrays:
    """Raises SplatFileError."""
    layout = _layout(path)
    chunks, vertices = _element(path, layout, "chunk"), _element(path, layout, "vertex")
    colors = _parts(vertices["packed_color"], 8, 8, 8, 8)
    ranges = _COLORS if _COLORS[0] in (chunks.dtype.names or ()) else None
    shown = _between(chunks, ranges, colors[:, :3]).astype(np.float64)
    with np.errstate(over="ignore"):  # colors that are too large are left out with their splats
        dc = ((shown - COLOR_OFFSET) / Y0).astype(np.float32)
    found = SplatArrays(
        means=_between(chunks, _POSITIONS, _parts(vertices["packed_position"], 11, 10, 11)),
        log_scales=_between(chunks, _SCALES, _parts(vertices["packed_scale"], 11, 10, 11)),
        quaternions=_rotations(vertices["packed_rotation"]),
        opacity_logits=logit(colors[:, 3]),
        dc=dc,
        rest=_harmonics(path, layout),
        antialiased=layout.antialiased,
    )
    if layout.unused:
        note(path, f"not used: {', '.join(layout.unused)}")
    return drawable(path, found)


def component_bytes(path: Path) -> dict[str, int]:
    """Bytes of each component of a file; they sum to its size."""
    layout = _layout(path)
    labels = dict(zip(_PACKED, ("positions", "rotations", "scales", "colors and opacities"), strict=True))
    sizes = {"header": 0, "ranges": layout.starts["vertex"] - layout.starts["chunk"]}
    vertex = layout.rows["vertex"]
    for name in vertex.names or ():
        label = labels.get(name, "others")
        sizes[label] = sizes.get(label, 0) + layout.count * vertex[name].itemsize
    if "sh" in layout.rows:
        sizes["harmonics"] = layout.count * layout.rows["sh"].itemsize
    sizes["header"] = layout.bytes - sum(sizes.values())
    return sizes


def _layout(path: Path) -> Layout:
    lines, start, size = ply.header_lines(path)
    rows: dict[str, np.dtype] = {}
    starts: dict[str, int] = {}
    counts: dict[str, int] = {}
    end = start
    for name, count, columns in _elements(path, lines):
        rows[name], starts[name], counts[name] = np.dtype(columns), end, count
        end += count * rows[name].itemsize
    if size != end:
        raise SplatFileError(f"{path}: the header promises {end} bytes, the file has {size}; copy it again")
    for name, needed, kind in (
        ("chunk", (*_POSITIONS, *_SCALES), "<f4"),
        ("vertex", _PACKED, "<u4"),
    ):
        _check_row(path, name, rows.get(name), needed, kind)
    if set(_COLORS) & set(rows["chunk"].names or ()):
        _check_row(path, "chunk", rows["chunk"], _COLORS, "<f4")
    count = counts["vertex"]
    if count == 0:
        raise SplatFileError(f"{path}: holds no splats")
    if counts["chunk"] != -(-count // CHUNK):
        raise SplatFileError(
            f"{path}: {counts['chunk']} chunks for {count} splats, expected {-(-count // CHUNK)}; {_REMEDY}"
        )
    degree = 0
    if "sh" in rows:
        degrees = {3 * harmonics_above_dc(d): d for d in range(1, MAX_DEGREE + 1)}
        held = len(rows["sh"].names or ())
        if held not in degrees or counts["sh"] != count:
            raise SplatFileError(
                f"{path}: {held} harmonics of {counts['sh']} splats; expected "
                f"{', '.join(map(str, degrees))} of {count}; {_REMEDY}"
            )
        degree = degrees[held]
        _check_row(path, "sh", rows["sh"], ply.numbered("f_rest", held), "u1")
    known = {"chunk": {*_POSITIONS, *_SCALES, *_COLORS}, "vertex": {*_PACKED}}
    unused = [f"element {name}" for name in rows if name not in ("chunk", "vertex", "sh")]
    unused += [
        f"property {name} of element {element}"
        for element, names in known.items()
        for name in rows[element].names or ()
        if name not in names
    ]
    mode = ply.render_mode(lines)
    unused += ply.unknown_mode(mode)
    return Layout(count, degree, rows, starts, size, mode == ply.ANTIALIASED_MODE, tuple(unused))


def _elements(path: Path, lines: list[list[str]]) -> list[tuple[str, int, list[tuple[str, str]]]]:
    """Name, number of rows, names and types of the properties of each element. Raises SplatFileError."""
    elements: list[tuple[str, int, list[tuple[str, str]]]] = []
    for words in lines[1:]:
        text = " ".join(words)
        if words[:1] == ["format"] and text != ply.FORMAT:
            raise SplatFileError(f"{path}: expected {ply.FORMAT!r}, found {text!r}; {_REMEDY}")
        if words[:1] == ["element"]:
            known = [name for name, _, _ in elements]
            if len(words) != 3 or words[1] in known or not words[2].isdecimal() or len(words[2]) > 12:
                raise SplatFileError(f"{path}: expected 'element NAME COUNT', found {text!r}; {_REMEDY}")
            elements.append((words[1], int(words[2]), []))
        elif words[:1] == ["property"] and elements:
            columns = elements[-1][2]
            if len(words) != 3 or words[1] not in ply.TYPES or words[2] in dict(columns):
                raise SplatFileError(f"{path}: {text!r} is not a property that a splat has; {_REMEDY}")
            columns.append((words[2], ply.TYPES[words[1]]))
    return elements


def _check_row(path: Path, element: str, row: np.dtype | None, needed: tuple[str, ...], kind: str) -> None:
    """Raises SplatFileError for a property that is missing, or of another type."""
    for name in needed:
        found = row[name] if row is not None and name in (row.names or ()) else None
        if found != np.dtype(kind):
            what = "is missing" if found is None else f"is of type {found}, expected {np.dtype(kind)}"
            raise SplatFileError(f"{path}: property {name!r} of element {element!r} {what}; {_REMEDY}")


def _element(path: Path, layout: Layout, name: str) -> np.ndarray:
    """Rows of an element."""
    count = -(-layout.count // CHUNK) if name == "chunk" else layout.count
    return np.memmap(path, layout.rows[name], "r", layout.starts[name], (count,))


def _parts(words: np.ndarray, *bits: int) -> np.ndarray:
    """[M, parts] float64, 0 to 1: fields of [M] uint32, the first at the top."""
    shift, columns = 32, []
    for width in bits:
        shift -= width
        most = (1 << width) - 1
        columns.append(((words >> np.uint32(shift)) & np.uint32(most)) / most)
    return np.column_stack(columns)


def _between(chunks: np.ndarray, names: tuple[str, ...] | None, parts: np.ndarray) -> np.ndarray:
    """[M, 3] float32: parts of the way from the lowest to the highest value of each splat's chunk."""
    if names is None:
        return parts.astype(np.float32)
    ends = np.column_stack([chunks[name] for name in names]).astype(np.float64)
    ends = np.repeat(ends, CHUNK, axis=0)[: len(parts)]
    with np.errstate(
        invalid="ignore", over="ignore"
    ):  # ranges that are not finite are refused by what comes of them
        return (ends[:, :3] * (1 - parts) + ends[:, 3:] * parts).astype(np.float32)


def _rotations(words: np.ndarray) -> np.ndarray:
    """[M] uint32 -> [M, 4] w-x-y-z."""
    largest = (words >> np.uint32(30)).astype(np.int64)
    others = (_parts(words & np.uint32((1 << 30) - 1), 2, 10, 10, 10)[:, 1:] - 0.5) * _SQRT2
    wxyz = np.empty((len(words), 4))
    wxyz[np.arange(4) != largest[:, None]] = others.reshape(-1)
    missing = np.sqrt(np.maximum(1 - (others**2).sum(1), 0))
    np.put_along_axis(wxyz, largest[:, None], missing[:, None], 1)
    return wxyz.astype(np.float32)


def _harmonics(path: Path, layout: Layout) -> np.ndarray:
    """[M, K, 3] float32."""
    count, coefficients = layout.count, harmonics_above_dc(layout.degree)
    if not coefficients:
        return np.zeros((count, 0, 3), np.float32)
    rows = _element(path, layout, "sh")
    steps = np.column_stack([rows[name] for name in ply.numbered("f_rest", 3 * coefficients)])
    values = (np.arange(256) + 0.5) / 128 * _HARMONIC_RANGE - _HARMONIC_RANGE
    values[[0, 255]] = -_HARMONIC_RANGE, _HARMONIC_RANGE
    return np.ascontiguousarray(values.astype(np.float32)[steps].reshape(count, 3, -1).transpose(0, 2, 1))
