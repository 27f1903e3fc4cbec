"""The container: magic, version, sections with lengths and checksums (docs/bitstream.md, "File").

    magic 4 | version 1 | flags 1 | section count 1 | table: (id 1, length 4, CRC32 4) each | CRC32 of all
    before 4 | sections

Knows nothing of what the sections hold beyond their numbers.
"""

import struct
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from compgs.errors import (
    BitstreamError,
    CorruptSection,
    NotACompGSFile,
    NotEncodable,
    TruncatedSection,
    UnsupportedVersion,
)

MAGIC = b"\x93CGS"  # not text, and not valid UTF-8
VERSION = 5
OLDEST_VERSION = 2  # that is read
FIRST_WITH_NEIGHBOURS = 3  # version from which on groups may take what neighbours have
FIRST_WITH_DILATION = 4  # version from which on the scene section has an angular dilation
# Version from which on symbols may say something about later ones of their row, and heads have no names.
FIRST_WITH_ROWS = 5
OPTIONAL = 0x80  # sections with this bit in their number may be skipped by a decoder that does not know them
MAX_SECTIONS = 64
MAX_FILE_BYTES = (1 << 32) - 1

# In the order in which a decoder needs them.
SCENE = 1
POSITIONS = 2
POSITIONS_GPCC = 3  # in place of POSITIONS
MASKS = 4
TABLES = 5
NETWORKS = 6
HEADS = 7
LATENTS = 8  # once for each range of octree levels, coarse to fine
METADATA = OPTIONAL | 1
PADDING = OPTIONAL | 2
VIEWPOINTS = OPTIONAL | 3

SECTION_NAMES = {
    SCENE: "scene",
    POSITIONS: "positions",
    POSITIONS_GPCC: "positions (G-PCC)",
    MASKS: "masks",
    TABLES: "tables",
    NETWORKS: "entropy networks",
    HEADS: "prediction heads",
    LATENTS: "latents",
    METADATA: "metadata",
    PADDING: "padding",
    VIEWPOINTS: "viewpoints",
}
REQUIRED = (SCENE, MASKS, TABLES, NETWORKS, HEADS, LATENTS)

SMALLEST_DILATION, LARGEST_DILATION = 2.0**-40, 1.0  # of an angular dilation: squares of tangents

# Limits of what a file may hold; a decoder checks them, and the lengths, before it allocates.
MAX_ANCHORS = 1 << 24
MAX_COUPLED_PRIMITIVES = 64
MAX_REFERENCE_DIM = 256
MAX_RESIDUAL_DIM = 64
MAX_SIDE_DIM = 64
MAX_GROUPS = 16
MAX_RANGES = 22  # of octree levels: 0 to 21
MAX_WIDTH = 1024
MAX_SYMBOL = 1 << 18  # absolute value of a symbol: latents in Q12 fit into 32 bits
# Symbols, those of missing coupled primitives included, a file of n bytes may hold: 2^20 + 128 n. A file that
# says more (1/16 bit a symbol) is refused; a model that compresses so well is padded.
FREE_SYMBOLS = 1 << 20
SYMBOLS_PER_BYTE = 128
# Flags of masks, and nodes that the walk of the octree codes, likewise. Trained scenes have at most half a flag and a
# tenth of a node a byte; the constants are a fraction of a second's work on one core.
FREE_FLAGS = 1 << 20
FLAGS_PER_BYTE = 16
FREE_NODES = 1 << 18
NODES_PER_BYTE = 4
# Products (multiplications of entropy networks, and of prediction heads) that decoding and drawing a file of n bytes
# may take: a constant and so many a byte. Trained scenes take at most a twentieth of the second; the constants are a
# fraction of a second's work on one core.
FREE_NETWORK_PRODUCTS = 1 << 28
NETWORK_PRODUCTS_PER_BYTE = 1 << 15
FREE_HEAD_PRODUCTS = 1 << 30
HEAD_PRODUCTS_PER_BYTE = 1 << 17
MAX_METADATA_BYTES = 4096

_HEADER = struct.Struct("<4sBBB")
_ENTRY = struct.Struct("<BII")
_CRC = struct.Struct("<I")


@dataclass(frozen=True)
class Section:
    """A section of a file."""

    number: int
    data: bytes

    @property
    def name(self) -> str:
        return SECTION_NAMES.get(self.number, f"section {self.number}")


@contextmanager
def named(path: Path, *, prefix: bool = False) -> Iterator[None]:
    """A BitstreamError inside becomes one that names the file, and what to do about it. `prefix`: only the beginning of
    the file was asked for, and that it ends early is no damage.
    """
    try:
        yield
    except (TruncatedSection, CorruptSection) as error:
        remedy = "" if prefix and isinstance(error, TruncatedSection) else "; download or copy the file again"
        raise type(error)(f"{path}: {error}{remedy}") from error
    except BitstreamError as error:
        raise type(error)(f"{path}: {error}") from error


def container_bytes(sections: int) -> int:
    """Bytes of a file that belong to no section."""
    return _HEADER.size + sections * _ENTRY.size + _CRC.size


def pack(sections: list[Section], version: int) -> bytes:
    """A file of these sections, in this order."""
    if container_bytes(len(sections)) + sum(len(s.data) for s in sections) > MAX_FILE_BYTES:
        raise NotEncodable(f"the file would exceed {MAX_FILE_BYTES} bytes")
    head = _HEADER.pack(MAGIC, version, 0, len(sections))
    head += b"".join(_ENTRY.pack(s.number, len(s.data), zlib.crc32(s.data)) for s in sections)
    return b"".join([head, _CRC.pack(zlib.crc32(head)), *(s.data for s in sections)])


def version_of(data: bytes) -> int:
    """Return the version of a file that `unpack` accepts."""
    return data[len(MAGIC)]


def unpack(data: bytes, *, prefix: bool = False) -> list[Section]:
    """Sections of a file, lengths and checksums verified; optional ones that are unknown are among them.

    `prefix`: the file may end early; the sections that are whole, of which all but latents must be.
    """
    if (len(data) < len(MAGIC) and MAGIC.startswith(data)) or (
        data[:4] == MAGIC and len(data) < _HEADER.size
    ):
        raise TruncatedSection(f"header: the file ends after {len(data)} bytes")
    if data[: len(MAGIC)] != MAGIC:
        raise NotACompGSFile("not a .cgs file: it does not begin as one")
    _, version, flags, count = _HEADER.unpack_from(data)
    if not OLDEST_VERSION <= version <= VERSION:
        remedy = "; install a newer compgs" if version > VERSION else "; encode the scene again"
        raise UnsupportedVersion(
            f"header: the file has version {version}, this decoder reads versions {OLDEST_VERSION} to {VERSION}{remedy}"
        )
    if len(data) < container_bytes(count):
        raise TruncatedSection(
            f"header: {count} sections need {container_bytes(count)} bytes, the file ends after {len(data)}"
        )
    at = container_bytes(count)
    head = data[: at - _CRC.size]
    if zlib.crc32(head) != _CRC.unpack_from(data, len(head))[0]:
        raise CorruptSection("header: its checksum does not match; the file was altered or damaged")
    if flags != 0:
        raise CorruptSection(f"header: reserved flags are {flags:#04x}, expected 0")
    if count > MAX_SECTIONS:
        raise CorruptSection(f"header: {count} sections, expected at most {MAX_SECTIONS}")
    entries = [_ENTRY.unpack_from(head, _HEADER.size + i * _ENTRY.size) for i in range(count)]
    _check_table([number for number, _, _ in entries])
    sections: list[Section] = []
    for number, length, crc in entries:
        section = Section(number, data[at : at + length])
        if len(section.data) < length:
            have = {s.number for s in sections}
            if prefix and have.issuperset(REQUIRED):
                return sections
            if prefix:
                needed = next(end for kind, end in section_ends(data) if kind == LATENTS)
                raise TruncatedSection(
                    f"{section.name}: of {len(data)} bytes nothing can be shown yet, the first scene takes {needed}"
                )
            raise TruncatedSection(
                f"{section.name}: header promises {length} bytes, the file ends after {len(section.data)}"
            )
        if zlib.crc32(section.data) != crc:
            raise CorruptSection(
                f"{section.name}: its checksum does not match; the file was altered or damaged"
            )
        sections.append(section)
        at += length
    if at < len(data):
        raise CorruptSection(f"{len(data) - at} bytes are left over after the last section")
    return sections


def section_ends(data: bytes) -> list[tuple[int, int]]:
    """(number, bytes of the file up to the section's end) of each section, from the header alone; see `unpack`."""
    count = data[_HEADER.size - 1]
    at, ends = container_bytes(count), []
    for i in range(count):
        number, length, _ = _ENTRY.unpack_from(data, _HEADER.size + i * _ENTRY.size)
        at += length
        ends.append((number, at))
    return ends


def _check_table(numbers: list[int]) -> None:
    """All required sections and one of the positions, in order, each once but the latents; optional ones anywhere,
    each once; no unknown required ones.
    """
    for number in numbers:
        if not number & OPTIONAL and number not in SECTION_NAMES:
            raise UnsupportedVersion(
                f"header: section {number} is unknown and must not be skipped; install a newer compgs"
            )
    required = [number for number in numbers if not number & OPTIONAL]
    once = [number for number in numbers if number != LATENTS]
    if required != sorted(required) or len(once) != len(set(once)):
        raise CorruptSection("header: the sections are not in ascending order, each once")
    missing = [SECTION_NAMES[number] for number in REQUIRED if number not in numbers]
    if missing:
        raise CorruptSection(f"header: the section {missing[0]!r} is missing")
    if (POSITIONS in numbers) == (POSITIONS_GPCC in numbers):
        raise CorruptSection("header: expected one section of positions, 2 or 3")
    if numbers.count(LATENTS) > MAX_RANGES:
        raise CorruptSection(f"header: {numbers.count(LATENTS)} ranges, expected at most {MAX_RANGES}")
