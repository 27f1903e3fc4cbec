"""The container: what it refuses and how it names it; the document states the same numbers as the code."""

import re
import struct
import zlib
from pathlib import Path

import pytest

from compgs.codec import fields, format, integer_network, rans, sections, tables, weights
from compgs.codec.format import (
    POSITIONS,
    POSITIONS_GPCC,
    REQUIRED,
    SECTION_NAMES,
    Section,
    container_bytes,
    pack,
    unpack,
)
from compgs.errors import BitstreamError, CorruptSection, NotACompGSFile, TruncatedSection, UnsupportedVersion

DOCUMENT = Path(__file__).parents[2] / "docs" / "bitstream.md"

PRESENT = sorted((*REQUIRED, POSITIONS))  # sections of the smallest file


def some_file(extra: list[Section] | None = None) -> bytes:
    return pack([Section(n, bytes([n]) * (n * 3)) for n in PRESENT] + (extra or []))


def with_header(data: bytes, **changes: int) -> bytes:
    """The file with header bytes changed and the header's checksum made right again."""
    places = {"version": 4, "flags": 5, "count": 6}
    head = bytearray(data)
    for name, value in changes.items():
        head[places[name] if name in places else int(name[1:])] = value
    end = container_bytes(data[6])
    head[end - 4 : end] = struct.pack("<I", zlib.crc32(bytes(head[: end - 4])))
    return bytes(head)


def test_sections_come_back() -> None:
    extra = [Section(0x81, b"hello"), Section(0xFE, b"from the future")]
    read = unpack(some_file(extra))
    assert [(s.number, s.data) for s in read] == [(n, bytes([n]) * (n * 3)) for n in PRESENT] + [
        (s.number, s.data) for s in extra
    ]


def test_container_of_a_file_is_a_small_part_of_a_megabyte() -> None:
    assert container_bytes(len(SECTION_NAMES)) < 1_000_000 * 0.001


@pytest.mark.parametrize(
    "data",
    [b"", b"\x93", b"\x93CGS", b"\x93CGS\x01\x00", some_file()[:50], some_file()[:-1], some_file()[:120]],
)
def test_files_that_end_early_are_truncated(data: bytes) -> None:
    with pytest.raises(TruncatedSection):
        unpack(data)


@pytest.mark.parametrize("data", [b"ply\nformat", b"\x93NUMPY", b"CGS1" * 100, bytes(64)])
def test_other_files_are_not_compgs_files(data: bytes) -> None:
    with pytest.raises(NotACompGSFile, match="93 43 47 53"):
        unpack(data)


def test_truncation_names_the_section() -> None:
    data = some_file()
    cut = data[: len(data) - 40]
    with pytest.raises(
        TruncatedSection, match="residual hyperprior: header promises 30 bytes, the file ends after"
    ):
        unpack(cut)


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"version": 2}, UnsupportedVersion, "version 2.*newer compgs"),
        ({"version": 0}, UnsupportedVersion, "version 0"),
        ({"flags": 1}, CorruptSection, "flags"),
        ({"flags": 128}, CorruptSection, "flags"),
        ({"x7": 0}, UnsupportedVersion, "section 0 is unknown"),
        ({"x7": 2}, CorruptSection, "ascending"),
        ({"x16": 99}, UnsupportedVersion, "section 99 is unknown"),
        ({"x16": 1}, CorruptSection, "ascending"),
        ({"x97": 0x83}, CorruptSection, "'residual embeddings' is missing"),
    ],
)
def test_absurd_headers_are_refused(
    change: dict[str, int], error: type[BitstreamError], message: str
) -> None:
    with pytest.raises(error, match=message):
        unpack(with_header(some_file(), **change))


def test_missing_and_left_over_parts_are_refused() -> None:
    with pytest.raises(CorruptSection, match="'residual embeddings' is missing"):
        unpack(pack([Section(n, b"") for n in PRESENT[:-1]]))
    with pytest.raises(CorruptSection, match="3 bytes are left over"):
        unpack(some_file() + b"abc")
    with pytest.raises(CorruptSection, match="64"):
        unpack(pack([Section(128 + n, b"") for n in range(65)]))


def test_every_flipped_bit_is_caught() -> None:
    data = some_file([Section(0x81, b"hello")])
    for i in range(len(data)):
        for bit in range(8):
            broken = bytearray(data)
            broken[i] ^= 1 << bit
            with pytest.raises(BitstreamError):
                unpack(bytes(broken))


def test_flipped_payload_bits_name_their_section() -> None:
    data = bytearray(some_file())
    data[-1] ^= 1
    with pytest.raises(CorruptSection, match="residual embeddings: its checksum"):
        unpack(bytes(data))


def test_document_and_code_agree_on_the_constants() -> None:
    text = DOCUMENT.read_text(encoding="utf-8")
    stated = dict(re.findall(r"^\| `([A-Z_0-9]+)` \| ([^|]+?) \|", text, re.MULTILINE))
    modules = [format, fields, integer_network, rans, sections, tables, weights]
    assert len(stated) >= 30
    for name, value in stated.items():
        found = [getattr(m, name) for m in modules if hasattr(m, name)]
        assert found, f"{name} is in the document but not in the code"
        shown = value.strip("` ")
        if name == "MAGIC":
            expected: object = bytes.fromhex(shown)
        elif "," in shown:
            expected = tuple(int(v) for v in shown.split(","))
        else:
            power = re.fullmatch(r"2\^(-?\d+)( - 1)?", shown)
            expected = 2 ** int(power[1]) - (1 if power[2] else 0) if power else int(shown, 0)
        assert all(value == expected for value in found), f"{name} is {found[0]}, the document says {shown}"


def test_document_names_every_section_with_its_number() -> None:
    text = DOCUMENT.read_text(encoding="utf-8")
    for number, name in SECTION_NAMES.items():
        assert re.search(rf"^\| {number} \| {re.escape(name)} \|", text, re.MULTILINE), name
    assert f"Version {format.VERSION}" in text


def test_positions_come_in_exactly_one_section() -> None:
    for numbers in (REQUIRED, sorted((*PRESENT, POSITIONS_GPCC))):
        with pytest.raises(CorruptSection, match="one section of positions"):
            unpack(pack([Section(n, b"") for n in numbers]))
    unpack(pack([Section(n, b"") for n in sorted((*REQUIRED, POSITIONS_GPCC))]))
