"""The decoder against a decoder in plain Python that was written from docs/bitstream.md alone."""

import hashlib
import json
import struct
import sys
import zlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from compgs.codec.content import FileContent, GroupShape, Role
from compgs.codec.reader import read_latents
from compgs.codec.viewpoints import Viewpoint, Viewpoints, decode_viewpoints, encode_viewpoints
from compgs.codec.weights import QuantizedTensor
from compgs.codec.writer import write_content
from compgs.errors import CompGSError

ROOT = Path(__file__).parents[2]
sys.path += [str(ROOT / "tools"), str(ROOT / "benchmarks")]
import plain_decoder  # noqa: E402
from made_content import make_content, make_dimensions, paper_groups  # noqa: E402

GOLDEN = ROOT / "tests" / "golden"
VERSIONS = range(plain_decoder.OLDEST_VERSION, plain_decoder.VERSION + 1)
FILES = [path for path in sorted(GOLDEN.glob("*.cgs")) if path.read_bytes()[4] in VERSIONS]
LATENTS, PADDING = 8, 130
LARGEST_SYMBOL = 2**18

Sections = list[tuple[int, bytes]]


def sections_of(data: bytes) -> Sections:
    at = 11 + 9 * data[6]
    found = []
    for i in range(data[6]):
        number, length, _ = struct.unpack_from("<BII", data, 7 + 9 * i)
        found.append((number, data[at : at + length]))
        at += length
    return found


def file_of(sections: Sections, version: int = 2, flags: int = 0) -> bytes:
    head = b"\x93CGS" + bytes([version, flags, len(sections)])
    head += b"".join(struct.pack("<BII", number, len(p), zlib.crc32(p)) for number, p in sections)
    return head + struct.pack("<I", zlib.crc32(head)) + b"".join(payload for _, payload in sections)


def ends(sections: Sections) -> list[int]:
    """Where the sections end in their file."""
    lengths = [len(payload) for _, payload in sections]
    return (11 + 9 * len(sections) + np.cumsum(lengths)).tolist()


def outcome(data: bytes, prefix: bool) -> str:
    """Of both decoders, which must agree: the name of an error, or "decoded"."""
    try:
        expected = read_latents(data, prefix=prefix)
    except CompGSError as error:
        with pytest.raises(plain_decoder.Refused) as refused:
            plain_decoder.decode(data, prefix)
        assert type(refused.value).__name__ == type(error).__name__, f"{refused.value} / {error}"
        return type(error).__name__
    assert_same(plain_decoder.decode(data, prefix), *expected)
    return "decoded"


def assert_same(found: dict, content: FileContent, latents: tuple[np.ndarray, ...]) -> None:
    def same(values: list, array: np.ndarray) -> bool:
        return np.array_equal(np.array(values).reshape(array.shape), array)

    assert same(found["coordinates"], content.coordinates) and same(found["mask"], content.mask)
    for ours, group, rows in zip(found["groups"], content.groups, latents, strict=True):
        assert (ours["role"], ours["channels"]) == (group.shape.role, group.shape.channels)
        assert tuple(ours["steps"]) == group.shape.steps
        assert same(ours["symbols"], group.symbols) and same(ours["latents"], rows)
    scene = found["scene"]
    assert ("separate", "paired")[scene["heads"]] == content.heads_layout
    for name in (
        "coupled_primitives",
        "residual_dim",
        "width",
        "voxel_size",
        "view_distance_scale",
        "angular_dilation",
    ):
        assert scene[name] == getattr(content, name), name
    for name in ("world_offset", "background"):
        assert tuple(scene[name]) == tuple(getattr(content, name)), name
    assert list(found["heads"]) == [name for name, _ in content.heads]
    for ours, (_, tensor) in zip(found["heads"].values(), content.heads, strict=True):
        assert (ours["exponent"], tuple(ours["shape"])) == (tensor.exponent, tensor.values.shape)
        assert same(ours["values"], tensor.values)
    assert found["metadata"] == content.metadata
    assert_same_viewpoints(found["viewpoints"], content.viewpoints)


def assert_same_viewpoints(found: dict | None, expected: Viewpoints | None) -> None:
    assert (found is None) == (expected is None)
    if found is None or expected is None:
        return
    np.testing.assert_allclose(np.array(found["up"]) / np.linalg.norm(found["up"]), expected.up, atol=1e-12)
    for ours, view in zip(found["views"], expected.views, strict=True):
        assert tuple(ours["lens"]) == view.lens
        np.testing.assert_allclose(ours["center"], view.center, rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(ours["rotation"], view.rotation, atol=1e-12)


# made contents -------------------------------------------------------------------------------------------------------


def random_content(seed: int) -> FileContent:
    """Any groups in any order, few anchors and channels; some symbols far outside what networks and tables expect."""
    rng = np.random.default_rng(seed)
    slots = int(rng.integers(1, 5))
    anchors = int(rng.choice([1, 2, 5, 12, 24]))
    content = make_content(
        anchors,
        seed,
        make_dimensions(slots, _random_groups(rng), residual_dim=int(rng.integers(1, 65))),
        kept=float(rng.choice([0, 0.3, 0.8, 1])),
        blocks=int(rng.integers(3)),
        hidden=int(rng.integers(1, 6)),
    )
    moved = content.coordinates * rng.integers(1, 2000) + rng.integers(-(2**20), 2**20, 3)
    return replace(
        content,
        coordinates=moved.astype(np.int32) if rng.random() < 0.5 else content.coordinates,
        groups=tuple(replace(g, symbols=_with_escapes(rng, g.symbols, content)) for g in content.groups),
        world_offset=tuple(rng.normal(0, 1e6, 3).tolist()),
        viewpoints=_random_viewpoints(rng) if rng.random() < 0.5 else None,
    )


def _random_groups(rng: np.random.Generator) -> tuple[GroupShape, ...]:
    parts = [(Role.REFERENCE, c) for c in _split(rng, int(rng.integers(1, 7)))]
    parts += [(Role.LOG_SCALES, c) for c in _split(rng, 6)]
    parts += [(Role.RESIDUAL, c) for c in _split(rng, int(rng.integers(0, 5)))]
    parts += [(Role.SIDE, int(rng.integers(1, 4))) for _ in range(int(rng.integers(3)))]
    groups: list[GroupShape] = []
    for role, channels in [parts[i] for i in rng.permutation(len(parts))]:
        steps = tuple(rng.uniform(0.01, 2, rng.choice([1, channels])).astype(np.float32).tolist())
        before = [j for j, group in enumerate(groups) if group.role != Role.RESIDUAL and rng.random() < 0.4]
        sees = bool(rng.random() < 0.4)
        around = role != Role.RESIDUAL and bool(rng.random() < 0.4)
        groups.append(
            GroupShape(role, channels, () if role == Role.SIDE else steps, tuple(before), sees, around)
        )
    return tuple(groups)


def _split(rng: np.random.Generator, total: int) -> list[int]:
    parts = []
    while total > 0:
        parts.append(int(rng.integers(1, total + 1)))
        total -= parts[-1]
    return parts


def _with_escapes(rng: np.random.Generator, symbols: np.ndarray, content: FileContent) -> np.ndarray:
    far = rng.choice([-LARGEST_SYMBOL, LARGEST_SYMBOL, 12345, -777], symbols.shape)
    changed = np.where(rng.random(symbols.shape) < 0.05, far, symbols)
    return (changed * content.mask[:, :, None] if symbols.ndim == 3 else changed).astype(np.int32)


def _random_viewpoints(rng: np.random.Generator) -> Viewpoints:
    views = []
    for _ in range(int(rng.integers(1, 5))):
        w, x, y, z = (rng.normal(size=4) * (rng.random(4) < 0.7) + 1e-3).tolist()
        length = float(np.linalg.norm((w, x, y, z)))
        center = tuple(rng.normal(0, 5, 3).tolist())
        views.append(
            Viewpoint((w / length, x / length, y / length, z / length), center, 640, 480, 500.0, 501.5)
        )
    return Viewpoints((0.0, -0.6, 0.8), tuple(views))


def levels_of(content: FileContent, rng: np.random.Generator) -> list[int]:
    """Some choice of ranges, none of which is empty."""
    offsets = content.coordinates - content.coordinates.min(axis=0) // 16 * 16
    depth = int(offsets.max()).bit_length()
    order = plain_decoder.canonical([tuple(v) for v in offsets.tolist()], depth)
    levels = sorted({level for level, _ in order})[:-1]
    chosen = [level for level in levels if rng.random() < 0.3]
    return [*chosen[: plain_decoder.MAX_RANGES - 1], depth]


@pytest.mark.parametrize("seed", range(16))
def test_any_content_decodes_to_the_same_integers_and_so_does_any_beginning_of_its_file(seed: int) -> None:
    content = random_content(seed)
    data = write_content(content, levels=levels_of(content, np.random.default_rng(seed)))
    assert outcome(data, False) == "decoded"
    sections = sections_of(data)
    first = [number for number, _ in sections].index(LATENTS)
    for i, end in enumerate(ends(sections)):
        assert outcome(data[:end], True) == ("decoded" if i >= first else "TruncatedSection")
        if i < first + 2:
            assert outcome(data[: end - 1], True) == ("decoded" if i > first else "TruncatedSection")


@pytest.mark.parametrize("residual", [0, 2])
@pytest.mark.parametrize("blocks", [0, 2])
def test_the_chain_of_the_paper_decodes_to_the_same_integers(residual: int, blocks: int) -> None:
    groups = paper_groups(5, residual, 1, 2)
    content = make_content(120, 11, make_dimensions(3, groups, "separate"), kept=0.6, blocks=blocks)
    content.coordinates[::2] = 4 * content.coordinates[::2] + 4000  # a coarser cloud beside the fine one
    assert outcome(write_content(content), False) == "decoded"


# golden files --------------------------------------------------------------------------------------------------------

ROLES = ("side", "reference", "log scales", "residual")


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_golden_files_decode_to_the_pinned_hashes(path: Path) -> None:
    def sha256(values: list, kind: str) -> str:
        return hashlib.sha256(np.array(values).astype(kind).tobytes()).hexdigest()

    data = path.read_bytes()
    assert outcome(data, False) == "decoded"
    found = plain_decoder.decode(data)
    hashes = {
        "file": hashlib.sha256(data).hexdigest(),
        "coordinates": sha256(found["coordinates"], "<i4"),
        "mask": sha256(found["mask"], "u1"),
    }
    for i, group in enumerate(found["groups"]):
        for kind in ("symbols", "latents"):
            hashes[f"group {i}, {ROLES[group['role']]}: {kind}"] = sha256(group[kind], "<i4")
    assert hashes == json.loads((GOLDEN / "hashes.json").read_text(encoding="utf-8"))[path.stem]


# what is refused -----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def small() -> bytes:
    """Three ranges of latents."""
    content = make_content(16, 5, make_dimensions(2, paper_groups(3, 2, 1, 1)), kept=0.7)
    depth = levels_of(content, np.random.default_rng(0))[-1]
    return write_content(content, levels=[1, 2, depth])


def test_the_header_is_refused_in_the_order_of_the_document(small: bytes) -> None:
    sections = sections_of(small)
    head = 11 + 9 * len(sections)
    first = [number for number, _ in sections].index(LATENTS)
    without = [[s for s in sections if s[0] != number] for number in (1, 2, 4, 5, 6, 7, 8)]
    flipped = bytearray(small)
    flipped[9] ^= 1
    cases = [
        (b"", "TruncatedSection"),
        (small[:3], "TruncatedSection"),
        (b"\x93C\0", "NotACompGSFile"),
        (small[:4] + b"\1", "TruncatedSection"),  # of another version, but too short to say so
        (small[:4] + b"\1" + small[5:7], "UnsupportedVersion"),
        (small[: head - 1], "TruncatedSection"),
        (bytes(flipped), "CorruptSection"),
        (file_of(sections, flags=1), "CorruptSection"),
        (file_of([(9, b""), *sections], flags=1), "CorruptSection"),
        (file_of([(9, b""), *sections]), "UnsupportedVersion"),
        (file_of([*sections, (0, b"")]), "UnsupportedVersion"),
        (file_of(sections + [(140 + i, b"") for i in range(65 - len(sections))]), "CorruptSection"),
        (file_of(sections + [(9, b"")] * (65 - len(sections))), "CorruptSection"),
        (file_of(sections + [(140 + i, b"") for i in range(64 - len(sections))]), "decoded"),
        (file_of([*sections, (200, b"a"), (200, b"b")]), "CorruptSection"),
        (file_of([(200, b"a"), *sections]), "decoded"),
        (file_of([sections[2], *sections[:2], *sections[3:]]), "CorruptSection"),
        *[(file_of(kept), "CorruptSection") for kept in without],
        (file_of([*sections[:2], (3, b""), *sections[2:]]), "CorruptSection"),
        (file_of([sections[0], (3, sections[1][1]), *sections[2:]]), "MissingDependency"),
        (file_of(sections[:first] + [sections[first]] * 23), "CorruptSection"),
        (small[:-1], "TruncatedSection"),
        (small[:-1] + bytes([small[-1] ^ 1]), "CorruptSection"),
        (small + b"\0", "CorruptSection"),
    ]
    for data, expected in cases:
        try:
            plain_decoder.decode(data)
            found = "decoded"
        except plain_decoder.Refused as refused:
            found = type(refused).__name__
        assert found == expected
        if expected != "MissingDependency":  # the package may have G-PCC
            assert outcome(data, False) == expected


def test_a_prefix_takes_what_is_there_before_the_first_section_that_is_not(small: bytes) -> None:
    sections = sections_of(small)
    first = [number for number, _ in sections].index(LATENTS)
    optional = (200, b"abc")
    behind = [*sections[: first + 1], optional, *sections[first + 1 :]]
    end = ends(behind)[first + 1]
    assert outcome(file_of(behind)[: end - 1], True) == "decoded"
    damaged = bytearray(file_of(behind)[:end])
    damaged[-1] ^= 1
    assert outcome(bytes(damaged), True) == "CorruptSection"
    before = [*sections[:first], optional, *sections[first:]]
    assert outcome(file_of(before)[: ends(before)[first] - 1], True) == "TruncatedSection"
    assert outcome(small + b"\0", True) == "CorruptSection"


@pytest.mark.parametrize("seed", range(6))
def test_damage_behind_right_checksums_is_refused_alike(small: bytes, seed: int) -> None:
    rng = np.random.default_rng(seed)
    for _ in range(20):
        sections = sections_of(small)
        i = int(rng.integers(len(sections)))
        number, payload = sections[i]
        changed = bytearray(payload)
        at = int(rng.integers(len(changed)))
        kind = rng.integers(3)
        if kind == 0:
            changed[at] ^= 1 << int(rng.integers(8))
        elif kind == 1:
            del changed[at]
        else:
            changed.insert(at, int(rng.integers(256)))
        sections[i] = (number, bytes(changed))
        assert outcome(file_of(sections), False) in ("decoded", "CorruptSection")


def test_work_for_the_heads_is_paid_for_by_the_length_of_the_file() -> None:
    content = make_content(
        70, 1, make_dimensions(64, paper_groups(2, 1, 1, 1), width=1), kept=1, symbols=False
    )
    heads = (("a", QuantizedTensor(np.zeros((600, 500), np.int32), 6)),)
    sections = dict(sections_of(write_content(replace(content, heads=heads))))
    assert PADDING in sections
    n = -(-(70 * 64 * 600 * 500 - 2**30) // 2**17)
    gaussian = plain_decoder.gaussian_tables()
    found = plain_decoder.read_heads(sections[7], 70 * 64, n, gaussian)
    assert found["a"] == {"shape": [600, 500], "exponent": 6, "values": [0] * 300_000}
    with pytest.raises(plain_decoder.CorruptSection, match="products"):
        plain_decoder.read_heads(sections[7], 70 * 64, n - 1, gaussian)


def test_rotations_are_refused_where_the_largest_component_cannot_be() -> None:
    data = encode_viewpoints(Viewpoints((0, 0, 1), (Viewpoint((1, 0, 0, 0), (0, 2, 3), 640, 480, 500, 501),)))
    cases = [
        ((11585, 11585, -11585), True),
        ((11586, 11586, 11586), False),
        ((11336, 11615, 11800), True),  # squares: 3 x 2^27 - 63
        ((11413, 11767, 11573), False),  # 3 x 2^27 + 3
        ((-16383, 0, 0), True),
        ((-16384, 0, 0), False),
    ]
    for numbers, legal in cases:
        bits = sum((v & 0x7FFF) << (2 + 15 * i) for i, v in enumerate(numbers))
        changed = data[:-6] + bits.to_bytes(6, "little")
        if legal:
            assert_same_viewpoints(plain_decoder.read_viewpoints(changed), decode_viewpoints(changed, "v"))
            continue
        with pytest.raises(plain_decoder.CorruptSection, match="rotation"):
            plain_decoder.read_viewpoints(changed)
        with pytest.raises(CompGSError, match="rotation"):
            decode_viewpoints(changed, "v")
