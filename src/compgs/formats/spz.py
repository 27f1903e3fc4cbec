"""Splats as an .spz file (Niantic): quantized columns, compressed; about a tenth of a .ply.

    version 1 to 3  gzip( header | columns ), or the same without gzip
    version 4       header | extensions | table | columns, each a Zstandard frame

| header field | bytes | what |
|---|---|---|
| magic | 4 | "NGSP" |
| version | 4 | 1 to 4 |
| count | 4 | splats |
| degree | 1 | of the harmonics, 0 to 4, of which degree 4 is left out here |
| fractional bits | 1 | of positions |
| flags | 1 | 1: antialiased (`SplatArrays.antialiased`); 2: extensions are there |
| streams | 1 | columns in the table; 0 before version 4 |
| table offset | 4 | version 4 only, then 12 bytes of zero; an entry is two uint64: packed, unpacked bytes |

| column | bytes a splat | value |
|---|---|---|
| positions | 9 | signed 24 bits / 2^fractional bits |
| | 6 | version 1: float16 |
| opacities | 1 | / 255 |
| colors | 3 | coefficient of degree 0 = (byte / 255 - 1/2) / 0.15 |
| scales | 3 | log scale = byte / 16 - 10 |
| rotations | 4 | x-y-z-w without the largest, each a sign and 9 bits of 1/sqrt(2); at the top 2 bits: which |
| | 3 | versions 1 and 2: x, y, z = byte / 127.5 - 1, w >= 0 |
| harmonics | 9, 24, 45, 72 | (byte - 128) / 128; coefficient by coefficient, red green blue |

An extension is a uint32 that says which, a uint32 that says how many bytes follow, and these. 0xADBE0003 holds a
uint32, 1 to 16: the axes of the file (`AXES`). Others, as 0xADBE0002 (how far a viewer may go), change no picture from
a given place; they are named in a note. Before version 4 extensions follow the columns.

Little endian. Axes are right, up, back where no extension says otherwise. There is no place for where positions count
from: they are written as they are, in the model's own frame.
"""

import gzip
import struct
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from compgs.errors import MissingDependency, SplatFileError, install_line
from compgs.formats.arrays import (
    MAX_DEGREE,
    MOST_DEGREE_HELD,
    SplatArrays,
    check_count,
    drawable,
    harmonics_above_dc,
    logit,
    normalized,
)
from compgs.formats.frames import RIGHT_UP_BACK, from_axes, turned
from compgs.notes import note

MAGIC = b"NGSP"
GZIP_MAGIC = b"\x1f\x8b"
VERSIONS = (1, 2, 3, 4)
WRITTEN_VERSIONS = (3, 4)
ANTIALIASED, HAS_EXTENSIONS = 1, 2  # flags
KNOWN_FLAGS = ANTIALIASED | HAS_EXTENSIONS
COORDINATE_SYSTEM = 0xADBE0003  # an extension
# By its value: where x, y and z point to.
AXES = (
    "LDB", "RDB", "LUB", "RUB", "LDF", "RDF", "LUF", "RUF", "LFD", "RFD", "LFU", "RFU", "LBD", "RBD", "LBU", "RBU",
)  # fmt: skip
USUAL_AXES = "RUB"
_HEADER = struct.Struct("<4sIIBBBB")
_LONG_HEADER = struct.Struct("<4sIIBBBBI12x")
_TABLE_ENTRY = struct.Struct("<QQ")
_EXTENSION = struct.Struct("<II")
_MOST_EXTENSION_BYTES = 1 << 20

COLOR_SCALE = 0.15
SCALE_STEPS, SCALE_START = 16.0, -10.0
POSITION_LIMIT = (1 << 23) - 1  # of 24 bits with a sign
MOST_FRACTIONAL_BITS = 24
# Positions are as fine as this part of the median splat: farther digits are noise that costs bytes.
STEP_OF_SCALE = 1 / 16
# Positions may be this many bits coarser before splats are left out for them.
SPARE_BITS = 1
# Of all splats, one at least, that may be left out: a capture that reaches far has more of them than floaters.
MOST_FLOATERS = 1 / 500
FAINT = 1e-3  # of its distance from the middle: a smaller splat is a pixel at most in a picture of a thousand
# Kept bits of 8: the others are zero, which compresses. Of a baked scene 7 and 6 are 44 dB from it; 5 and 4, which
# other programs write, are 38 dB and three quarters of the bytes; 8 and 8 are 46 dB and 1.4 times the bytes.
HARMONIC_BITS = (7, 6)  # of degree 1; of degrees 2 and 3
_SQRT_HALF = 2**-0.5
_SMALLEST_THREE_STEPS = 511


@dataclass(frozen=True)
class SpzHeader:
    """What a file says of itself."""

    version: int
    count: int  # splats
    degree: int  # of the harmonics in the file, which may be more than are read
    fractional_bits: int
    flags: int
    streams: int
    table_offset: int  # bytes; of version 4

    @property
    def columns(self) -> dict[str, int]:
        """Bytes a splat of each column, in the order of the file."""
        return columns_of(self.version, self.degree)


def columns_of(version: int, degree: int) -> dict[str, int]:
    sizes = {"positions": 9, "opacities": 1, "colors": 3, "scales": 3, "rotations": 4}
    sizes |= {"rotations": 3} if version <= 2 else {}
    sizes |= {"positions": 6} if version == 1 else {}
    return {**sizes, "harmonics": 3 * harmonics_above_dc(degree)} if degree else sizes


# writing -----------------------------------------------------------------------------------------------------------


def encoded(arrays: SplatArrays, version: int = 3) -> bytes:
    """The content of a file of version 3 or 4. Raises MissingDependency (4, without a Zstandard module), SplatFileError
    for splats that lie too far from the origin for 24 bits."""
    assert version in WRITTEN_VERSIONS, version
    arrays = turned(without_floaters(arrays), RIGHT_UP_BACK)
    bits = fractional_bits(arrays)
    degree = arrays.degree
    flags = ANTIALIASED if arrays.antialiased else 0
    columns = [
        _packed_positions(arrays.means, bits),
        np.rint(255 * arrays.opacities),
        np.clip(np.rint(255 * (COLOR_SCALE * arrays.dc + 0.5)), 0, 255),
        np.clip(np.rint(SCALE_STEPS * (arrays.log_scales - SCALE_START)), 0, 255),
        _packed_rotations(arrays.quaternions),
        _packed_harmonics(arrays.rest),
    ][: len(columns_of(version, degree))]
    data = [column.astype(np.uint8).tobytes() for column in columns]
    if version < 4:
        header = _HEADER.pack(MAGIC, version, len(arrays), degree, bits, flags, 0)
        return gzip.compress(header + b"".join(data), compresslevel=9, mtime=0)
    compress = _zstandard()[0]
    packed = [compress(column) for column in data]
    size = _LONG_HEADER.size
    header = _LONG_HEADER.pack(MAGIC, version, len(arrays), degree, bits, flags, len(data), size)
    table = b"".join(_TABLE_ENTRY.pack(len(p), len(d)) for p, d in zip(packed, data, strict=True))
    return header + table + b"".join(packed)


def fractional_bits(arrays: SplatArrays) -> int:
    """Choose as many bits as the splats are fine, and their distance from the origin leaves. Raises SplatFileError."""
    reach = _reach(arrays).max()
    room = int(_room(reach))
    if room < 0:
        raise SplatFileError(
            f".spz: positions reach {reach:g} world units from the origin, its 24 bits at most {POSITION_LIMIT}; "
            "write .ply or .glb"
        )
    return max(0, min(_wanted_bits(arrays), room))


def without_floaters(arrays: SplatArrays) -> SplatArrays:
    """All but a few splats so far away that the others would lose their digits, and too small to be missed.

    One splat 100 000 units away leaves all positions in steps of 1/64 unit: 24 bits are shared by all.
    """
    reach = _reach(arrays)
    wanted, room = _wanted_bits(arrays), _room(reach)
    if room.min() >= wanted - SPARE_BITS:
        return arrays
    middle = np.median(arrays.means.astype(np.float64), axis=0)
    distances = np.linalg.norm(arrays.means - middle, axis=1)
    faint = np.exp(arrays.log_scales.max(1).astype(np.float64)) < FAINT * distances
    most = max(1, int(len(arrays) * MOST_FLOATERS))
    for bits in range(wanted, int(room.min()), -1):
        far = room < bits
        if far.sum() <= most and faint[far].all():
            return arrays.rows(~far)
    return arrays


def told(arrays: SplatArrays) -> str | None:
    """What becomes of splats that a file cannot hold as they are, in words; None: nothing that could be seen."""
    kept = without_floaters(arrays)
    farthest, reach = (_reach(splats).max() for splats in (arrays, kept))
    parts = []
    if left_out := len(arrays) - len(kept):
        steps = 2.0 ** -max(0, int(_room(farthest)))
        parts.append(
            f"without {left_out:,} of {len(arrays):,} splats: up to {farthest:g} world units from the origin, they "
            f"would leave all positions in steps of {steps:g}"
        )
    if 0 <= _room(reach) < _wanted_bits(kept) - SPARE_BITS:
        step = 2.0 ** -fractional_bits(kept)
        parts.append(
            f"positions are in steps of {step:g} world units, {step / _middle_scale(kept):.2g} times the size of a "
            f"splat: they reach {reach:g} units from the origin, and have 24 bits"
        )
    return f"{'; '.join(parts)}; .ply and .glb keep them as they are" if parts else None


def _reach(arrays: SplatArrays) -> np.ndarray:
    """[M] float64, world units: of each splat along the axis on which it is farthest from the origin."""
    return np.abs(arrays.means.astype(np.float64)).max(1)


def _room(reach: np.ndarray) -> np.ndarray:
    """Fractional bits that a position leaves, of the 24."""
    return np.minimum(np.floor(np.log2(POSITION_LIMIT / np.maximum(reach, 1e-30))), MOST_FRACTIONAL_BITS)


def _wanted_bits(arrays: SplatArrays) -> int:
    """Fractional, for positions that are as fine as the splats."""
    bits = int(np.ceil(-np.log2(STEP_OF_SCALE * _middle_scale(arrays))))
    return min(bits, MOST_FRACTIONAL_BITS)


def _middle_scale(arrays: SplatArrays) -> float:
    """World units: the middle one of a splat's extents, of the median splat."""
    return float(np.exp(np.median(np.sort(arrays.log_scales.astype(np.float64), axis=1)[:, 1])))


def _packed_positions(means: np.ndarray, bits: int) -> np.ndarray:
    whole = np.clip(np.rint(means.astype(np.float64) * 2.0**bits), -POSITION_LIMIT, POSITION_LIMIT)
    words = np.ascontiguousarray(whole.astype("<i4"))
    return words.view(np.uint8).reshape(len(means), 3, 4)[:, :, :3]


def _packed_rotations(quaternions: np.ndarray) -> np.ndarray:
    """[M, 4] bytes: the three smaller parts, as far as a sign and nine bits say them."""
    xyzw = np.roll(normalized(quaternions), -1, axis=1)
    largest = np.abs(xyzw).argmax(1)
    xyzw *= np.where(np.take_along_axis(xyzw, largest[:, None], 1) < 0, -1, 1)
    steps = np.minimum(
        np.floor(_SMALLEST_THREE_STEPS * np.abs(xyzw) / _SQRT_HALF + 0.5), _SMALLEST_THREE_STEPS
    )
    parts = steps.astype(np.uint32) | np.where(xyzw < 0, 1 << 9, 0).astype(np.uint32)
    words = largest.astype(np.uint32)
    for i in range(4):
        words = np.where(largest == i, words, (words << np.uint32(10)) | parts[:, i])
    return words.astype("<u4")[:, None].view(np.uint8)


def _packed_harmonics(rest: np.ndarray) -> np.ndarray:
    bits = np.where(np.arange(rest.shape[1]) < harmonics_above_dc(1), *HARMONIC_BITS)[:, None]
    step = 2.0 ** (8 - bits)
    # Whole steps of the byte, around its middle, so that zero stays zero.
    return np.clip(128 + step * np.rint(128 * rest / step), 0, 255)


# reading -----------------------------------------------------------------------------------------------------------


def begins(head: bytes) -> bool:
    """Whether a file begins as an .spz does; of a gzip file, its first bytes are unpacked."""
    if not head.startswith(GZIP_MAGIC):
        return head.startswith(MAGIC)
    try:
        return zlib.decompressobj(wbits=31).decompress(head, len(MAGIC)) == MAGIC
    except zlib.error:
        return False


def check(path: Path) -> None:
    """Raises SplatFileError for what can be known without unpacking the splats."""
    _header(path, path.read_bytes())


def read(path: Path) -> SplatArrays:
    """Raises SplatFileError, MissingDependency (version 4, without a Zstandard module)."""
    data = path.read_bytes()
    header = _header(path, data)
    unpacked = _long_columns if header.version == 4 else _gzip_columns
    columns, records = unpacked(path, header, data)
    axes = _axes(path, header, records)
    arrays = {
        name: np.frombuffer(column, np.uint8).reshape(header.count, -1)
        for name, column in zip(header.columns, columns, strict=True)
    }
    positions, rotations = arrays["positions"], arrays["rotations"]
    count, coefficients = header.count, harmonics_above_dc(header.degree)
    rest = arrays.get("harmonics", np.zeros((count, 0), np.uint8)).reshape(count, coefficients, 3)
    rest = rest[:, : harmonics_above_dc(MAX_DEGREE)]
    found = SplatArrays(
        means=_half_positions(positions)
        if header.version == 1
        else _positions(positions, header.fractional_bits),
        log_scales=arrays["scales"] / np.float32(SCALE_STEPS) + np.float32(SCALE_START),
        quaternions=_short_rotations(rotations) if header.version <= 2 else _rotations(rotations),
        opacity_logits=logit(arrays["opacities"][:, 0] / 255),
        dc=((arrays["colors"] / 255 - 0.5) / COLOR_SCALE).astype(np.float32),
        rest=(rest.astype(np.float32) - 128) / 128,
        antialiased=bool(header.flags & ANTIALIASED),
    )
    return from_axes(drawable(path, found), axes)


def _axes(path: Path, header: SpzHeader, records: bytes) -> str:
    """Return the axes of the file, by its extensions; what else they and the flags say is told."""
    axes, passed_over = USUAL_AXES, []
    if header.degree > MAX_DEGREE:
        passed_over.append(f"harmonics of degree {header.degree}")
    if unknown := header.flags & ~KNOWN_FLAGS:
        passed_over.append(f"flags {unknown:#x}")
    for kind, content in _extensions(path, records):
        if kind != COORDINATE_SYSTEM:
            passed_over.append(f"extension {kind:#010x} of {len(content)} bytes")
            continue
        number = int.from_bytes(content, "little")
        if not 1 <= number <= len(AXES):
            raise SplatFileError(f"{path}: axes number {number}; expected 1 to {len(AXES)}")
        axes = AXES[number - 1]
    if passed_over:
        note(path, f"not used: {', '.join(passed_over)}")
    return axes


def _extensions(path: Path, records: bytes) -> Iterator[tuple[int, bytes]]:
    """Which extension, and what it holds. Raises SplatFileError for records that are not whole."""
    place = 0
    while place < len(records):
        rest = records[place:]
        kind, size = _EXTENSION.unpack_from(rest) if len(rest) >= _EXTENSION.size else (0, len(rest))
        place += _EXTENSION.size + size
        if place > len(records):
            raise SplatFileError(
                f"{path}: an extension promises {size} bytes, {len(rest) - _EXTENSION.size} are there; copy it again"
            )
        yield kind, rest[_EXTENSION.size : _EXTENSION.size + size]


def component_bytes(path: Path) -> dict[str, int]:
    """Bytes of each component of a file; they sum to its size. Before version 4 all columns are one."""
    data = path.read_bytes()
    header = _header(path, data)
    if header.version < 4:
        return {"splats": len(data)}
    sizes = [packed for packed, _ in _table(path, header, data)]
    return {"header": len(data) - sum(sizes), **dict(zip(header.columns, sizes, strict=True))}


def _header(path: Path, data: bytes) -> SpzHeader:
    """Checked against the size of the file."""
    compressed = data.startswith(GZIP_MAGIC)
    long = not compressed and len(data) >= 8 and struct.unpack_from("<I", data, 4)[0] >= 4
    layout = _LONG_HEADER if long else _HEADER
    try:
        begin = (
            zlib.decompressobj(wbits=31).decompress(data, layout.size) if compressed else data[: layout.size]
        )
    except zlib.error as error:
        raise SplatFileError(f"{path}: is damaged ({error}); copy it again") from error
    if len(begin) < layout.size or not begin.startswith(MAGIC):
        raise SplatFileError(f"{path}: does not begin as an .spz file does, or ends within its header")
    header = SpzHeader(*(*layout.unpack(begin), 0)[1:8])
    if header.version not in VERSIONS or (header.version == 4 and compressed):
        kind = "inside gzip" if compressed else "outside gzip"
        raise SplatFileError(f"{path}: version {header.version} {kind}; expected 1 to 3, or 4 outside")
    if header.degree > MOST_DEGREE_HELD:
        raise SplatFileError(f"{path}: harmonics of degree {header.degree}; expected 0 to {MOST_DEGREE_HELD}")
    if header.fractional_bits > MOST_FRACTIONAL_BITS:
        raise SplatFileError(
            f"{path}: {header.fractional_bits} fractional bits; expected 0 to {MOST_FRACTIONAL_BITS}"
        )
    check_count(path, header.count, len(data))
    if header.version == 4:
        _table(path, header, data)
    return header


def _gzip_columns(path: Path, header: SpzHeader, data: bytes) -> tuple[list[bytes], bytes]:
    """And the extensions behind them."""
    sizes = [header.count * size for size in header.columns.values()]
    promised = _HEADER.size + sum(sizes)
    most = promised + (_MOST_EXTENSION_BYTES if header.flags & HAS_EXTENSIONS else 0)
    content, end, after = data, True, b""
    if data.startswith(GZIP_MAGIC):
        unpacker = zlib.decompressobj(wbits=31)
        try:
            # One byte more than there may be: a file that has more is not unpacked to its end.
            content = unpacker.decompress(data, most + 1)
        except zlib.error as error:
            raise SplatFileError(f"{path}: is damaged ({error}); copy it again") from error
        end, after = unpacker.eof, unpacker.unused_data
    if len(content) < promised or len(content) > most:
        found = f"more than {most}" if len(content) > most else str(len(content))
        unknown = header.flags & ~KNOWN_FLAGS
        remedy = (
            f"its flags {unknown:#x} are not known here: export it as plain splats"
            if unknown
            else "copy it again"
        )
        raise SplatFileError(
            f"{path}: {header.count} splats are {promised} bytes unpacked, the file holds {found}; {remedy}"
        )
    if not end:
        raise SplatFileError(f"{path}: its compressed data have no end; copy it again")
    if after:  # the data before them are whole: gzip ends with a checksum
        note(path, f"not used: {len(after)} bytes after the end of the compressed data")
    ends = _HEADER.size + np.cumsum(sizes)
    return [content[end - size : end] for end, size in zip(ends, sizes, strict=True)], content[promised:]


def _table(path: Path, header: SpzHeader, data: bytes) -> list[tuple[int, int]]:
    """Packed and unpacked bytes of each column, which together fill the file."""
    if header.streams != len(header.columns):
        raise SplatFileError(
            f"{path}: {header.streams} columns, expected {len(header.columns)} for degree {header.degree}"
        )
    first = header.table_offset + header.streams * _TABLE_ENTRY.size
    if header.table_offset < _LONG_HEADER.size or first > len(data):
        raise SplatFileError(
            f"{path}: its table is said to be at byte {header.table_offset}, outside the file"
        )
    table = list(_TABLE_ENTRY.iter_unpack(data[header.table_offset : first]))
    for (name, size), (_, unpacked) in zip(header.columns.items(), table, strict=True):
        if unpacked != header.count * size:
            raise SplatFileError(
                f"{path}: {name}: {unpacked} bytes, expected {header.count * size} for {header.count} splats"
            )
    end = first + sum(packed for packed, _ in table)
    if end != len(data):
        raise SplatFileError(
            f"{path}: its columns do not end where the file does, but at byte {end} of {len(data)}; copy it again"
        )
    return table


def _long_columns(path: Path, header: SpzHeader, data: bytes) -> tuple[list[bytes], bytes]:
    """And the extensions before them."""
    unpack = _zstandard()[1]
    table = _table(path, header, data)
    ends = len(data) - np.cumsum([packed for packed, _ in table[::-1]])[::-1]
    columns = []
    for name, start, (packed, unpacked) in zip(header.columns, ends, table, strict=True):
        try:
            column = unpack(data[start : start + packed], unpacked)
        except ValueError as error:
            raise SplatFileError(f"{path}: {name}: damaged ({error}); copy it again") from error
        if len(column) != unpacked:
            raise SplatFileError(f"{path}: {name}: {len(column)} bytes, expected {unpacked}; copy it again")
        columns.append(column)
    records = data[_LONG_HEADER.size : header.table_offset] if header.flags & HAS_EXTENSIONS else b""
    return columns, records


def _positions(columns: np.ndarray, bits: int) -> np.ndarray:
    """[M, 9] bytes -> [M, 3]."""
    words = np.zeros((len(columns), 3, 4), np.uint8)
    words[:, :, 1:] = columns.reshape(-1, 3, 3)  # the sign at the top, eight zeros at the bottom
    return ((words.view("<i4")[:, :, 0] >> 8) / 2.0**bits).astype(np.float32)


def _half_positions(columns: np.ndarray) -> np.ndarray:
    """[M, 6] bytes of version 1 -> [M, 3]."""
    return np.ascontiguousarray(columns).view("<f2").astype(np.float32)


def _rotations(columns: np.ndarray) -> np.ndarray:
    """[M, 4] bytes -> [M, 4] w-x-y-z."""
    words = np.ascontiguousarray(columns).view("<u4")[:, 0]
    largest = words >> np.uint32(30)
    xyzw = np.zeros((len(words), 4))
    for i in range(3, -1, -1):
        here = largest != i
        steps = (words & np.uint32(511)) / _SMALLEST_THREE_STEPS * _SQRT_HALF
        xyzw[:, i] = np.where(here, np.where(words & np.uint32(512), -steps, steps), 0)
        words = np.where(here, words >> np.uint32(10), words)
    missing = np.sqrt(np.maximum(1 - (xyzw**2).sum(1), 0))
    np.put_along_axis(xyzw, largest[:, None].astype(np.int64), missing[:, None], 1)
    return np.roll(xyzw, 1, axis=1).astype(np.float32)


def _short_rotations(columns: np.ndarray) -> np.ndarray:
    """[M, 3] bytes of versions 1 and 2 -> [M, 4] w-x-y-z."""
    xyz = columns / 127.5 - 1
    w = np.sqrt(np.maximum(1 - (xyz**2).sum(1), 0))
    return np.column_stack([w, xyz]).astype(np.float32)


def _zstandard() -> tuple[Callable[[bytes], bytes], Callable[[bytes, int], bytes]]:
    """compress(data), and unpack(data, most bytes), which raises ValueError. Raises MissingDependency."""
    try:
        import zstandard
    except ImportError:
        raise MissingDependency(
            f".spz of version 4 is compressed by Zstandard: {install_line('spz')}; version 3 needs nothing more"
        ) from None

    def unpack(data: bytes, most: int) -> bytes:
        reader: Any = zstandard.ZstdDecompressor(max_window_size=1 << 27).stream_reader(data)
        try:
            return bytes(reader.read(most + 1))
        except zstandard.ZstdError as error:
            raise ValueError(str(error)) from error

    return zstandard.ZstdCompressor(level=19).compress, unpack
