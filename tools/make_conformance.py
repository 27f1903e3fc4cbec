"""Writes conformance/: files that a decoder must refuse, unusual ones that it must read, pictures; and the outcomes.

    python tools/make_conformance.py

Run it after make_golden_files.py. Each file that must be refused breaks one rule of docs/bitstream.md and keeps all
others, checksums included. Before it is written, the package and the independent decoder (plain_decoder.py) must both
refuse it by the name that is expected.
"""

import hashlib
import json
import shutil
import struct
import sys
import zlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from compgs.cameras import Camera
from compgs.codec import mask_coder, writer
from compgs.codec.content import FileContent, GroupShape, Role
from compgs.codec.decoder import decode, from_latents
from compgs.codec.fields import FieldReader, signed_varint, varint
from compgs.codec.format import (
    HEADS,
    LATENTS,
    MASKS,
    METADATA,
    NETWORKS,
    OPTIONAL,
    PADDING,
    POSITIONS,
    SCENE,
    TABLES,
    VIEWPOINTS,
    Section,
    pack,
    section_ends,
    unpack,
)
from compgs.codec.integer_network import Follow, IntegerLayer, IntegerNetwork
from compgs.codec.latents import read_head
from compgs.codec.mask_coder import encode_masks
from compgs.codec.octree import encode_positions
from compgs.codec.reader import read_content, read_latents
from compgs.codec.rows import RowContext
from compgs.codec.sections import encode_tables
from compgs.codec.tables import HyperTable
from compgs.codec.viewpoints import Viewpoint, Viewpoints
from compgs.codec.weights import QuantizedTensor, encode_heads, encode_known_heads, encode_networks
from compgs.codec.writer import write_content
from compgs.errors import BitstreamError
from compgs.metrics import to_8bit
from compgs.render import render
from compgs.tensors.scenes import HybridOnDevice

ROOT = Path(__file__).parent.parent
CONFORMANCE = ROOT / "conformance"
GOLDEN = ROOT / "tests" / "golden"
sys.path += [str(ROOT / "tools"), str(ROOT / "benchmarks")]
import plain_decoder  # noqa: E402
from made_content import make_content, make_dimensions, paper_groups  # noqa: E402
from make_golden_files import DILATION, hashes  # noqa: E402

CORRUPT, TRUNCATED = "CorruptSection", "TruncatedSection"
NOT_OURS, UNSUPPORTED = "NotACompGSFile", "UnsupportedVersion"

# Of the scene section: where its fields are (docs/bitstream.md, "Scene"), in version 5.
ANCHORS, COUPLED, SLOTS, RESIDUAL_DIM, LAYOUT, WIDTH = 0, 4, 8, 9, 10, 11
VOXEL_SIZE, WORLD_OFFSET, DISTANCE, BACKGROUND, ANGULAR_DILATION, GROUPS = 13, 21, 45, 53, 65, 69

VIEWS = Viewpoints(
    up=(0.0, -0.6, 0.8),
    views=(
        Viewpoint((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, -3.0), 64, 48, 50.0, 51.0),
        Viewpoint((0.5, -0.5, 0.5, 0.5), (2.0, 0.25, 1.0), 64, 48, 50.0, 51.0),
    ),
)
SMALL_GROUPS = (
    GroupShape(Role.SIDE, 2),
    GroupShape(Role.REFERENCE, 3, (0.5,), (0,), sees_neighbours=True),
    GroupShape(Role.LOG_SCALES, 6, (0.25,), (1,), sees_coordinates=True),
    GroupShape(Role.RESIDUAL, 2, (0.5, 1.0), (1,)),
)
LEVELS = [2, 4, 6]  # of its ranges


@dataclass(frozen=True)
class Case:
    """A file, and why a decoder refuses it."""

    data: bytes
    error: str
    why: str
    prefix: int | None = None  # decoded from so many of its bytes
    # The plain decoder takes minutes, or leaves it to whoever makes a scene of the tensors.
    ours_alone: bool = False


Sections = list[Section]


def small() -> FileContent:
    """A content of version 5 with something of everything, and few bytes."""
    d = make_dimensions(2, SMALL_GROUPS, width=2)
    content = make_content(
        24, 21, d, kept=0.7, blocks=1, hidden=3, angular_dilation=DILATION, row_context=True
    )
    return replace(content, viewpoints=VIEWS)


def small_sections() -> Sections:
    return unpack(write_content(small(), levels=LEVELS))


def put(
    sections: Sections, number: int, change: Callable[[bytes], bytes] | bytes, which: int = 0
) -> Sections:
    """With the payload of a section changed, or replaced."""
    places = [i for i, section in enumerate(sections) if section.number == number]
    at = places[which]
    payload = change if isinstance(change, bytes) else change(sections[at].data)
    return [*sections[:at], Section(number, payload), *sections[at + 1 :]]


def without(sections: Sections, *numbers: int) -> Sections:
    return [section for section in sections if section.number not in numbers]


def at(place: int, replacement: bytes, taken: int | None = None) -> Callable[[bytes], bytes]:
    """Replaces `taken` bytes at a place, as many as the replacement has if not given."""
    size = len(replacement) if taken is None else taken

    def change(data: bytes) -> bytes:
        place_ = place if place >= 0 else len(data) + place
        return data[:place_] + replacement + data[place_ + size :]

    return change


def with_header(data: bytes, place: int, value: int) -> bytes:
    """With a byte of the header changed, and its checksum made right."""
    end = 7 + 9 * data[6]
    head = bytearray(data[:end])
    head[place] = value
    return bytes(head) + struct.pack("<I", zlib.crc32(bytes(head))) + data[end + 4 :]


# ---- what is refused


def refused() -> dict[str, Case]:
    sections = small_sections()
    whole = pack(sections, 5)
    tiny = (GOLDEN / "tiny.cgs").read_bytes()
    cases: dict[str, Case] = {}

    def add(
        name: str,
        data: bytes | Sections,
        why: str,
        error: str = CORRUPT,
        prefix: int | None = None,
        **more: bool,
    ) -> None:
        assert name not in cases
        data = pack(data, 5) if isinstance(data, list) else data
        cases[name] = Case(data, error, why, prefix, **more)

    _header(add, sections, whole)
    _scene(add, sections)
    _positions_and_masks(add, sections)
    _tables(add, sections)
    _networks(add, sections)
    _heads(add, sections, unpack(tiny))
    _latents(add, sections)
    _optional(add, sections)
    _limits(add)
    _prefixes(add, sections, whole)
    return cases


def _header(add: Callable, sections: Sections, whole: bytes) -> None:
    count = len(sections)
    add("empty", b"", "no bytes at all", TRUNCATED)
    add("magic_cut", whole[:3], "ends within the magic number", TRUNCATED)
    add("start_cut", whole[:6], "ends before the number of sections", TRUNCATED)
    add("not_ours", b"ply\nformat ascii 1.0\n", "other first bytes", NOT_OURS)
    add("magic_wrong", b"\x93CGT" + whole[4:], "the fourth byte of the magic number", NOT_OURS)
    add("version_1", with_header(whole, 4, 1), "version 1", UNSUPPORTED)
    add("version_6", with_header(whole, 4, 6), "version 6", UNSUPPORTED)
    add("header_cut", whole[: 10 + 9 * count], "ends within the header's checksum", TRUNCATED)
    add("header_crc", whole[:9] + bytes([whole[9] ^ 1]) + whole[10:], "the header's checksum")
    add("flags", with_header(whole, 5, 1), "a reserved flag")
    more = [Section(OPTIONAL + 10 + i, b"") for i in range(65 - count)]
    add("sections_65", sections + more, "65 sections")
    add("section_0", [Section(0, b""), *sections], "an unknown section below 0x80: 0", UNSUPPORTED)
    add("section_127", [*sections, Section(127, b"")], "an unknown section below 0x80: 127", UNSUPPORTED)
    masks = next(section for section in sections if section.number == MASKS)
    add("sections_order", [masks, *without(sections, MASKS)], "masks before the scene")
    add(
        "sections_twice",
        [*sections, Section(200, b"a"), Section(200, b"b")],
        "an unknown optional section twice",
    )
    for number, name in ((SCENE, "scene"), (POSITIONS, "positions"), (MASKS, "masks"), (TABLES, "tables")):
        add(f"without_{name}", without(sections, number), f"no section of {name}")
    for number, name in ((NETWORKS, "networks"), (HEADS, "heads"), (LATENTS, "latents")):
        add(f"without_{name}", without(sections, number), f"no section of {name}")
    places = [section.number for section in sections].index(MASKS)
    both = [*sections[:places], Section(3, b""), *sections[places:]]
    add("positions_twice", both, "sections 2 and 3")
    latents = [section for section in sections if section.number == LATENTS]
    add("ranges_23", [*without(sections, LATENTS), *[latents[0]] * 23], "23 sections of latents")
    add("file_cut", whole[:-1], "the last byte is missing", TRUNCATED)
    add("section_crc", whole[:-1] + bytes([whole[-1] ^ 1]), "the checksum of the last section")
    add("file_longer", whole + b"\0", "a byte after the last section")
    damaged = bytearray(whole)
    damaged[section_ends(whole)[0][1] - 1] ^= 1
    add("crc_before_cut", bytes(damaged[:-1]), "a wrong checksum before the section that is cut")


def _scene(add: Callable, sections: Sections) -> None:
    def scene(name: str, place: int, replacement: bytes, why: str, taken: int | None = None) -> None:
        add(f"scene_{name}", put(sections, SCENE, at(place, replacement, taken)), why)

    nan, infinity = struct.pack("<d", np.nan), struct.pack("<d", np.inf)
    scene("anchors_0", ANCHORS, struct.pack("<I", 0), "no anchors")
    scene("anchors_many", ANCHORS, struct.pack("<I", 2**24 + 1), "more than MAX_ANCHORS")
    scene("coupled_many", COUPLED, struct.pack("<I", 49), "more coupled primitives than slots")
    scene(
        "coupled_other",
        COUPLED,
        struct.pack("<I", 1),
        "another number of coupled primitives than the masks have",
    )
    scene("slots_0", SLOTS, b"\0", "no slots")
    scene("slots_65", SLOTS, bytes([65]), "65 slots")
    scene("residual_dim_0", RESIDUAL_DIM, b"\0", "residual_dim 0")
    scene("residual_dim_65", RESIDUAL_DIM, bytes([65]), "residual_dim 65")
    scene("residual_dim_other", RESIDUAL_DIM, bytes([3]), "residual_dim is not that of the groups")
    scene("heads_3", LAYOUT, b"\3", "heads 3")
    scene("width_0", WIDTH, b"\0\0", "width 0")
    scene("width_1025", WIDTH, struct.pack("<H", 1025), "width 1025")
    scene("voxel_size_0", VOXEL_SIZE, bytes(8), "voxel_size 0")
    scene("voxel_size_nan", VOXEL_SIZE, nan, "voxel_size is not a number")
    scene("voxel_size_tiny", VOXEL_SIZE, struct.pack("<d", 2.0**-65), "voxel_size below SMALLEST")
    scene("world_offset_nan", WORLD_OFFSET + 8, nan, "world_offset is not a number")
    scene("world_offset_large", WORLD_OFFSET, struct.pack("<d", -(2.0**65)), "world_offset beyond LARGEST")
    scene("distance_infinite", DISTANCE, infinity, "view_distance_scale is infinite")
    scene("background_infinite", BACKGROUND + 4, struct.pack("<f", np.inf), "background is infinite")
    scene("dilation_0", ANGULAR_DILATION, bytes(4), "angular_dilation 0")
    scene("dilation_large", ANGULAR_DILATION, struct.pack("<f", 1.0001), "angular_dilation above 1")
    scene("groups_0", GROUPS, b"\0", "no groups")
    scene("groups_17", GROUPS, bytes([17]), "17 groups")
    scene("role_4", GROUPS + 1, b"\4", "role 4")
    scene("channels_0", GROUPS + 2, b"\0", "a group without channels")
    scene("channels_65", GROUPS + 2, bytes([65]), "65 channels of a side group")
    scene("context_later", GROUPS + 3, b"\4", "the first group takes the second")
    scene("steps_side", GROUPS + 4, b"\1" + struct.pack("<f", 1.0), "a side group with a step", 1)
    scene("varint_long", GROUPS + 2, b"\x82\0", "a varint whose last byte is 0", 1)
    second = GROUPS + 5
    scene("steps_2", second + 3, b"\2" + struct.pack("<2f", 1, 1), "two steps for three channels", 5)
    scene("steps_0", second + 3, b"\0", "no steps for three channels", 5)
    scene("step_0", second + 4, bytes(4), "a step of 0")
    scene("step_nan", second + 4, struct.pack("<f", np.nan), "a step that is not a number")
    scene("references_none", second, b"\0\3\6\0", "no group of references", 8)
    third = second + 8
    scene("log_scales_5", third + 1, b"\5", "five log scales")
    last = third + 8
    scene("residual_neighbours", last + 2, b"\x14", "residuals that see neighbours")
    scene("longer", 10**6, b"\0", "a byte after the last field", 0)
    scene("shorter", -1, b"", "the last byte is missing", 1)
    many = (
        *[GroupShape(Role.REFERENCE, channels, (1.0,), (), True) for channels in (200, 57)],
        SMALL_GROUPS[2],
    )
    content = make_content(
        2, 1, make_dimensions(1, many, width=1, residual_dim=1), kept=2.0, angular_dilation=DILATION
    )
    add("scene_references_257", _unchecked(content), "257 channels of references")


def _positions_and_masks(add: Callable, sections: Sections) -> None:
    content = read_content(pack(sections, 5))
    positions = next(section.data for section in sections if section.number == POSITIONS)

    def placed(name: str, payload: bytes, why: str) -> None:
        add(f"positions_{name}", put(sections, POSITIONS, payload), why)

    placed("empty", b"", "no bytes")
    placed("depth_22", bytes([22]) + positions[1:], "depth 22")
    placed("depth_1", b"\1" + positions[1:], "more anchors than the octree has room for")
    placed("longer", positions + b"\0", "a byte behind the code")
    placed("shorter", positions[:-1], "the code's last byte is missing")
    placed("end", positions[:-1] + bytes([positions[-1] ^ 1]), "the code does not end as an encoder ends it")
    placed("fewer", encode_positions(content.coordinates[:-1]), "one anchor fewer than the scene says")
    extra = content.coordinates.max(0, keepdims=True) - np.array([[0, 0, 1]], np.int32)
    placed(
        "more", encode_positions(np.concatenate([content.coordinates, extra])), "one more than the scene says"
    )
    start = 1
    for _ in range(3):
        while positions[start] & 128:
            start += 1
        start += 1
    far = signed_varint(2**27 - 1) * 3
    placed("beyond_32_bits", positions[:1] + far + positions[start:], "coordinates beyond 32 bits")
    placed("origin_5_bytes", positions[:1] + varint(2**28) + positions[2:], "an origin of five bytes")
    placed("origin_long", positions[:1] + b"\x80\0" + positions[2:], "an origin with a needless byte")
    masks = next(section.data for section in sections if section.number == MASKS)
    add("masks_longer", put(sections, MASKS, masks + b"\0"), "a byte behind the code")
    add("masks_shorter", put(sections, MASKS, masks[:-1]), "the code's last byte is missing")
    other = content.mask.copy()
    other[0] = ~other[0]
    if other.sum() == content.mask.sum():
        other[1] = ~other[1]
    add("masks_other", put(sections, MASKS, encode_masks(other)), "another number of coupled primitives")
    flags = np.ones((2, 1), np.uint8)
    buffer = np.zeros(16, np.uint8)
    ones = buffer[: mask_coder._code_flags(buffer, flags, False)].tobytes()
    d = make_dimensions(1, paper_groups(1, 0, 1), width=1, residual_dim=1)
    full = unpack(write_content(make_content(2, 3, d, kept=2.0, angular_dilation=DILATION)))
    add("masks_all_ones", put(full, MASKS, ones), "masks of ones that are written out")


def _tables(add: Callable, sections: Sections) -> None:
    tables = next(section.data for section in sections if section.number == TABLES)
    ours = read_content(pack(sections, 5)).groups[0].prior
    assert isinstance(ours, tuple)

    def changed(name: str, payload: bytes, why: str) -> None:
        add(f"tables_{name}", put(sections, TABLES, payload), why)

    levels = ours[0].levels.astype(np.int32)
    changed("entries_1", b"\1" + tables[1:], "a table of the escape alone")
    changed("entries_1026", varint(1026) + tables[1:], "a table of 1 026 entries")
    wide = replace(ours[0], lowest=2**18 + 1)
    changed("lowest", encode_tables([wide, *ours[1:]]), "a lowest symbol beyond MAX_LOWEST")
    for value in (-1, 128):
        levels[1] = value
        table = HyperTable(ours[0].lowest, levels.copy())
        changed(
            f"level_{value}".replace("-", "minus_"), encode_tables([table, *ours[1:]]), f"a level of {value}"
        )
    changed("longer", tables + b"\0", "a byte after the low parts")
    changed("empty", b"", "no tables for a group that has some")
    changed("table_128", _with_array_table(tables, ours), "an array with table 128")


def _with_array_table(tables: bytes, ours: tuple[HyperTable, ...]) -> bytes:
    start = sum(len(varint(len(t.levels))) + len(signed_varint(t.lowest)) for t in ours)
    return tables[:start] + bytes([128]) + tables[start + 1 :]


def _networks(add: Callable, sections: Sections) -> None:
    content = read_content(pack(sections, 5))
    networks = [g.prior for g in content.groups if isinstance(g.prior, IntegerNetwork)]
    payload = next(section.data for section in sections if section.number == NETWORKS)

    def forged(name: str, why: str, change: Callable[[bytes], bytes]) -> None:
        add(f"networks_{name}", put(sections, NETWORKS, change), why)

    def coded(name: str, why: str, first: IntegerNetwork, which: int = 0) -> None:
        others = [*networks[:which], first, *networks[which + 1 :]]
        add(f"networks_{name}", put(sections, NETWORKS, encode_networks(others)), why)

    # The first network: layers 4, flags 3; then of each layer width and flags; follow_shift, inertia.
    assert payload[:2] == b"\4\3"
    forged("layers_0", "no layers", at(0, b"\0"))
    forged("layers_9", "nine layers", at(0, b"\x09"))
    forged("flags", "an unknown flag of a network", at(1, b"\x07"))
    forged("width_0", "a layer without outputs", at(2, b"\0"))
    forged("shift_31", "a shift of 31", at(3, bytes([31])))
    forged("bit_5", "bit 5 of a layer's flags", at(3, bytes([payload[3] | 32])))
    forged("adds_first", "the first layer adds", at(3, bytes([payload[3] | 64])))
    forged("adds_last", "the last layer adds", at(9, bytes([payload[9] | 64])))
    forged(
        "width_last", "the last layer has other outputs than the group needs", at(8, bytes([payload[8] + 2]))
    )
    forged("follow_shift_31", "a follow_shift of 31", at(10, bytes([31])))
    forged("inertia_64", "an inertia of 64", at(11, bytes([64])))
    forged("longer", "a byte after the low parts", lambda data: data + b"\0")
    forged("shorter", "the last low parts are missing", lambda data: data[:-1])
    n = networks[0]
    first = n.layers[0]
    heavy = first.weight.copy()
    heavy[0, 0] = -(-(2**52) // (2**23 * heavy.shape[1]))
    coded(
        "weight", "a weight with which sums could leave 52 bits", _with_layer(n, replace(first, weight=heavy))
    )
    bias = first.bias.copy()
    bias[0] = -(2**31)
    coded("bias", "a bias of -2^31", _with_layer(n, replace(first, bias=bias)))
    assert n.follow is not None and n.rows.chain is not None
    follow = Follow(n.follow.weight.copy(), n.follow.shift)
    follow.weight[0] = 2**28  # behind its checks
    coded("follow", "an element of follow of 2^28", replace(n, follow=follow))
    rows = RowContext(n.rows.chain.copy(), n.rows.inertia)
    assert rows.chain is not None
    rows.chain[-1] = -(2**12)
    coded("chain", "an element of the chain of -2^12", replace(n, rows=rows))
    old = unpack((GOLDEN / "tiny.cgs").read_bytes())
    chained = put(old, NETWORKS, at(1, b"\2"))
    add("networks_chain_version_2", pack(chained, 2), "a chain in a file of version 2")
    skip = put(old, NETWORKS, at(1, b"\1"))
    add("networks_skip_single", pack(skip, 2), "a skip of a single layer")


def _with_layer(network: IntegerNetwork, layer: IntegerLayer) -> IntegerNetwork:
    """The network with another first layer, unchecked."""
    changed = replace(network)
    object.__setattr__(changed, "layers", (layer, *network.layers[1:]))
    return changed


def _heads(add: Callable, sections: Sections, old: Sections) -> None:
    content = read_content(pack(sections, 5))
    tensors = [tensor for _, tensor in content.heads]
    add("heads_exponent", put(sections, HEADS, at(0, signed_varint(63), 1)), "an exponent of 63")
    add("heads_fewer", put(sections, HEADS, encode_known_heads(tensors[:-1])), "one tensor too few")
    more = [*tensors, QuantizedTensor(np.ones((2, 2), np.int32), 3)]
    add("heads_more", put(sections, HEADS, encode_known_heads(more)), "one tensor too many")
    add("heads_longer", put(sections, HEADS, lambda data: data + b"\0"), "a byte after the low parts")
    named = list(read_content(pack(old, 2)).heads)

    def with_names(name: str, why: str, heads: list[tuple[str, QuantizedTensor]]) -> None:
        add(f"heads_{name}", pack(put(old, HEADS, encode_heads(heads)), 2), why, ours_alone=True)

    def spelled(name: str, why: str, change: Callable[[bytes], bytes]) -> None:
        add(f"heads_{name}", pack(put(old, HEADS, change), 2), why)

    with_names("name_missing", "a tensor of the layout is missing", named[1:])
    with_names("name_unknown", "a tensor that is not of the layout", [*named, ("more", named[0][1])])
    swapped = [(name, replace(tensor, values=tensor.values.T.copy())) for name, tensor in named[:1]]
    with_names("shape", "a tensor of another shape", swapped + named[1:])
    shared = [(name, tensor) for name, tensor in named if name != "residuals"]
    with_names("residuals_missing", "no residuals, and no group of them", shared)
    paper = unpack((GOLDEN / "paper.cgs").read_bytes())
    theirs = [
        *read_content(pack(paper, 2)).heads,
        ("residuals", QuantizedTensor(np.ones((10, 8), np.int32), 1)),
    ]
    add(
        "heads_residuals_both",
        pack(put(paper, HEADS, encode_heads(theirs)), 2),
        "residuals, and a group of them",
        ours_alone=True,
    )
    first = named[0][0].encode()
    spelled("name_utf8", "a name that is not UTF-8", lambda data: data.replace(first, b"\xff" + first[1:], 1))
    spelled("name_empty", "a name without bytes", at(1, b"\0\0", 2 + len(first)))
    twice = [("a", named[0][1]), ("b", named[0][1])]
    payload = encode_heads(twice).replace(b"\0\1b", b"\0\1a", 1)
    add(
        "heads_name_shared", pack(put(old, HEADS, payload), 2), "a name that shares fewer bytes than it could"
    )
    spelled("rank_5", "a tensor of five sides", at(3 + len(first), b"\5"))


def _latents(add: Callable, sections: Sections) -> None:
    def changed(name: str, why: str, change: Callable[[bytes], bytes], which: int = 0) -> None:
        add(f"latents_{name}", put(sections, LATENTS, change, which), why)

    ranges = [section.data for section in sections if section.number == LATENTS]
    changed("level_again", "a range of the level of the one before", at(0, ranges[0][:1]), 1)
    changed("level_deep", "a level below the octree", at(0, b"\x15"), 2)
    changed("level_other", "a level that has other anchors", at(0, bytes([ranges[0][0] + 1])))
    add("latents_short", [s for s in sections if s.data != ranges[2]], "the last range is missing")
    changed("anchors", "range_anchors one too many", at(1, bytes([ranges[0][1] + 1])))
    changed("anchors_0", "a range without anchors", at(1, b"\0"))
    changed("coupled", "range_coupled one too many", at(2, bytes([ranges[0][2] + 1])))
    changed("words_1", "a chunk of one word", at(3, b"\1"))
    changed("words_many", "more words than a chunk may have", at(3, b"\x7f"))
    changed("escape_bytes", "more bytes of escapes than symbols may have", at(4, b"\xff\x7f", 1))
    changed("state_low", "a state below 2^31", at(5, bytes(8)))
    changed("state_high", "a state of 2^63", at(5, bytes(7) + b"\x80"))
    changed("state_end", "a state that does not end where it began", at(5, bytes([ranges[0][5] ^ 1])))
    changed("longer", "a byte after the last stream", lambda data: data + b"\0", 2)
    changed("shorter", "the last byte is missing", lambda data: data[:-1], 2)
    far = small()
    far.groups[0].symbols[0, 0] = 2**18 + 1
    add("latents_symbol", _unchecked(far, LEVELS), "a symbol beyond MAX_SYMBOL")
    far.groups[0].symbols[0, 0] = 100
    one_escape = _unchecked(far, LEVELS)
    for name, escape, why in (
        ("long", None, "an escape with a needless byte"),
        ("32_bits", b"\xff\xff\xff\xff\x7f", "an escaped symbol of more than 32 bits"),
        ("6_bytes", b"\x80\x80\x80\x80\x80\x01", "an escape of six bytes"),
    ):
        change = partial(_with_escape, escape=escape)
        add(f"latents_escape_{name}", put(one_escape, LATENTS, change), why)
    chain = small()
    rows = chain.groups[1].prior.rows
    rows.chain[0] = 4000
    chain.groups[1].symbols[0] = (2**18, 0, 0)
    add("latents_step", _unchecked(chain, LEVELS), "a step beyond MAX_SYMBOL")


def _unchecked(content: FileContent, levels: list[int] | None = None) -> Sections:
    """Written without the checks of an encoder."""
    checks = writer.check_content
    writer.check_content = lambda content: None
    try:
        return unpack(write_content(content, levels=levels))
    finally:
        writer.check_content = checks


def _with_escape(latents: bytes, escape: bytes | None) -> bytes:
    """With another varint for the one escape of the first stream, or with its own and a needless byte."""
    reader = FieldReader(latents, "latents")
    read_head(reader)
    words = reader.varint("words", 2, 127)
    start = reader.position
    count = reader.varint("escape_bytes", 1, 5)
    reader.bytes(4 * words, "words")
    own = reader.bytes(count, "escapes")
    new = own[:-1] + bytes([own[-1] | 128, 0]) if escape is None else escape
    return (
        latents[:start]
        + varint(len(new))
        + latents[start + 1 : reader.position - count]
        + new
        + (latents[reader.position :])
    )


def _optional(add: Callable, sections: Sections) -> None:
    def metadata(name: str, payload: bytes, why: str) -> None:
        add(f"metadata_{name}", put(sections, METADATA, payload), why)

    metadata("order", b"\2\1b\0\1a\0", "keys out of order")
    metadata("twice", b"\2\1a\0\1a\0", "a key twice")
    metadata("utf8", b"\1\1\xff\0", "a key that is not UTF-8")
    metadata("surrogate", b"\1\1a\3\xed\xa0\x80", "a surrogate in UTF-8")
    metadata("overlong", b"\1\1a\2\xc0\xaf", "an overlong form in UTF-8")
    metadata("longer", b"\0\0", "a byte after the last entry")
    metadata("large", b"\1\1a" + varint(4095) + bytes(4095), "more than MAX_METADATA_BYTES")
    add("padding", [*sections, Section(PADDING, b"\0\1")], "padding that is not zero")

    def viewpoints(name: str, change: Callable[[bytes], bytes], why: str) -> None:
        add(f"viewpoints_{name}", put(sections, VIEWPOINTS, change), why)

    view = 3 + 16 + 1 + 12 + 1  # the first one
    viewpoints("up_0", at(0, bytes(3)), "up is no direction")
    viewpoints("up_128", at(0, b"\x80"), "up of -128")
    viewpoints("centre", at(3, struct.pack("<f", np.nan)), "centre is not a number")
    viewpoints("radius_0", at(15, bytes(4)), "radius 0")
    viewpoints("lenses_0", at(19, b"\0"), "no lenses")
    viewpoints("lenses_17", at(19, bytes([17])), "17 lenses")
    viewpoints("pixels_0", at(20, b"\0\0"), "a lens without pixels")
    viewpoints("focal_0", at(24, bytes(4)), "a focal length of 0")
    viewpoints("views_0", at(view - 1, b"\0"), "no views")
    viewpoints("lens", at(view, b"\1"), "a lens that is not there")
    viewpoints("position", at(view + 1, struct.pack("<h", -32768)), "a position of -32768")
    viewpoints("bit_47", at(view + 12, b"\x80"), "bit 47 of a rotation")
    half = sum(13000 << (2 + 15 * i) for i in range(3))
    viewpoints(
        "rotation",
        at(view + 7, half.to_bytes(6, "little")),
        "a rotation whose fourth number is not the largest",
    )
    lowest = 0x4000 << 2
    viewpoints(
        "rotation_16384", at(view + 7, lowest.to_bytes(6, "little")), "a number of -16384 in a rotation"
    )
    viewpoints("longer", lambda data: data + b"\0", "a byte after the last view")


def _limits(add: Callable) -> None:
    """Files that are legal but for a limit: without their padding. They are small: a decoder must not try."""

    def unpadded(name: str, content: FileContent, why: str, **more: bool) -> None:
        sections = unpack(write_content(content))
        assert any(s.number == PADDING for s in sections), (name, [(s.number, len(s.data)) for s in sections])
        kept = without(sections, PADDING)
        add(f"limit_{name}", pack(kept, 5), why, **more)

    def scene(
        anchors: int, slots: int, groups: tuple[GroupShape, ...], width: int = 1, mask: bool = False
    ) -> FileContent:
        d = make_dimensions(slots, groups, width=width, residual_dim=1)
        content = make_content(anchors, 1, d, symbols=False, kept=2.0, angular_dilation=DILATION)
        content.mask[:, 1:] &= not mask
        line = np.arange(anchors, dtype=np.int32)[:, None] * np.array([1, 0, 0], np.int32)
        return replace(content, coordinates=line)

    plain = paper_groups(1, 0, 1)
    unpadded("flags", scene(18_000, 64, plain, mask=True), "more flags than the file's length allows")
    side = 32
    grid = np.stack(np.unravel_index(np.arange(30_000), (side,) * 3), 1) * (2**21 // side)
    grid[-1] = 2**21 - 2
    pairs = np.repeat(grid, 2, 0).astype(np.int32)
    pairs[1::2, 2] += 1
    content = replace(scene(60_000, 1, plain), coordinates=pairs)
    unpadded("nodes", content, "more nodes than the file's length allows", ours_alone=True)
    wide = (GroupShape(Role.SIDE, 64), *paper_groups(256, 0, 1)[1:])
    unpadded("symbols", scene(24_000, 1, wide), "more symbols than the file's length allows")
    d = scene(2_000, 1, paper_groups(32, 0, 32))
    million = 4_150_000
    rows = million // 96
    first = IntegerLayer(np.zeros((rows, 32), np.int32), np.zeros(rows, np.int64), 0, True)
    last = IntegerLayer(np.zeros((64, rows), np.int32), np.zeros(64, np.int64), 0, False)
    groups = (d.groups[0], replace(d.groups[1], prior=IntegerNetwork((first, last))), d.groups[2])
    unpadded(
        "network_products", replace(d, groups=groups), "more products of networks than the length allows"
    )
    heavy = scene(4_000, 1, plain, width=600)
    idle = tuple((name, QuantizedTensor(np.zeros_like(tensor.values), 0)) for name, tensor in heavy.heads)
    heavy = replace(heavy, heads=idle)
    unpadded("head_products", heavy, "more products of heads than the file's length allows")


def _prefixes(add: Callable, sections: Sections, whole: bytes) -> None:
    ends = section_ends(whole)
    first = next(end for number, end in ends if number == LATENTS)
    add("prefix_short", whole, "the first range has not arrived", TRUNCATED, first - 1)
    add("prefix_header", whole, "the header has not arrived", TRUNCATED, 40)
    damaged = bytearray(whole)
    damaged[ends[0][1] - 1] ^= 1
    add("prefix_crc_first", bytes(damaged), "a wrong checksum, and a later section that has not arrived",
        CORRUPT, first - 1)  # fmt: skip
    add(
        "prefix_cut_first",
        bytes(damaged),
        "the section has not arrived, wrong as it is",
        TRUNCATED,
        ends[0][1] - 1,
    )
    late = [*sections[:-1], Section(200, b"abc"), sections[-1]]
    data = pack(late, 5)
    spoiled = bytearray(data)
    end = dict(section_ends(data))[200]
    spoiled[end - 1] ^= 1
    add(
        "prefix_behind",
        bytes(spoiled),
        "a section behind the first range has arrived, and is damaged",
        CORRUPT,
        end,
    )


# ---- what is unusual, and read


def unusual() -> dict[str, tuple[bytes, str]]:
    sections = small_sections()
    legal = {
        "small": (pack(sections, 5), "something of everything"),
        "unknown_first": (
            pack([Section(200, b"abc"), *sections], 5),
            "an unknown optional section comes first",
        ),
        "unknown_last": (
            pack([*sections, Section(255, b"")], 5),
            "an unknown optional section without bytes",
        ),
        "optional_between": (_moved(sections), "viewpoints and metadata between the ranges"),
        "optional_none": (pack(without(sections, METADATA, VIEWPOINTS), 5), "no optional sections"),
        "padding": (pack([*sections, Section(PADDING, b"")], 5), "padding without bytes"),
        "metadata_none": (pack(put(sections, METADATA, b"\0"), 5), "metadata without entries"),
        "metadata_empty": (pack(put(sections, METADATA, b"\1\0\0"), 5), "an empty key with an empty value"),
        "metadata_nul": (
            pack(put(sections, METADATA, b"\1\1\0\4\xf4\x8f\xbf\xbf"), 5),
            "NUL and U+10FFFF in UTF-8",
        ),
    }
    one = make_content(1, 2, make_dimensions(2, SMALL_GROUPS, width=2), angular_dilation=DILATION)
    legal["one_anchor"] = (write_content(one), "a single anchor")
    corner = replace(one, coordinates=np.array([[-(2**31), 2**31 - 1, 5]], np.int32))
    legal["corner"] = (write_content(corner), "coordinates at the ends of 32 bits")
    none = make_content(5, 3, make_dimensions(2, SMALL_GROUPS, width=2), kept=-1.0, angular_dilation=DILATION)
    legal["no_coupled"] = (write_content(none), "no coupled primitives at all")
    odd_outputs = GroupShape(Role.REFERENCE, 1, (0.5,), (), True)
    d = make_dimensions(1, (odd_outputs, GroupShape(Role.LOG_SCALES, 6, (0.5,))), width=1, residual_dim=1)
    halves = make_content(4, 4, d, blocks=1, hidden=1, angular_dilation=DILATION)
    legal["empty_arrays"] = (
        write_content(halves),
        "layers with one output: half of their arrays have no elements",
    )
    return legal


def _moved(sections: Sections) -> bytes:
    kept = without(sections, METADATA, VIEWPOINTS)
    optional = [section for section in sections if section.number in (METADATA, VIEWPOINTS)]
    return pack([*kept[:-2], optional[0], kept[-2], optional[1], kept[-1]], 5)


# ---- pictures


def pictures() -> dict[str, tuple[Path, Camera]]:
    """File and camera of each, in the local frame."""
    trained = GOLDEN / "trained.cgs"
    near = decode(trained).viewpoints[1]
    rows = GOLDEN / "rows.cgs"
    pose = np.eye(4)
    pose[2, 3] = 1.25
    wide = Camera(pose, 60.0, 60.0, 40.0, 30.0, 80, 60)
    return {"trained": (trained, near), "rows": (rows, wide)}


def _picture(path: Path, camera: Camera) -> np.ndarray:
    model = replace(HybridOnDevice.of(decode(path), torch.device("cpu")), dtype=torch.float64)
    return to_8bit(render(model, camera).image)


# ---- writing


def check_refused(case: Case) -> None:
    """Both decoders refuse it by that name."""
    data, prefix = (case.data, False) if case.prefix is None else (case.data[: case.prefix], True)
    decoders: list[Callable] = [_scene_of] if case.ours_alone else [_scene_of, plain_decoder.decode]
    for decoder in decoders:
        try:
            decoder(data, prefix)
            found = "decoded"
        except (BitstreamError, plain_decoder.Refused) as error:
            found = type(error).__name__
        assert found == case.error, f"{case.why}: {found}, expected {case.error}"


def _scene_of(data: bytes, prefix: bool) -> None:
    from_latents(*read_latents(data, prefix=prefix))


def main() -> None:
    for folder in ("refused", "unusual", "pictures"):
        shutil.rmtree(CONFORMANCE / folder, ignore_errors=True)
        (CONFORMANCE / folder).mkdir(parents=True)
    expected: dict[str, dict] = {}
    for name, case in refused().items():
        check_refused(case)
        (CONFORMANCE / "refused" / f"{name}.cgs").write_bytes(case.data)
        bytes_ = {} if case.prefix is None else {"bytes": case.prefix}
        expected[name] = {"error": case.error, **bytes_, "why": case.why}
    _write("refused", expected)
    legal = {}
    for name, (data, why) in unusual().items():
        (CONFORMANCE / "unusual" / f"{name}.cgs").write_bytes(data)
        plain_decoder.decode(data)
        legal[name] = {"why": why, "file": hashlib.sha256(data).hexdigest(), **hashes(*read_latents(data))}
    _write("unusual", legal)
    cameras = {}
    for name, (path, camera) in pictures().items():
        Image.fromarray(_picture(path, camera)).save(CONFORMANCE / "pictures" / f"{name}.png", optimize=True)
        numbers = {key: getattr(camera, key) for key in ("fx", "fy", "cx", "cy", "width", "height")}
        pose = camera.moved(decode(path).world_offset).world_to_camera
        cameras[name] = {"file": path.stem, "world_to_camera": pose.tolist(), **numbers}
    _write("pictures", cameras)
    print(f"{len(expected)} refused, {len(legal)} unusual, {len(cameras)} pictures")


def _write(name: str, values: dict) -> None:
    (CONFORMANCE / f"{name}.json").write_text(json.dumps(values, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
