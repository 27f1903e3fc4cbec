"""The container of the methods of the comparison: arrays by name and a few facts, with the method's name inside.

| bytes | content |
|---|---|
| 8 | `GSPACKED` |
| 4 | bytes of the header as it is stored, little-endian |
| 4 | CRC-32 of these bytes |
| n | header: JSON, by DEFLATE |
| ... | the arrays, one after the other, to the end of the file |

The header has `version`, `method`, `facts` (by name: numbers and texts) and `arrays`: of each its name, type, shape,
how it is compressed (`raw`, `deflate`, `lzma`), its stored bytes and their CRC-32. Nothing is executed and nothing
unpickled; what an array unpacks to is known before it is unpacked, and no more is taken for it.
"""

import json
import lzma
import math
import re
import struct
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from compgs.devices import placed
from compgs.errors import SplatFileError
from compgs.formats.arrays import SplatArrays, drawable
from compgs.outputs import write_bytes

if TYPE_CHECKING:
    from compgs.devices import Device
    from compgs.model.splats import SplatModel

SUFFIX = ".packed"
MAGIC = b"GSPACKED"
VERSION = 1
NAME = re.compile(r"[a-z0-9][a-z0-9_.-]{0,63}")
TYPES = ("|u1", "|i1", "<u2", "<i2", "<u4", "<i4", "<f2", "<f4", "<f8")
MOST_HEADER_BYTES = 1 << 20
MOST_ARRAYS = 256
MOST_DIMENSIONS = 4
MOST_BYTES = 1 << 32  # of all arrays, unpacked: a hundred million splats of 40 bytes
CODECS = ("raw", "deflate", "lzma")
_START = struct.Struct("<8sII")
_LZMA = [{"id": lzma.FILTER_LZMA2, "preset": 6}]


@dataclass(frozen=True, eq=False)
class Packed:
    """The content of a file."""

    method: str  # of the registry, that wrote it
    facts: Mapping[str, int | float | str | list[Any]]
    arrays: Mapping[str, np.ndarray]
    path: Path = field(default=Path("packed"))  # for messages

    def array(self, name: str, kind: type[np.generic], shape: tuple[int | None, ...]) -> np.ndarray:
        """One of the arrays. Raises SplatFileError unless it is of this type and shape (None: any length)."""
        if name not in self.arrays:
            raise SplatFileError(f"{self.path}: there are no {name}; expected them of method {self.method}")
        array = self.arrays[name]
        fits = len(shape) == array.ndim and all(
            b in (None, a) for a, b in zip(array.shape, shape, strict=True)
        )
        if array.dtype != np.dtype(kind) or not fits:
            lengths = ", ".join("any" if length is None else str(length) for length in shape)
            raise SplatFileError(
                f"{self.path}: {name}: expected {np.dtype(kind).name} of shape ({lengths}), found "
                f"{array.dtype.name} of {array.shape}"
            )
        return array

    def whole_number(self, name: str, low: int, high: int) -> int:
        """One of the facts. Raises SplatFileError unless it is a whole number from `low` to `high`."""
        value = self.facts.get(name)
        if not isinstance(value, int) or isinstance(value, bool) or not low <= value <= high:
            raise SplatFileError(f"{self.path}: {name}: expected {low} to {high}, found {value!r}")
        return value

    def number(self, name: str) -> float:
        """One of the facts. Raises SplatFileError unless it is a finite number."""
        value = self.facts.get(name)
        if not isinstance(value, (int, float)) or isinstance(value, bool) or not math.isfinite(value):
            raise SplatFileError(f"{self.path}: {name}: expected a number, found {value!r}")
        return float(value)


# writing -----------------------------------------------------------------------------------------------------------


def encoded(packed: Packed, codecs: tuple[str, ...] = CODECS) -> bytes:
    """The content of the file; each array by the one of `codecs` that makes it smallest."""
    entries, parts = [], []
    for name, array in packed.arrays.items():
        stored = array.astype(array.dtype.newbyteorder("<"), copy=False)
        assert stored.dtype.str in TYPES, f"{name}: {stored.dtype}"
        assert NAME.fullmatch(name), name
        raw = np.ascontiguousarray(stored).tobytes()
        codec, data = min(((codec, _compressed(raw, codec)) for codec in codecs), key=lambda c: len(c[1]))
        parts.append(data)
        entries.append([name, stored.dtype.str, list(array.shape), codec, len(data), zlib.crc32(data)])
    header = {
        "version": VERSION,
        "method": packed.method,
        "facts": dict(packed.facts),
        "arrays": entries,
    }
    text = zlib.compress(json.dumps(header, separators=(",", ":"), allow_nan=False).encode(), 9)
    return b"".join((_START.pack(MAGIC, len(text), zlib.crc32(text)), text, *parts))


def write_packed(path: Path, packed: Packed, codecs: tuple[str, ...] = CODECS) -> int:
    """Write a file whole or not at all; the number of bytes. Raises OutputError."""
    data = encoded(packed, codecs)
    write_bytes(path, data)
    return len(data)


def packed_bits(values: np.ndarray, bits: int) -> np.ndarray:
    """[ceil(len * bits / 8)] uint8: whole numbers [M] from 0 to 2^bits - 1, the highest bit first."""
    assert 1 <= bits <= 32, bits
    shifts = np.arange(bits - 1, -1, -1, dtype=np.uint64)
    return np.packbits(((values.astype(np.uint64)[:, None] >> shifts) & 1).astype(np.uint8).reshape(-1))


def unpacked_bits(data: np.ndarray, bits: int, count: int) -> np.ndarray:
    """Inverse of `packed_bits`: [count] int64. `data` has as many bytes as that takes."""
    assert len(data) == -(-count * bits // 8), (len(data), count, bits)
    ones = np.unpackbits(data, count=count * bits).reshape(count, bits)
    shifts = np.arange(bits - 1, -1, -1, dtype=np.int64)
    return (ones.astype(np.int64) << shifts).sum(1)


def _compressed(data: bytes, codec: str) -> bytes:
    if codec == "deflate":
        compressor = zlib.compressobj(9, wbits=-15)
        return compressor.compress(data) + compressor.flush()
    if codec == "lzma":
        return lzma.compress(data, lzma.FORMAT_RAW, filters=_LZMA)
    return data


# reading -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Entry:
    """An array, as the header has it."""

    name: str
    dtype: np.dtype
    shape: tuple[int, ...]
    codec: str
    stored: slice  # of the file

    @property
    def bytes(self) -> int:
        return math.prod(self.shape) * self.dtype.itemsize


def begins(head: bytes) -> bool:
    """Whether a file begins as one of these does."""
    return head.startswith(MAGIC)


def check(path: Path) -> None:
    """Raises SplatFileError if the file is not whole."""
    _header(path, path.read_bytes())


def read(path: Path) -> Packed:
    """Raises SplatFileError, naming the first thing that is wrong."""
    data = path.read_bytes()
    header, entries = _header(path, data)
    arrays = {
        e.name: np.frombuffer(_unpacked(path, e, data[e.stored]), e.dtype).reshape(e.shape) for e in entries
    }
    return Packed(header["method"], header["facts"], arrays, path)


def component_bytes(path: Path) -> dict[str, int]:
    """Stored bytes by array; they sum to the file's size."""
    data = path.read_bytes()
    _, entries = _header(path, data)
    sizes = {entry.name: entry.stored.stop - entry.stored.start for entry in entries}
    return {"header": len(data) - sum(sizes.values()), **sizes}


def splat_model(
    packed: Packed, arrays: SplatArrays, device: "Device", background: tuple[float, float, float]
) -> "SplatModel":
    """Splats that a method made of a file. Raises SplatFileError for what nothing can be rendered from."""
    from compgs.model.splats import SplatModel

    if not len(arrays):
        raise SplatFileError(f"{packed.path}: holds no splats")
    return placed(SplatModel(drawable(packed.path, arrays), background), device)


def _header(path: Path, data: bytes) -> tuple[dict[str, Any], list[_Entry]]:
    """The header, and where in the file the arrays are. Raises SplatFileError."""
    if len(data) < _START.size:
        raise SplatFileError(f"{path}: ends after {len(data)} bytes; copy it again")
    _, length, checksum = _START.unpack_from(data)
    text = data[_START.size : _START.size + length]
    if len(text) < length or zlib.crc32(text) != checksum:
        raise SplatFileError(f"{path}: its header is damaged; copy it again")
    try:
        unpacker = zlib.decompressobj()
        header = json.loads(unpacker.decompress(text, MOST_HEADER_BYTES))
        if header["version"] != VERSION:
            raise ValueError(f"version {header['version']!r}, expected {VERSION}")
        facts, entries = header["facts"], header["arrays"]
        if not NAME.fullmatch(header["method"]) or not isinstance(facts, dict) or len(entries) > MOST_ARRAYS:
            raise ValueError("not those of a method")
        found = _entries(entries, _START.size + length)
    except (zlib.error, ValueError, KeyError, TypeError, RecursionError) as error:
        raise SplatFileError(f"{path}: its header cannot be read ({error})") from error
    if sum(entry.bytes for entry in found) > MOST_BYTES:
        raise SplatFileError(f"{path}: its arrays are more than {MOST_BYTES} bytes unpacked")
    end = found[-1].stored.stop if found else _START.size + length
    if end != len(data):
        raise SplatFileError(f"{path}: promises {end} bytes, has {len(data)}; copy it again")
    for entry, (*_, expected) in zip(found, entries, strict=True):
        if zlib.crc32(data[entry.stored]) != expected:
            raise SplatFileError(f"{path}: {entry.name} are damaged; copy it again")
    return header, found


def _entries(entries: list[Any], start: int) -> list[_Entry]:
    """Raises ValueError, TypeError for what no array is."""
    found: list[_Entry] = []
    for name, kind, shape, codec, stored, _ in entries:
        whole = all(type(n) is int and 0 <= n <= MOST_BYTES for n in (*shape, stored))
        fits = NAME.fullmatch(name) and kind in TYPES and codec in CODECS and whole
        if not fits or len(shape) > MOST_DIMENSIONS or name in (entry.name for entry in found):
            raise ValueError(f"array {name!r}: {kind!r}, {shape!r}, {codec!r}, {stored!r} bytes")
        found.append(_Entry(name, np.dtype(kind), tuple(shape), codec, slice(start, start + stored)))
        start += stored
    return found


def _unpacked(path: Path, entry: _Entry, data: bytes) -> bytes:
    """Raises SplatFileError unless it is as many bytes as the header says."""
    most = entry.bytes + 1  # a byte more than there may be: what has more is not unpacked to its end
    try:
        if entry.codec == "deflate":
            content = zlib.decompressobj(wbits=-15).decompress(data, most)
        elif entry.codec == "lzma":
            content = lzma.LZMADecompressor(lzma.FORMAT_RAW, filters=_LZMA).decompress(data, most)
        else:
            content = data
    except (zlib.error, lzma.LZMAError, EOFError) as error:
        raise SplatFileError(f"{path}: {entry.name} are damaged ({error}); copy it again") from error
    if len(content) != entry.bytes:
        raise SplatFileError(
            f"{path}: {entry.name}: expected {entry.bytes} bytes, found {len(content)}; copy it again"
        )
    return content
