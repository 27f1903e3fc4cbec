"""Damaged and forged files: a short run of benchmarks/fuzz.py, and files that promise more than they hold."""

import struct
import sys
import tracemalloc
from itertools import islice
from pathlib import Path

import pytest

from compgs.codec.fields import FieldReader, varint
from compgs.codec.format import LATENTS, OLDEST_VERSION, SCENE, Section, pack, unpack
from compgs.codec.latents import read_head
from compgs.codec.reader import read_content, read_latents
from compgs.codec.sections import SCENE_LAYOUT
from compgs.codec.writer import write_content
from compgs.errors import BitstreamError, CorruptSection

sys.path.append(str(Path(__file__).parents[2] / "benchmarks"))
import fuzz
from fuzz import FORGERS, forgeries, golden_paths, outcome
from made_content import make_content

MEMORY_FLOOR = 48 << 20  # what any file may take, for its 2^20 free symbols
MEMORY_PER_BYTE = 4096


@pytest.fixture(scope="module")
def golden() -> list[bytes]:
    return [path.read_bytes() for path in golden_paths()]


@pytest.mark.parametrize("count", [200, pytest.param(800, marks=pytest.mark.slow)])
def test_forgeries_are_refused_or_sound(golden: list[bytes], count: int) -> None:
    seen = set()
    for kind, data in islice(forgeries(golden, seed=1), count):
        seen.add((kind, outcome(data)))
    assert {kind for kind, _ in seen} == {forger.__name__ for forger in FORGERS}
    assert {kind for kind, result in seen if result == "accepted"} <= {
        "forged_payload", "forged_scene", "forged_header", "spliced", "flipped", "forged_groups", "forged_range",
        "forged_network",
    }  # fmt: skip


def test_a_file_that_takes_longer_than_its_length_allows_is_a_failure(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, golden: list[bytes], capsys: pytest.CaptureFixture[str]
) -> None:
    """The clock is a made-up one: decoding takes 4 s and 0.3 ms a byte, the bound is 4 s and 0.2 ms."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(fuzz, "decoding_seconds", lambda data: 4.0 + 3e-4 * len(data))
    monkeypatch.setattr(fuzz, "outcome", lambda data: "accepted")
    monkeypatch.setattr(fuzz, "forgeries", lambda files, seed: iter([("some", golden[0]), ("some", b"")]))
    monkeypatch.setattr(sys, "argv", ["fuzz.py"])
    with pytest.raises(SystemExit, match="1"):
        fuzz.main()
    assert [path.name for path in tmp_path.iterdir()] == ["fuzz-0-0.cgs"]
    assert (tmp_path / "fuzz-0-0.cgs").read_bytes() == golden[0]
    assert "2 files, 1 failures" in capsys.readouterr().out


def test_flipped_bits_are_always_caught(golden: list[bytes]) -> None:
    data = golden[0]
    for i in range(0, 8 * len(data), 23):
        broken = bytearray(data)
        broken[i // 8] ^= 1 << i % 8
        with pytest.raises(BitstreamError):
            read_content(bytes(broken))


@pytest.mark.parametrize("anchors", [1 << 24, 200_000, 9_000])
@pytest.mark.parametrize("coupled", [1, 10, 64])
@pytest.mark.parametrize("prefix", [False, True])
def test_memory_stays_proportional_to_the_file(anchors: int, coupled: int, prefix: bool) -> None:
    sections = unpack(write_content(make_content(30, 1)))
    size = struct.calcsize(SCENE_LAYOUT)
    fields = list(struct.unpack(SCENE_LAYOUT, sections[0].data[:size]))
    fields[0], fields[1], fields[2] = anchors, anchors * coupled, coupled
    assert sections[0].number == SCENE
    sections[0] = Section(SCENE, struct.pack(SCENE_LAYOUT, *fields) + sections[0].data[size:])
    at = next(i for i, section in enumerate(sections) if section.number == LATENTS)
    reader = FieldReader(sections[at].data, "latents")
    head = read_head(reader)
    forged = bytes([head.level]) + varint(anchors) + varint(anchors * coupled)
    sections[at] = Section(LATENTS, forged + sections[at].data[reader.position :])
    data = pack(sections, OLDEST_VERSION)
    tracemalloc.start()
    try:
        with pytest.raises(CorruptSection):
            read_latents(data, prefix=prefix)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < MEMORY_FLOOR + MEMORY_PER_BYTE * len(data)
