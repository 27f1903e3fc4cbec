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

from compgs.codec.content import FileContent, Group, GroupShape, Role
from compgs.codec.integer_network import IntegerNetwork
from compgs.codec.rans import decode_symbols, encode_symbols
from compgs.codec.reader import read_latents
from compgs.codec.rows import RowContext, Rows, chain_length
from compgs.codec.tables import gaussian_tables
from compgs.codec.viewpoints import Viewpoint, Viewpoints, decode_viewpoints, encode_viewpoints
from compgs.codec.weights import QuantizedTensor, encode_networks
from compgs.codec.writer import write_content
from compgs.config import Heads
from compgs.errors import CompGSError

ROOT = Path(__file__).parents[2]
sys.path += [str(ROOT / "tools"), str(ROOT / "benchmarks")]
import plain_decoder  # noqa: E402
from made_content import make_content, make_dimensions, paper_groups  # noqa: E402

GOLDEN = ROOT / "tests" / "golden"
VERSIONS = range(plain_decoder.OLDEST_VERSION, plain_decoder.VERSION + 1)
FILES = [path for path in sorted(GOLDEN.glob("*.cgs")) if path.read_bytes()[4] in VERSIONS]
SCENE, NETWORKS, HEADS, LATENTS, PADDING = 1, 6, 7, 8, 130
LARGEST_SYMBOL = 2**18
DILATION = 2.0**-20

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
    assert ("separate", "paired", "shallow")[scene["heads"]] == content.heads_layout
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
    """Any groups in any order, few anchors and channels; some symbols far outside what networks and tables expect. Half
    of them with an angular dilation, and so with rows that say something.
    """
    rng = np.random.default_rng(seed)
    dilation = DILATION if seed % 2 else None
    heads: Heads = "shallow" if seed % 3 == 1 else "paired"
    slots = int(rng.integers(1, 5))
    anchors = int(rng.choice([1, 2, 5, 12, 24]))
    content = make_content(
        anchors,
        seed,
        make_dimensions(slots, _random_groups(rng), heads, residual_dim=int(rng.integers(1, 65))),
        kept=float(rng.choice([0, 0.3, 0.8, 1])),
        blocks=int(rng.integers(3)),
        hidden=int(rng.integers(1, 6)),
        angular_dilation=dilation,
    )
    groups = content.groups if dilation is None else tuple(_with_rows(rng, g) for g in content.groups)
    moved = content.coordinates * rng.integers(1, 2000) + rng.integers(-(2**20), 2**20, 3)
    return replace(
        content,
        coordinates=moved.astype(np.int32) if rng.random() < 0.5 else content.coordinates,
        groups=tuple(replace(g, symbols=_with_escapes(rng, g, content)) for g in groups),
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


def _with_rows(rng: np.random.Generator, group: Group) -> Group:
    if not isinstance(group.prior, IntegerNetwork):
        return group
    channels = group.shape.channels
    inertia = int(rng.choice([0, 1, rng.integers(64)]))
    limit = (
        1200 if channels == 2 else 40
    )  # with which no step leaves the format, however large the symbols below
    chain = rng.integers(-limit, limit + 1, chain_length(channels)).astype(np.int32)
    with_chain = channels > 1 and bool(rng.random() < 0.7)
    return _with_context(group, RowContext(chain if with_chain else None, inertia))


def _with_context(group: Group, rows: RowContext) -> Group:
    assert isinstance(group.prior, IntegerNetwork)
    return replace(group, prior=replace(group.prior, rows=rows))


def _with_escapes(rng: np.random.Generator, group: Group, content: FileContent) -> np.ndarray:
    chained = isinstance(group.prior, IntegerNetwork) and group.prior.rows.chain is not None
    values = [12345, -777] if chained else [-LARGEST_SYMBOL, LARGEST_SYMBOL, 12345, -777]
    symbols = group.symbols
    changed = np.where(rng.random(symbols.shape) < 0.05, rng.choice(values, symbols.shape), symbols)
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


@pytest.mark.parametrize("seed", range(24))
def test_any_content_decodes_to_the_same_integers_and_so_does_any_beginning_of_its_file(seed: int) -> None:
    content = random_content(seed)
    data = write_content(content, levels=levels_of(content, np.random.default_rng(seed)))
    assert (data[4] == plain_decoder.VERSION) == (content.angular_dilation is not None)
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


def head_integers(heads: dict, content: FileContent) -> list[int]:
    """The exponent and the integers of each tensor, in the order of version 5."""
    tensors = [heads[name] for name in content.dimensions.head_shapes]
    return [number for tensor in tensors for number in (tensor["exponent"], *tensor["values"])]


def content_of(data: bytes) -> FileContent:
    return read_latents(data)[0]


@pytest.mark.parametrize(
    "path",
    [pytest.param(path, marks=pytest.mark.slow if path.stem == "long" else ()) for path in FILES],
    ids=lambda path: path.stem,
)
def test_golden_files_decode_to_the_pinned_hashes(path: Path) -> None:
    def sha256(values: list, kind: str) -> str:
        return hashlib.sha256(np.array(values).astype(kind).tobytes()).hexdigest()

    data = path.read_bytes()
    found = plain_decoder.decode(data)
    hashes = {
        "file": hashlib.sha256(data).hexdigest(),
        "coordinates": sha256(found["coordinates"], "<i4"),
        "mask": sha256(found["mask"], "u1"),
        "heads": sha256(head_integers(found["heads"], content_of(data)), "<i4"),
    }
    for i, group in enumerate(found["groups"]):
        for kind in ("symbols", "latents"):
            hashes[f"group {i}, {ROLES[group['role']]}: {kind}"] = sha256(group[kind], "<i4")
    assert hashes == json.loads((GOLDEN / "hashes.json").read_text(encoding="utf-8"))[path.stem]


# what is refused -----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def small() -> bytes:
    """Three ranges of latents; of version 2."""
    return write_small(None)


@pytest.fixture(scope="module")
def small_rows() -> bytes:
    """The same of version 5, with a chain and inertia where they may be."""
    return write_small(DILATION)


def write_small(dilation: float | None) -> bytes:
    dimensions = make_dimensions(2, paper_groups(3, 2, 1, 1))
    rows = dilation is not None
    content = make_content(16, 5, dimensions, kept=0.7, angular_dilation=dilation, row_context=rows)
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
        (small[:4] + bytes([plain_decoder.VERSION + 1]) + small[5:7], "UnsupportedVersion"),
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


@pytest.mark.parametrize("name", ["small", "small_rows"])
@pytest.mark.parametrize("seed", range(6))
def test_damage_behind_right_checksums_is_refused_alike(
    name: str, seed: int, request: pytest.FixtureRequest
) -> None:
    data = request.getfixturevalue(name)
    rng = np.random.default_rng(seed)
    for _ in range(20):
        sections = sections_of(data)
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
        assert outcome(file_of(sections, version=data[4]), False) in ("decoded", "CorruptSection")


@pytest.mark.parametrize("name", ["small", "small_rows"])
def test_a_file_that_says_another_version_is_read_by_its_rules(
    name: str, request: pytest.FixtureRequest
) -> None:
    data = request.getfixturevalue(name)
    for version in VERSIONS:
        legal = {2, 3} if data[4] == 2 else {5}  # neither a dilation nor neighbours: 3 is as 2
        expected = "decoded" if version in legal else "CorruptSection"
        assert outcome(file_of(sections_of(data), version=version), False) == expected


# rows ----------------------------------------------------------------------------------------------------------------


def rows_content(channels: int, rows: RowContext, symbols: list[list[int]] | None = None) -> FileContent:
    """Reference embeddings of a group with rows, which no other group depends on, and log scales. symbols: of the
    references of the first anchors; all others are 0.
    """
    groups = (
        GroupShape(Role.REFERENCE, channels, (1.0,), (), sees_coordinates=True),
        GroupShape(Role.LOG_SCALES, 6, (1.0,), (), sees_coordinates=True),
    )
    content = make_content(
        9, 3, make_dimensions(1, groups, width=2, residual_dim=1), angular_dilation=DILATION
    )
    given = np.zeros_like(content.groups[0].symbols)
    given[: len(symbols or [])] = symbols or given[:0]
    reference = _with_context(replace(content.groups[0], symbols=given), rows)
    return replace(content, groups=(reference, content.groups[1]))


def with_forged_rows(content: FileContent, chain: list[int] | None, inertia: int) -> bytes:
    """The content's file, but for what the references' network says of rows, whether that is legal or not."""
    forged = RowContext()
    object.__setattr__(forged, "chain", None if chain is None else np.array(chain, np.int32))
    object.__setattr__(forged, "inertia", inertia)
    first, second = (group.prior for group in content.groups)
    assert isinstance(first, IntegerNetwork) and isinstance(second, IntegerNetwork)
    networks = encode_networks([replace(first, rows=forged), second])
    sections = sections_of(write_content(content))
    return file_of([(n, networks if n == NETWORKS else p) for n, p in sections], plain_decoder.VERSION)


def test_rows_at_the_limits_are_decoded_and_beyond_them_refused() -> None:
    most, limit = plain_decoder.MAX_INERTIA, plain_decoder.CHAIN_LIMIT
    flat = [0, 0, 0]
    cases = [
        (3, flat, most, flat, most, "decoded"),
        (3, flat, most, flat, most + 1, "CorruptSection"),
        (3, flat, most, flat, 255, "CorruptSection"),
        (3, flat, 0, [limit - 1, 0, 1 - limit], 0, "decoded"),
        (3, flat, 0, [limit, 0, 0], 0, "CorruptSection"),
        (3, flat, 0, [0, 0, -limit], 0, "CorruptSection"),
        (3, flat, 0, [-(2**31), 0, 0], 0, "CorruptSection"),
        (3, flat, 0, None, 0, "decoded"),
        (3, flat, 0, [0, 0], 0, "CorruptSection"),
        (3, flat, 0, [0, 0, 0, 0], 0, "CorruptSection"),
        (1, None, most, None, most, "decoded"),
        (1, None, 0, [], 0, "CorruptSection"),  # a chain of one channel
    ]
    for channels, chain, inertia, forged_chain, forged_inertia, expected in cases:
        rows = RowContext(None if chain is None else np.array(chain, np.int32), inertia)
        data = with_forged_rows(rows_content(channels, rows), forged_chain, forged_inertia)
        assert outcome(data, False) == expected, (channels, forged_chain, forged_inertia)


def test_reserved_flags_of_networks_are_refused() -> None:
    """Bit 0 is for several layers, and bit 1 promises an array that is not there; the others have no meaning yet."""
    sections = sections_of(write_content(rows_content(3, RowContext())))
    networks = dict(sections)[NETWORKS]
    assert networks[:2] == b"\1\0"  # one layer, no flags
    for flags in (1, 2, 3, 4, 8, 16, 32, 64, 128, 255):
        changed = networks[:1] + bytes([flags]) + networks[2:]
        data = file_of([(n, changed if n == NETWORKS else p) for n, p in sections], plain_decoder.VERSION)
        assert outcome(data, False) == "CorruptSection", flags


def test_steps_beyond_the_largest_are_refused_as_symbols_are() -> None:
    top = LARGEST_SYMBOL
    cases = [
        ([top, 0, 0], [64, 0, 0], "decoded"),
        ([-top, 0, 0], [-64, 0, 0], "decoded"),
        ([top, 0, 0], [65, 0, 0], "CorruptSection"),
        ([top, 1, 0], [64, 0, 0], "CorruptSection"),
        ([-top, -1, 0], [64, 0, 0], "CorruptSection"),
        ([top, -top, top], [64, 0, 0], "decoded"),  # steps top, 0, top
        ([top, -top, top], [64, 64, 64], "CorruptSection"),  # top, 0, 2 top
        ([top, -top, -top], [64, 64, 64], "decoded"),  # top, 0, 0
        ([top, 0, 0], [4095, 4095, 4095], "CorruptSection"),
        ([0, 0, 1], [4095, 4095, 4095], "decoded"),
    ]
    for symbols, chain, expected in cases:
        content = rows_content(3, RowContext(np.zeros(3, np.int32)), [symbols, [5, -3, 2], symbols])
        assert outcome(with_forged_rows(content, chain, 0), False) == expected, (symbols, chain)


def plain_stream(data: bytes, index: np.ndarray, rows: Rows) -> list[int]:
    fields = plain_decoder.Fields(data, "stream")
    gaussian = plain_decoder.gaussian_tables()
    tables = plain_decoder.Inert(index.tolist(), gaussian, rows.width, rows.inertia)
    symbols = plain_decoder.read_stream(fields, tables)
    fields.end()
    return symbols


@pytest.mark.parametrize("seed", range(8))
def test_streams_with_inertia_decode_to_what_was_encoded(seed: int) -> None:
    """Rows are quiet or loud, and some of their symbols are neither."""
    rng = np.random.default_rng(seed)
    rows = Rows(int(rng.integers(1, 12)), int(rng.integers(1, 64 if seed % 2 else 4)))
    index = rng.integers(0, 128, (60, rows.width)).astype(np.uint8)
    index[::2] = rng.integers(60, 110)
    deviations = np.exp2(index / 12 - 5)
    symbols = rng.standard_normal(index.shape) * deviations * rng.choice([0.05, 0.2, 1, 3, 9], (60, 1))
    sudden = rng.random(index.shape) < 0.1
    symbols[sudden] = rng.standard_normal(int(sudden.sum())) * 2 * deviations[sudden]
    given, tables = np.rint(symbols).astype(np.int32).ravel(), index.ravel()
    data = encode_symbols(given, tables, gaussian_tables(), rows)
    assert np.array_equal(plain_stream(data, tables, rows), given)
    assert np.array_equal(decode_symbols(data, tables, gaussian_tables(), rows=rows), given)


def test_an_escaped_symbol_counts_as_the_most_that_one_can_whatever_its_value() -> None:
    """The zero moves the second table down, so that it does not hold 22, which is below four expected sizes (25.5) of
    the table that the network gives.
    """
    index, given = np.full(3, 96, np.uint8), np.array([0, 22, 3], np.int32)
    data = encode_symbols(given, index, gaussian_tables(), Rows(3, 1))
    assert plain_stream(data, index, Rows(3, 1)) == given.tolist()
    assert np.array_equal(decode_symbols(data, index, gaussian_tables(), rows=Rows(3, 1)), given)


@pytest.mark.slow
def test_a_row_that_two_chunks_share_begins_again_in_the_second() -> None:
    rng = np.random.default_rng(0)
    rows = Rows(7, 3)
    count = plain_decoder.CHUNK_SYMBOLS + 30
    assert plain_decoder.CHUNK_SYMBOLS % rows.width > 1
    index = np.full(count, 40, np.uint8)
    given = np.zeros(count, np.int32)
    given[-60:] = np.rint(3 * rng.standard_normal(60))
    data = encode_symbols(given, index, gaussian_tables(), rows)
    assert np.array_equal(decode_symbols(data, index, gaussian_tables(), rows=rows), given)
    assert np.array_equal(plain_stream(data, index, rows), given)


# work ----------------------------------------------------------------------------------------------------------------


def test_work_for_the_heads_is_paid_for_by_the_length_of_the_file() -> None:
    content = make_content(
        70, 1, make_dimensions(64, paper_groups(2, 1, 1, 1), width=1), kept=1, symbols=False
    )
    heads = (("a", QuantizedTensor(np.zeros((600, 500), np.int32), 6)),)
    found = heads_at_the_limit(write_content(replace(content, heads=heads)), 600 * 500)
    assert found["a"] == {"shape": [600, 500], "exponent": 6, "values": [0] * 300_000}


def test_work_for_heads_without_names_is_paid_for_by_the_length_of_the_file() -> None:
    dimensions = make_dimensions(64, paper_groups(2, 1, 1, 1), width=256)
    content = make_content(70, 1, dimensions, kept=1, symbols=False, angular_dilation=DILATION)
    heads = tuple((name, QuantizedTensor(0 * t.values, t.exponent)) for name, t in content.heads)
    elements = sum(t.values.size for _, t in heads)
    found = heads_at_the_limit(write_content(replace(content, heads=heads)), elements)
    assert [(name, tuple(t["shape"])) for name, t in found.items()] == [(n, t.values.shape) for n, t in heads]


def heads_at_the_limit(data: bytes, elements: int) -> plain_decoder.Tensors:
    """Of a file with 70 anchors and 64 coupled primitives each, as short as it may be; shorter ones are refused."""
    sections = dict(sections_of(data))
    assert PADDING in sections
    n = -(-(70 * 64 * elements - 2**30) // 2**17)
    scene = plain_decoder.read_scene(sections[SCENE], data[4])
    gaussian = plain_decoder.gaussian_tables()
    with pytest.raises(plain_decoder.CorruptSection, match="products"):
        plain_decoder.read_heads(sections[HEADS], data[4], scene, 70 * 64, n - 1, gaussian)
    return plain_decoder.read_heads(sections[HEADS], data[4], scene, 70 * 64, n, gaussian)


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
