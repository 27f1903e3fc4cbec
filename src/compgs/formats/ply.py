"""Splats as a .ply file in the layout of 3DGS (Kerbl et al. 2023): one element `vertex`, all properties float32.

| properties | what |
|---|---|
| x y z | mean, world coordinates in single precision: what other programs expect |
| nx ny nz | normals, zero: nothing uses them, some programs expect them |
| f_dc_0 ... 2 | harmonic coefficients of degree 0: red, green, blue |
| f_rest_0 ... | of degrees 1 to 3, channel by channel: all of red (3, 8 or 15), all of green, all of blue |
| opacity | logit of the opacity |
| scale_0 ... 2 | log of the standard deviations, world units; 2DGS has two, its splats are flat |
| rot_0 ... 3 | quaternion w-x-y-z, not normalized |

Little endian, in this order; the reader takes big endian, too. `comment SplatRenderMode: mip` in the header (Brush)
says that the splats are antialiased; the reader takes `comment antialiased 1` (Postshot), too.

The reader takes properties in any order; what it needs must be there, in single or double precision, and as many rows
as the header promises. In place of f_dc it takes red, green, blue (nerfstudio), and with them `filter_3D`
(Mip-Splatting): the width of a smoothing filter that widens a splat and dilutes its opacity. What it does not use,
harmonics of degree 4, other properties and elements, is named in a note. Text is read by `ply_text`,
SuperSplat's packed layout by `ply_compressed`.
"""

import os
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from compgs.errors import SplatFileError
from compgs.formats.arrays import (
    COLOR_OFFSET,
    FLAT_LOG_SCALE,
    MAX_DEGREE,
    MOST_DEGREE_HELD,
    Y0,
    SplatArrays,
    drawable,
    harmonics_above_dc,
    logit,
)
from compgs.notes import note
from compgs.outputs import check_output_file, write_bytes

MAX_HEADER_BYTES = 1 << 16
FORMAT = "format binary_little_endian 1.0"
BIG_ENDIAN = "format binary_big_endian 1.0"  # is read, too
TYPES = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "<i2"),
    **dict.fromkeys(("ushort", "uint16"), "<u2"),
    **dict.fromkeys(("int", "int32"), "<i4"),
    **dict.fromkeys(("uint", "uint32"), "<u4"),
    **dict.fromkeys(("float", "float32"), "<f4"),
    **dict.fromkeys(("double", "float64"), "<f8"),
}
THIRD_SCALE = "scale_2"  # which the flat splats of 2DGS lack
_REMEDY = "export the scene again as an uncompressed 3DGS .ply"
# Of `comment SplatRenderMode`; splats of any other mode are drawn as plain ones.
PLAIN_MODE, ANTIALIASED_MODE = "default", "mip"
# In place of harmonics of degree 0: bytes, or numbers from 0 to 1.
_DISPLAY_COLORS = ("red", "green", "blue")
_BRIGHTEST = 2.0  # of colors from 0 to 1; floating-point colors above it are parts of 255
_FILTER = "filter_3D"
# Of viewers of points; what they say is elsewhere in the file, or nowhere used.
_FOR_POINTS = ("nx", "ny", "nz", *_DISPLAY_COLORS, "alpha")


def numbered(name: str, count: int) -> tuple[str, ...]:
    """`scale_0`, `scale_1`, `scale_2`."""
    return tuple(f"{name}_{i}" for i in range(count))


def property_groups(degree: int) -> dict[str, tuple[str, ...]]:
    """Properties in the order of the file, by what they are."""
    return {
        "positions": ("x", "y", "z"),
        "normals": ("nx", "ny", "nz"),
        "colors": numbered("f_dc", 3),
        "harmonics": numbered("f_rest", 3 * harmonics_above_dc(degree)),
        "opacities": ("opacity",),
        "scales": numbered("scale", 3),
        "rotations": numbered("rot", 4),
    }


@dataclass(frozen=True)
class Before:
    """Elements before the vertices."""

    elements: int
    bytes: int  # in a binary file
    numbers: int  # in a file of text


@dataclass(frozen=True)
class PlyHeader:
    """What a file's header promises, checked against its size."""

    count: int  # splats
    degree: int  # of the spherical harmonics
    row: np.dtype  # of a vertex
    start: int  # bytes before the first vertex; of a file of text, before all elements
    bytes: int  # of the whole file
    held_degree: int  # of the harmonics in the file, which may be more than are read
    mode: str  # in which the splats are drawn
    others: tuple[str, ...]  # elements beside the vertices
    before: Before


# writing -----------------------------------------------------------------------------------------------------------


def write_ply(splats: SplatArrays, path: str | Path, *, overwrite: bool = False) -> int:
    """Write splats, whole or not at all; the number of bytes. Raises OutputError.

    Positions in the file are world coordinates, `means + world_offset`, as float32, for that is what other programs
    expect: of a scene 4 000 km from its origin they are whole multiples of 0.25 to 0.5 m.
    """
    data = encoded(splats)
    check_output_file(Path(path), overwrite=overwrite, needed_bytes=len(data))
    write_bytes(Path(path), data)
    return len(data)


def encoded(arrays: SplatArrays) -> bytes:
    """The content of the file; see `write_ply`."""
    means = arrays.means
    if any(arrays.world_offset):
        means = means.astype(np.float64) + np.array(arrays.world_offset)
    names = [name for group in property_groups(arrays.degree).values() for name in group]
    table = np.zeros((len(arrays), len(names)), "<f4")
    groups = property_groups(arrays.degree)
    content = {
        "positions": means,
        "colors": arrays.dc,
        "harmonics": arrays.rest.transpose(0, 2, 1).reshape(len(arrays), -1),
        "opacities": arrays.opacity_logits[:, None],
        "scales": arrays.log_scales,
        "rotations": arrays.quaternions,
    }
    for group, values in content.items():
        first = names.index(groups[group][0]) if groups[group] else 0
        table[:, first : first + len(groups[group])] = values
    return _header_text(len(arrays), names, antialiased=arrays.antialiased) + table.tobytes()


def ply_size(count: int, degree: int) -> int:
    """Bytes of a file of so many splats."""
    names = [name for group in property_groups(degree).values() for name in group]
    return len(_header_text(count, names)) + 4 * len(names) * count


def _header_text(count: int, names: list[str], *, antialiased: bool = False) -> bytes:
    comments = [f"comment SplatRenderMode: {ANTIALIASED_MODE}"] if antialiased else []
    properties = (f"property float {name}" for name in names)
    lines = ["ply", FORMAT, *comments, f"element vertex {count}", *properties]
    return ("\n".join([*lines, "end_header"]) + "\n").encode("ascii")


# reading -----------------------------------------------------------------------------------------------------------


def begins(head: bytes) -> bool:
    """Whether a file begins as a .ply does."""
    return head.startswith((b"ply\n", b"ply\r\n"))


def check(path: Path) -> None:
    """Raises SplatFileError for what can be known without reading the splats."""
    read_ply_header(path)


def read_ply(path: str | Path) -> SplatArrays:
    """Inverse of `write_ply`. Raises SplatFileError, naming the first thing that is wrong."""
    return read(Path(path))


def read(path: Path) -> SplatArrays:
    """Raises SplatFileError."""
    header = read_ply_header(path)
    return splats_of(path, header, np.memmap(path, header.row, "r", header.start, (header.count,)))


def splats_of(path: Path, header: PlyHeader, table: np.ndarray) -> SplatArrays:
    """Read splats from the vertices, a structured array [count]. Raises SplatFileError where most of them cannot be
    drawn.
    """
    groups = property_groups(header.held_degree)
    held = header.row.names or ()

    def values(names: tuple[str, ...]) -> np.ndarray:
        array = np.empty((header.count, len(names)), np.float32)
        with np.errstate(over="ignore"):  # a double that is too large becomes infinite
            for i, name in enumerate(names):
                # Only the third scale may be missing.
                array[:, i] = table[name] if name in held else FLAT_LOG_SCALE
        return array

    harmonics = values(groups["harmonics"]).reshape(header.count, 3, harmonics_above_dc(header.held_degree))
    kept = harmonics[:, :, : harmonics_above_dc(header.degree)]
    displayed = groups["colors"][0] not in held
    found = SplatArrays(
        means=values(groups["positions"]),
        log_scales=values(groups["scales"]),
        quaternions=values(groups["rotations"]),
        opacity_logits=values(groups["opacities"])[:, 0].copy(),
        dc=_coefficients(header, values(_DISPLAY_COLORS)) if displayed else values(groups["colors"]),
        rest=np.ascontiguousarray(kept.transpose(0, 2, 1)),
        antialiased=header.mode == ANTIALIASED_MODE,
    )
    if _FILTER in held:
        found = _smoothed(found, values((_FILTER,)))
    _tell_unused(path, header)
    return drawable(path, found)


def unknown_mode(mode: str) -> list[str]:
    """What to tell of a mode of drawing that is not known here; nothing of one that is."""
    return (
        []
        if mode in (PLAIN_MODE, ANTIALIASED_MODE)
        else [f"SplatRenderMode {mode:.40} (drawn as plain splats)"]
    )


def _coefficients(header: PlyHeader, colors: np.ndarray) -> np.ndarray:
    """Harmonics of degree 0 [M, 3] of display colors [M, 3]: parts of the largest integer, or of one."""
    kind = header.row[_DISPLAY_COLORS[0]]
    whole = np.iinfo(kind).max if kind.kind in "iu" else 1
    if whole == 1 and np.fmax.reduce(colors, axis=None) > _BRIGHTEST:
        whole = np.iinfo(np.uint8).max
    return ((colors / np.float32(whole) - np.float32(COLOR_OFFSET)) / np.float32(Y0)).astype(np.float32)


def _smoothed(arrays: SplatArrays, widths: np.ndarray) -> SplatArrays:
    """Splats convolved with a Gaussian of their own width [M, 1] in world units (Yu et al. 2024, Mip-Splatting, Eq. 9):

        scale' = sqrt(scale^2 + width^2),  opacity' = opacity * product of scale / scale'

    Who writes such widths renders antialiased.
    """
    before = arrays.log_scales.astype(np.float64)
    with np.errstate(divide="ignore", invalid="ignore"):  # no width leaves a splat as it is
        after = np.logaddexp(2 * before, 2 * np.log(np.abs(widths.astype(np.float64)))) / 2
        share = np.exp((before - after).sum(1))
    changed = (widths[:, 0] != 0) & np.isfinite(share)
    return replace(
        arrays,
        log_scales=after.astype(np.float32),
        opacity_logits=np.where(changed, logit(arrays.opacities * share), arrays.opacity_logits),
        antialiased=True,
    )


def _tell_unused(path: Path, header: PlyHeader) -> None:
    """A note of what the header names and nothing here uses."""
    used = {name for group in property_groups(header.held_degree).values() for name in group}
    others = [name for name in header.row.names or () if name not in {*used, *_FOR_POINTS, _FILTER}]
    parts = [
        f"{kind} {', '.join(names)}"
        for kind, names in (("properties", others), ("elements", header.others))
        if names
    ]
    parts += unknown_mode(header.mode)
    if header.held_degree > header.degree:
        parts.insert(0, f"harmonics of degree {header.held_degree}")
    if parts:
        note(path, f"not used: {'; '.join(parts)}")


def component_bytes(path: Path) -> dict[str, int]:
    """Bytes of each component of a file; they sum to its size."""
    return component_bytes_of(read_ply_header(path))


def component_bytes_of(header: PlyHeader) -> dict[str, int]:
    """Count the bytes by component of a file whose vertices are stored as rows; what is left of it is the header's."""
    names = header.row.names or ()
    groups = {name: group for group, held in property_groups(header.held_degree).items() for name in held}
    sizes = dict.fromkeys(dict.fromkeys(["header", *(groups.get(name, "others") for name in names)]), 0)
    for name in names:
        sizes[groups.get(name, "others")] += header.count * header.row[name].itemsize
    sizes["header"] = header.bytes - sum(sizes.values())
    return sizes


def read_ply_header(path: str | Path) -> PlyHeader:
    """Everything that can be known without reading the splats. Raises SplatFileError."""
    path = Path(path)
    header = described(path, FORMAT, BIG_ENDIAN)
    header = replace(header, start=header.start + header.before.bytes)
    promised = header.start + header.count * header.row.itemsize
    if header.bytes < promised or (header.bytes > promised and len(header.others) == header.before.elements):
        raise SplatFileError(
            f"{path}: {header.count} splats of {header.row.itemsize} bytes are {promised} bytes with the header, "
            f"the file has {header.bytes}; copy it again"
        )
    return header


def described(path: Path, *expected: str) -> PlyHeader:
    """What a header says of splats, in a file of one of the formats that are expected. Raises SplatFileError."""
    lines, start, size = header_lines(path)
    elements = _elements(path, lines, expected)
    place = next((i for i, element in enumerate(elements) if element.name == "vertex"), None)
    if place is None:
        raise SplatFileError(f"{path}: the header has no vertices; {_REMEDY}")
    before, vertex = elements[:place], elements[place]
    for element in (*before, vertex):
        if element.other is not None:
            raise SplatFileError(
                f"{path}: {element.other!r} is not a property that a splat has, nor one of {element.name!r} before "
                f"them; {_REMEDY}"
            )
    names = [name for name, _ in vertex.columns]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise SplatFileError(f"{path}: property {twice!r} is there twice; {_REMEDY}")
    if vertex.count == 0:
        raise SplatFileError(f"{path}: holds no splats")
    row = np.dtype(vertex.columns)
    if BIG_ENDIAN.split() in lines:
        row = row.newbyteorder(">")
    held = degree_held(path, row)
    others = tuple(element.name for element in elements if element is not vertex)
    return PlyHeader(
        vertex.count,
        min(held, MAX_DEGREE),
        row,
        start,
        size,
        held,
        render_mode(lines),
        others,
        Before(
            len(before),
            sum(element.bytes for element in before),
            sum(element.count * len(element.columns) for element in before),
        ),
    )


def render_mode(lines: list[list[str]]) -> str:
    """What comments say of how the splats are drawn, in Brush's words; the last one counts."""
    found = PLAIN_MODE
    for words in lines:
        match [word.lower() for word in words]:
            case ["comment", "splatrendermode:", mode]:
                found = mode
            case ["comment", "antialiased", ("0" | "1") as digit]:
                found = ANTIALIASED_MODE if digit == "1" else PLAIN_MODE
    return found


def header_lines(path: Path) -> tuple[list[list[str]], int, int]:
    """Words of the header's lines, bytes before the first vertex and of the whole file. Raises SplatFileError."""
    try:
        size = os.path.getsize(path)
        with open(path, "rb") as file:
            begin = file.read(MAX_HEADER_BYTES)
    except OSError as error:
        raise SplatFileError(f"{path}: cannot be read ({error.strerror or error})") from error
    end = begin.find(b"end_header")
    newline = begin.find(b"\n", end)
    if not begins(begin):
        raise SplatFileError(f"{path}: does not begin as a .ply file does")
    if (end < 0 or newline < 0) and size <= len(begin):
        raise SplatFileError(f"{path}: ends after {size} bytes, within its header; copy it again")
    if end < 0 or newline < 0:
        raise SplatFileError(f"{path}: the header does not end within {MAX_HEADER_BYTES} bytes")
    lines = begin[:end].decode("ascii", errors="replace").split("\n")
    return [line.split() for line in lines], newline + 1, size


@dataclass(frozen=True)
class _Element:
    """What a header says of one element."""

    name: str
    count: int
    columns: list[tuple[str, str]]  # names and types of its properties
    other: str | None  # the first line of it that is no such property

    @property
    def bytes(self) -> int:
        return self.count * sum(np.dtype(kind).itemsize for _, kind in self.columns)


def _elements(path: Path, lines: list[list[str]], expected: tuple[str, ...]) -> list[_Element]:
    """Return the elements in the file's order. Raises SplatFileError for a format that is not `expected`."""
    found: list[_Element] = []
    for words in lines[1:]:
        text = " ".join(words)
        if words[:1] == ["format"] and text not in expected:
            raise SplatFileError(f"{path}: expected {expected[0]!r}, found {text!r}; {_REMEDY}")
        if words[:1] == ["element"]:
            if len(words) != 3 or not words[2].isdecimal() or len(words[2]) > 12:
                raise SplatFileError(f"{path}: expected 'element vertex COUNT', found {text!r}; {_REMEDY}")
            found.append(_Element(words[1], int(words[2]), [], None))
        elif words[:1] == ["property"] and found:
            if len(words) == 3 and words[1] in TYPES:
                found[-1].columns.append((words[2], TYPES[words[1]]))
            elif found[-1].other is None:
                found[-1] = replace(found[-1], other=text)
    return found


def degree_held(path: Path, row: np.dtype) -> int:
    """Return the degree of the harmonics, 0 to 4, from the number of f_rest; every property that is needed must be
    there.
    """
    found = set(row.names or ())
    held = sum(name.startswith("f_rest_") for name in found)
    degrees = {3 * harmonics_above_dc(d): d for d in range(MOST_DEGREE_HELD + 1)}
    if held not in degrees:
        raise SplatFileError(
            f"{path}: {held} properties f_rest_*; expected {', '.join(map(str, degrees))} "
            f"(degree 0 to {MOST_DEGREE_HELD})"
        )
    groups = property_groups(degrees[held])
    if found.issuperset(_DISPLAY_COLORS) and found.isdisjoint(groups["colors"]):
        groups["colors"] = _DISPLAY_COLORS
    needed = [name for group, names in groups.items() if group != "normals" for name in names]
    missing = [name for name in needed if name not in found]
    if missing not in ([], [THIRD_SCALE]):
        raise SplatFileError(f"{path}: {_what_is_missing(groups, missing)}")
    for name in needed:
        if name in found and name not in _DISPLAY_COLORS and row[name].kind != "f":
            raise SplatFileError(
                f"{path}: property {name!r} is of type {row[name]}, expected float or double"
            )
    return degrees[held]


def _what_is_missing(groups: dict[str, tuple[str, ...]], missing: list[str]) -> str:
    """Say what is missing, with a remedy for what the file seems to be."""
    shape = {*groups["opacities"], *groups["scales"], *groups["rotations"]}
    if shape <= set(missing):
        return f"property {missing[0]!r} is missing: these are points, not splats"
    if set(groups["colors"]) <= set(missing):
        return (
            f"its splats have no colors: expected properties {', '.join(groups['colors'])}, or "
            f"{', '.join(_DISPLAY_COLORS)}; {_REMEDY}, with colors"
        )
    return f"property {missing[0]!r} is missing; {_REMEDY}"
