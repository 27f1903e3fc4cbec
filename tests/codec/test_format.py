"""The container: what it refuses and how it names it; the document states the same numbers as the code."""

import re
import struct
import zlib
from pathlib import Path

import pytest

from compgs.codec import (
    content,
    fields,
    format,
    integer_network,
    latents,
    rans,
    rows,
    sections,
    tables,
    weights,
)
from compgs.codec.format import (
    HEADS,
    LATENTS,
    MAX_RANGES,
    METADATA,
    POSITIONS,
    POSITIONS_GPCC,
    REQUIRED,
    SECTION_NAMES,
    VERSION,
    Section,
    container_bytes,
    pack,
    section_ends,
    unpack,
)
from compgs.errors import BitstreamError, CorruptSection, NotACompGSFile, TruncatedSection, UnsupportedVersion
from compgs.ordering import neighbours

DOCUMENT = Path(__file__).parents[2] / "docs" / "bitstream.md"

PRESENT = sorted((*REQUIRED, POSITIONS))  # sections of the smallest file


def some_file(extra: list[Section] | None = None) -> bytes:
    return pack([Section(n, bytes([n]) * (n * 3)) for n in PRESENT] + (extra or []), VERSION)


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
    with pytest.raises(NotACompGSFile, match=r"not a \.cgs file"):
        unpack(data)


def test_truncation_names_the_section() -> None:
    data = some_file()
    cut = data[: len(data) - 3 * LATENTS - 5]
    with pytest.raises(
        TruncatedSection, match="prediction heads: header promises 21 bytes, the file ends after 16"
    ):
        unpack(cut)


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"version": 6}, UnsupportedVersion, "version 6.*newer compgs"),
        ({"version": 1}, UnsupportedVersion, "version 1.*encode the scene again"),
        ({"version": 0}, UnsupportedVersion, "version 0"),
        ({"flags": 1}, CorruptSection, "flags"),
        ({"flags": 128}, CorruptSection, "flags"),
        ({"x7": 0}, UnsupportedVersion, "section 0 is unknown"),
        ({"x7": 2}, CorruptSection, "ascending"),
        ({"x16": 99}, UnsupportedVersion, "section 99 is unknown"),
        ({"x16": 1}, CorruptSection, "ascending"),
        ({"x61": 0x84}, CorruptSection, "'latents' is missing"),
        ({"x52": LATENTS}, CorruptSection, "'prediction heads' is missing"),
    ],
)
def test_absurd_headers_are_refused(
    change: dict[str, int], error: type[BitstreamError], message: str
) -> None:
    with pytest.raises(error, match=message):
        unpack(with_header(some_file(), **change))


def test_missing_and_left_over_parts_are_refused() -> None:
    with pytest.raises(CorruptSection, match="'latents' is missing"):
        unpack(pack([Section(n, b"") for n in PRESENT[:-1]], VERSION))
    with pytest.raises(CorruptSection, match="3 bytes are left over"):
        unpack(some_file() + b"abc")
    with pytest.raises(CorruptSection, match="64"):
        unpack(pack([Section(128 + n, b"") for n in range(65)], VERSION))


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
    with pytest.raises(CorruptSection, match="latents: its checksum"):
        unpack(bytes(data))


RANGES = [Section(LATENTS, b"coarse"), Section(LATENTS, b"finer"), Section(LATENTS, b"all")]


def file_of_ranges() -> bytes:
    """Latents in three sections, metadata between two of them."""
    others = [Section(n, bytes([n]) * 5) for n in PRESENT if n != LATENTS]
    return pack([*others, *RANGES[:2], Section(METADATA, b"who"), RANGES[2]], VERSION)


def test_only_latents_may_come_in_several_sections() -> None:
    assert [s.data for s in unpack(file_of_ranges()) if s.number == LATENTS] == [s.data for s in RANGES]
    for number in (*PRESENT, METADATA):
        if number == LATENTS:
            continue
        twice = sorted([*PRESENT, number, METADATA])
        with pytest.raises(CorruptSection, match="ascending order, each once"):
            unpack(pack([Section(n, b"") for n in twice], VERSION))
    many = [Section(n, b"") for n in PRESENT] + [Section(LATENTS, b"")] * MAX_RANGES
    assert len(unpack(pack(many[:-1], VERSION))) == len(many) - 1
    with pytest.raises(CorruptSection, match=f"{MAX_RANGES + 1} ranges, expected at most {MAX_RANGES}"):
        unpack(pack(many, VERSION))


def test_a_beginning_of_a_file_has_the_sections_that_are_whole() -> None:
    """At every length: with the first range whole it is accepted, and else refused by the name of what is missing."""
    data = file_of_ranges()
    whole = unpack(data)
    ends = section_ends(data)
    assert [number for number, _ in ends] == [section.number for section in whole]
    assert ends[-1][1] == len(data)
    first = next(end for number, end in ends if number == LATENTS)
    for size in range(len(data) + 1):
        present = sum(end <= size for _, end in ends)
        if size >= first:
            assert unpack(data[:size], prefix=True) == whole[:present]
            continue
        with pytest.raises(TruncatedSection) as refused:
            unpack(data[:size], prefix=True)
        if size >= container_bytes(data[6]):
            assert str(refused.value).startswith(f"{whole[present].name}: of {size} bytes nothing can be")
    for size in range(first, len(data)):
        with pytest.raises(TruncatedSection):
            unpack(data[:size])


def test_a_beginning_is_not_taken_for_a_damaged_file() -> None:
    """What is there must be right: a flipped bit of a whole section is found, and nothing may follow the last."""
    data = bytearray(file_of_ranges())
    at = dict(section_ends(bytes(data)))[HEADS] - 1
    data[at] ^= 1
    with pytest.raises(CorruptSection, match="prediction heads: its checksum"):
        unpack(bytes(data[:-1]), prefix=True)
    with pytest.raises(CorruptSection, match="left over"):
        unpack(file_of_ranges() + b"x", prefix=True)


def test_of_a_beginning_what_is_found_first_in_the_order_of_the_file_decides() -> None:
    """A damaged section before one that has not arrived is damage; behind it, it has not arrived either."""
    data = bytearray(file_of_ranges())
    ends = dict(section_ends(bytes(data)))
    data[ends[POSITIONS] - 1] ^= 1
    for prefix in (False, True):
        with pytest.raises(CorruptSection, match="positions: its checksum"):
            unpack(bytes(data[: ends[HEADS]]), prefix=prefix)
        with pytest.raises(TruncatedSection, match="positions"):
            unpack(bytes(data[: ends[POSITIONS] - 1]), prefix=prefix)


def test_document_and_code_agree_on_the_constants() -> None:
    text = DOCUMENT.read_text(encoding="utf-8")
    stated = dict(re.findall(r"^\| `([A-Z_0-9]+)` \| ([^|]+?) \|", text, re.MULTILINE))
    modules = [
        format, content, fields, integer_network, latents, neighbours, rans, rows, sections, tables, weights
    ]  # fmt: skip
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
            unpack(pack([Section(n, b"") for n in numbers], VERSION))
    unpack(pack([Section(n, b"") for n in sorted((*REQUIRED, POSITIONS_GPCC))], VERSION))
