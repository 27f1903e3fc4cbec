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

Little endian, in this order. The reader takes properties in any order and ignores others (and elements after the
vertices); what it needs must be there, in single or double precision, finite, and as many rows as the header promises.
Harmonics of degree 4 are left out. Text is read by `ply_text`, SuperSplat's packed layout by `ply_compressed`.
"""

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from compgs.errors import SplatFileError
from compgs.formats.arrays import (
    FLAT_LOG_SCALE,
    MAX_DEGREE,
    MAX_LOG_SCALE,
    MOST_DEGREE_HELD,
    SplatArrays,
    harmonics_above_dc,
)
from compgs.outputs import check_output_file, write_bytes

MAX_HEADER_BYTES = 1 << 16
FORMAT = "format binary_little_endian 1.0"
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
class PlyHeader:
    """What a file's header promises, checked against its size."""

    count: int  # splats
    degree: int  # of the spherical harmonics
    row: np.dtype  # of a vertex
    start: int  # bytes before the first vertex
    bytes: int  # of the whole file
    held_degree: int  # of the harmonics in the file, which may be more than are read


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
    return _header_text(len(arrays), names) + table.tobytes()


def ply_size(count: int, degree: int) -> int:
    """Bytes of a file of so many splats."""
    names = [name for group in property_groups(degree).values() for name in group]
    return len(_header_text(count, names)) + 4 * len(names) * count


def _header_text(count: int, names: list[str]) -> bytes:
    lines = ["ply", FORMAT, f"element vertex {count}", *(f"property float {name}" for name in names)]
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
    """From the vertices, a structured array [count]. Raises SplatFileError."""
    groups = property_groups(header.held_degree)

    def values(group: str) -> np.ndarray:
        names = groups[group]
        array = np.empty((header.count, len(names)), np.float32)
        with np.errstate(over="ignore"):  # a double that is too large becomes infinite, and is refused
            for i, name in enumerate(names):
                if name not in (header.row.names or ()):  # only the third scale may be missing
                    array[:, i] = FLAT_LOG_SCALE
                    continue
                array[:, i] = table[name]
                _check_numbers(path, name, array[:, i])
        return array

    log_scales, quaternions = values("scales"), values("rotations")
    zero = np.flatnonzero(~quaternions.any(1))
    if len(zero):
        raise SplatFileError(
            f"{path}: rot_0 to rot_3 of splat {zero[0]} are all zero, which is no rotation; {_REMEDY}"
        )
    harmonics = values("harmonics").reshape(header.count, 3, harmonics_above_dc(header.held_degree))
    kept = harmonics[:, :, : harmonics_above_dc(header.degree)]
    return SplatArrays(
        means=values("positions"),
        log_scales=log_scales,
        quaternions=quaternions,
        opacity_logits=values("opacities")[:, 0].copy(),
        dc=values("colors"),
        rest=np.ascontiguousarray(kept.transpose(0, 2, 1)),
    )


def component_bytes(path: Path) -> dict[str, int]:
    """Bytes of each component of a file; they sum to its size."""
    return component_bytes_of(read_ply_header(path))


def component_bytes_of(header: PlyHeader) -> dict[str, int]:
    """Of a file whose vertices are stored as rows; what is left of it is the header's."""
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
    lines, start, size = header_lines(path)
    count, columns, others = vertices(path, lines)
    row = np.dtype(columns)
    held = degree_held(path, row)
    promised = start + count * row.itemsize
    if size < promised or (size > promised and not others):
        raise SplatFileError(
            f"{path}: {count} splats of {row.itemsize} bytes are {promised} bytes with the header, "
            f"the file has {size}; copy it again"
        )
    return PlyHeader(count, min(held, MAX_DEGREE), row, start, size, held)


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


def vertices(
    path: Path, lines: list[list[str]], expected: str = FORMAT
) -> tuple[int, list[tuple[str, str]], bool]:
    """Number of vertices, names and types of their properties, and whether other elements follow.

    Raises SplatFileError for a header that says otherwise than a file of splats, or no splats.
    """
    count, columns, element, others = -1, [], "", False
    for words in lines[1:]:
        if words[:1] == ["format"] and " ".join(words) != expected:
            raise SplatFileError(f"{path}: expected {expected!r}, found {' '.join(words)!r}; {_REMEDY}")
        if words[:1] == ["element"]:
            element = words[1] if len(words) == 3 else ""
            if count < 0 and not (element == "vertex" and words[2].isdecimal() and len(words[2]) <= 12):
                raise SplatFileError(
                    f"{path}: expected 'element vertex COUNT' first, found {' '.join(words)!r}; {_REMEDY}"
                )
            others = others or element != "vertex"
            count = int(words[2]) if count < 0 else count
        elif words[:1] == ["property"] and element == "vertex":
            if len(words) != 3 or words[1] not in TYPES:
                raise SplatFileError(
                    f"{path}: {' '.join(words)!r} is not a property that a splat has; {_REMEDY}"
                )
            columns.append((words[2], TYPES[words[1]]))
    names = [name for name, _ in columns]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise SplatFileError(f"{path}: property {twice!r} is there twice; {_REMEDY}")
    if count < 0:
        raise SplatFileError(f"{path}: the header has no vertices; {_REMEDY}")
    if count == 0:
        raise SplatFileError(f"{path}: holds no splats")
    return count, columns, others


def degree_held(path: Path, row: np.dtype) -> int:
    """Of the harmonics, 0 to 4, from the number of f_rest; every property that is needed must be there."""
    found = set(row.names or ())
    held = sum(name.startswith("f_rest_") for name in found)
    degrees = {3 * harmonics_above_dc(d): d for d in range(MOST_DEGREE_HELD + 1)}
    if held not in degrees:
        raise SplatFileError(
            f"{path}: {held} properties f_rest_*; expected {', '.join(map(str, degrees))} "
            f"(degree 0 to {MOST_DEGREE_HELD})"
        )
    groups = property_groups(degrees[held])
    for group, names in groups.items():
        for name in names:
            if group == "normals" or (name == THIRD_SCALE and name not in found):
                continue
            if name not in found:
                hint = "these are points, not splats" if "f_dc_0" not in found else _REMEDY
                raise SplatFileError(f"{path}: property {name!r} is missing; {hint}")
            if row[name].kind != "f":
                raise SplatFileError(
                    f"{path}: property {name!r} is of type {row[name]}, expected float or double"
                )
    return degrees[held]


def _check_numbers(path: Path, name: str, column: np.ndarray) -> None:
    bad = ~np.isfinite(column)
    if name.startswith("scale_"):
        bad |= column > MAX_LOG_SCALE
    if bad.any():
        first = int(np.argmax(bad))
        legal = f"a finite number up to {MAX_LOG_SCALE:g}" if name.startswith("scale_") else "a finite number"
        raise SplatFileError(
            f"{path}: {name} of splat {first} is {column[first]}, expected {legal}; {_REMEDY}"
        )
