"""The container: magic, version, sections with lengths and checksums (docs/bitstream.md, "File").

    magic 4 | version 1 | flags 1 | section count 1 | table: (id 1, length 4, CRC32 4) each | CRC32 of all
    before 4 | sections

Knows nothing of what the sections hold beyond their numbers.
"""

import struct
import zlib
from dataclasses import dataclass

from compgs.errors import CorruptSection, NotACompGSFile, NotEncodable, TruncatedSection, UnsupportedVersion

MAGIC = b"\x93CGS"  # not text, and not valid UTF-8
VERSION = 1
OPTIONAL = 0x80  # sections with this bit in their number may be skipped by a decoder that does not know them
MAX_SECTIONS = 64
MAX_FILE_BYTES = (1 << 32) - 1

SCENE = 1
POSITIONS = 2
MASKS = 3
HYPER_TABLES = 4
NETWORKS = 5
HEADS = 6
REFERENCE_HYPER = 7
REFERENCE = 8
COVARIANCE = 9
RESIDUAL_HYPER = 10
RESIDUAL = 11
POSITIONS_GPCC = 12  # in place of POSITIONS
METADATA = OPTIONAL | 1
PADDING = OPTIONAL | 2

SECTION_NAMES = {
    SCENE: "scene",
    POSITIONS: "positions",
    MASKS: "masks",
    HYPER_TABLES: "hyperprior tables",
    NETWORKS: "entropy networks",
    HEADS: "prediction heads",
    REFERENCE_HYPER: "reference hyperprior",
    REFERENCE: "reference embeddings",
    COVARIANCE: "covariance",
    RESIDUAL_HYPER: "residual hyperprior",
    RESIDUAL: "residual embeddings",
    POSITIONS_GPCC: "positions (G-PCC)",
    METADATA: "metadata",
    PADDING: "padding",
}
REQUIRED = tuple(
    number for number in SECTION_NAMES if not number & OPTIONAL and number not in (POSITIONS, POSITIONS_GPCC)
)

# Limits of what a file may hold; a decoder checks them, and the lengths, before it allocates.
MAX_ANCHORS = 1 << 24
MAX_COUPLED_PRIMITIVES = 64
MAX_REFERENCE_DIM = 256
MAX_RESIDUAL_DIM = 64
MAX_HYPER_DIM = 64
MAX_WIDTH = 1024
MAX_SYMBOL = 1 << 18  # absolute value of a symbol: latents in Q12 fit into 32 bits
# Symbols, those of missing coupled primitives included, a file of n bytes may hold: 2^20 + 128 n. A file that
# says more (1/16 bit a symbol) is refused; a model that compresses so well is padded.
FREE_SYMBOLS = 1 << 20
SYMBOLS_PER_BYTE = 128
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


def container_bytes(sections: int) -> int:
    """Bytes of a file that belong to no section."""
    return _HEADER.size + sections * _ENTRY.size + _CRC.size


def pack(sections: list[Section]) -> bytes:
    """A file of these sections, in this order."""
    if container_bytes(len(sections)) + sum(len(s.data) for s in sections) > MAX_FILE_BYTES:
        raise NotEncodable(f"the file would exceed {MAX_FILE_BYTES} bytes")
    head = _HEADER.pack(MAGIC, VERSION, 0, len(sections))
    head += b"".join(_ENTRY.pack(s.number, len(s.data), zlib.crc32(s.data)) for s in sections)
    return b"".join([head, _CRC.pack(zlib.crc32(head)), *(s.data for s in sections)])


def unpack(data: bytes) -> list[Section]:
    """Sections of a file, lengths and checksums verified; optional ones that are unknown are among them."""
    if (len(data) < len(MAGIC) and MAGIC.startswith(data)) or (
        data[:4] == MAGIC and len(data) < _HEADER.size
    ):
        raise TruncatedSection(f"header: the file ends after {len(data)} bytes")
    if data[: len(MAGIC)] != MAGIC:
        raise NotACompGSFile(
            f"header: expected the bytes {MAGIC.hex(' ')} of a .cgs file, found {data[:4].hex(' ')}"
        )
    _, version, flags, count = _HEADER.unpack_from(data)
    if version != VERSION:
        remedy = "; install a newer compgs" if version > VERSION else "; encode the scene again"
        raise UnsupportedVersion(
            f"header: the file has version {version}, this decoder reads version {VERSION}{remedy}"
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
    sections = []
    for number, length, crc in entries:
        section = Section(number, data[at : at + length])
        if len(section.data) < length:
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


def _check_table(numbers: list[int]) -> None:
    """All required sections and one of the positions, each once, in order; optional ones behind them, each once; no
    unknown required ones.
    """
    for number in numbers:
        if not number & OPTIONAL and number not in SECTION_NAMES:
            raise UnsupportedVersion(
                f"header: section {number} is unknown and must not be skipped; install a newer compgs"
            )
    if numbers != sorted(set(numbers)):
        raise CorruptSection("header: the sections are not in ascending order, each once")
    missing = [SECTION_NAMES[number] for number in REQUIRED if number not in numbers]
    if missing:
        raise CorruptSection(f"header: the section {missing[0]!r} is missing")
    if (POSITIONS in numbers) == (POSITIONS_GPCC in numbers):
        raise CorruptSection("header: expected one section of positions, 2 or 12")
