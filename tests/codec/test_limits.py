"""A decoder's memory and time are bounded by the file's length: what asks for more is refused before it is done."""

import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from compgs.codec import octree, weights
from compgs.codec.content import FileContent
from compgs.codec.fields import FieldReader
from compgs.codec.format import (
    FLAGS_PER_BYTE,
    FREE_FLAGS,
    FREE_HEAD_PRODUCTS,
    FREE_NETWORK_PRODUCTS,
    FREE_NODES,
    FREE_SYMBOLS,
    HEAD_PRODUCTS_PER_BYTE,
    NETWORK_PRODUCTS_PER_BYTE,
    NODES_PER_BYTE,
    OLDEST_VERSION,
    PADDING,
    SYMBOLS_PER_BYTE,
    Section,
    pack,
    unpack,
    version_of,
)
from compgs.codec.integer_network import IntegerLayer, IntegerNetwork
from compgs.codec.limits import (
    FLAGS,
    HEAD_PRODUCTS,
    NETWORK_PRODUCTS,
    NODES,
    SYMBOLS,
    Limit,
    check_amount,
    least_bytes,
    least_bytes_of_all,
)
from compgs.codec.octree import decode_positions, encode_positions
from compgs.codec.reader import file_info, read_content, read_latents
from compgs.codec.weights import QuantizedTensor
from compgs.codec.writer import write_content
from compgs.errors import CorruptSection
from compgs.ordering.order import walked_nodes

sys.path.append(str(Path(__file__).parents[2] / "benchmarks"))
from made_content import make_content, make_dimensions, paper_groups

MILLIONS = (
    4_150_000  # weights that say nothing: a few hundred bytes of a file, and nearly all that it may hold
)


def idle_network(inputs: int, outputs: int) -> IntegerNetwork:
    """Two layers of zeros, `MILLIONS` of them."""
    width = MILLIONS // (inputs + outputs)
    first = IntegerLayer(np.zeros((width, inputs), np.int32), np.zeros(width, np.int64), 0, True)
    last = IntegerLayer(np.zeros((outputs, width), np.int32), np.zeros(outputs, np.int64), 0, False)
    return IntegerNetwork((first, last))


def idle_scene(anchors: int, *, network: bool = False, heads: bool = False) -> FileContent:
    """Anchors that say nothing, and millions of products to compute for each of them."""
    d = make_dimensions(1, paper_groups(32, 0, 32), width=2, residual_dim=1)
    content = make_content(anchors, 1, d, symbols=False, kept=1.0)
    line = np.arange(anchors, dtype=np.int32)[:, None] * np.array([1, 0, 0], np.int32)
    content = replace(content, coordinates=line)
    if network:
        groups = list(content.groups)
        groups[1] = replace(groups[1], prior=idle_network(32, 64))
        content = replace(content, groups=tuple(groups))
    if heads:
        tensor = QuantizedTensor(np.zeros((2048, MILLIONS // 2048), np.int32), 0)
        content = replace(content, heads=(*content.heads, ("idle", tensor)))
    return content


def without_padding(data: bytes) -> bytes:
    return pack([section for section in unpack(data) if section.number != PADDING], version_of(data))


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        ({"network": True}, r"entropy networks: \d{10} products of entropy networks, a file of \d{4} bytes"),
        ({"heads": True}, r"prediction heads: \d{10} products of prediction heads, a file of \d{4} bytes"),
    ],
)
def test_a_small_file_that_asks_for_minutes_is_refused_before_its_weights_are_decoded(
    kind: dict[str, bool], message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    data = without_padding(write_content(idle_scene(2_000, **kind)))
    assert len(data) < 4096
    decoded: list[int] = []
    plain = weights.decode_arrays

    def counting(reader: FieldReader, shapes: Sequence[tuple[int, ...]]) -> list[np.ndarray]:
        decoded.append(sum(int(np.prod(shape)) for shape in shapes))
        return plain(reader, shapes)

    monkeypatch.setattr(weights, "decode_arrays", counting)
    for prefix in (False, True):
        with pytest.raises(CorruptSection, match=message):
            read_latents(data, prefix=prefix)
    assert max(decoded, default=0) < 10_000


@pytest.mark.parametrize(("anchors", "kind"), [(200, {"network": True}), (500, {"heads": True})])
def test_padding_lets_a_scene_of_many_products_be_read(anchors: int, kind: dict[str, bool]) -> None:
    content = idle_scene(anchors, **kind)
    data = write_content(content)
    assert PADDING in [section.number for section in unpack(data)]
    assert 0 <= len(data) - least_bytes(content) < 60  # entries of padding and metadata, and metadata
    with pytest.raises(CorruptSection, match="products"):
        read_content(without_padding(data))
    assert write_content(read_content(data)) == data


def test_a_scene_of_many_symbols_is_padded_so_that_it_and_its_beginnings_can_be_read() -> None:
    d = make_dimensions(64, paper_groups(1, 32, 1, 1))
    content = make_content(3000, 8, d, symbols=False, kept=1.0)
    data = write_content(content)
    assert PADDING in [section.number for section in unpack(data)]
    assert 0 <= len(data) - least_bytes(content) < 60  # entries of padding and metadata, and metadata
    with pytest.raises(CorruptSection, match=r"scene: .* symbols"):
        read_content(without_padding(data))
    assert write_content(read_content(data)) == data
    ranges = file_info(data).ranges
    assert len(ranges) > 2
    for part in ranges:
        assert len(read_latents(data[: part.bytes], prefix=True)[0].coordinates) == part.anchors


def pairs(count: int) -> np.ndarray:
    """[2 count, 3]: neighbouring voxels, each pair alone in a node of all but the coarsest levels of 21."""
    side = int(np.ceil(count ** (1 / 3)))
    grid = np.stack(np.unravel_index(np.arange(count), (side,) * 3), 1)
    corners = grid * (2**21 // side) // 2 * 2
    corners[-1] = 2**21 - 2
    return np.repeat(corners, 2, 0).astype(np.int32) + np.tile(
        np.array([[0, 0, 0], [0, 0, 1]], np.int32), (count, 1)
    )


def flagged_scene(anchors: int, slots: int, coordinates: np.ndarray | None = None) -> FileContent:
    """Anchors that say nothing, and of each one coupled primitive."""
    d = make_dimensions(slots, paper_groups(1, 0, 1), width=1, residual_dim=1)
    content = make_content(anchors, 1, d, symbols=False, kept=1.0)
    content.mask[:, 1:] = False
    content.mask[:, 0] = True
    line = np.arange(anchors, dtype=np.int32)[:, None] * np.array([1, 0, 0], np.int32)
    return replace(content, coordinates=line if coordinates is None else coordinates)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (flagged_scene(18_000, 64), r"scene: 1152000 flags of masks, a file of \d+ bytes has at most"),
        (flagged_scene(60_000, 1, pairs(30_000)), r"positions: more than \d{6} nodes of the octree"),
    ],
    ids=["flags", "nodes"],
)
def test_a_small_file_of_many_flags_or_nodes_is_refused_unless_it_is_padded(
    content: FileContent, message: str
) -> None:
    padded = write_content(content)
    assert PADDING in [section.number for section in unpack(padded)]
    # An entry of the table, of the padding, is not counted where it is computed.
    assert 0 <= file_info(padded).ranges[0].bytes - least_bytes_of_all(content) < 30
    for part in file_info(padded).ranges:
        assert len(read_latents(padded[: part.bytes], prefix=True)[0].coordinates) == part.anchors
    assert write_content(read_content(padded)) == padded
    data = without_padding(padded)
    assert len(data) < 20_000
    for prefix in (False, True):
        with pytest.raises(CorruptSection, match=message):
            read_latents(data, prefix=prefix)


def test_flags_are_counted_before_anything_is_decoded(monkeypatch: pytest.MonkeyPatch) -> None:
    data = without_padding(write_content(flagged_scene(18_000, 64)))
    monkeypatch.setattr(octree, "_code_tree", lambda *_: pytest.fail("positions were decoded"))
    with pytest.raises(CorruptSection, match="flags"):
        read_latents(data)
    with pytest.raises(CorruptSection, match="flags"):
        file_info(data)


@pytest.mark.parametrize("seed", range(5))
def test_the_walk_codes_the_nodes_that_hold_two_anchors_or_more(seed: int) -> None:
    """As many as a count of each level's nodes has; one fewer is too few for the decoder."""
    rng = np.random.default_rng(seed)
    cloud = np.unique(rng.integers(0, 2 ** rng.integers(2, 21), (int(rng.integers(1, 400)), 3)), axis=0)
    cloud = np.concatenate([cloud, pairs(seed)]) if seed else cloud
    cloud = np.unique(cloud, axis=0).astype(np.int32)
    depth = int((cloud - cloud.min(0) // 16 * 16).max()).bit_length()
    counts = [
        np.unique((cloud - cloud.min(0) // 16 * 16) >> (depth - level), axis=0, return_counts=True)[1]
        for level in range(depth)
    ]
    nodes = sum(int((held > 1).sum()) for held in counts)
    assert walked_nodes(cloud) == nodes
    payload = encode_positions(cloud)
    assert len(decode_positions(payload, len(cloud), nodes)) == len(cloud)
    if nodes:
        with pytest.raises(CorruptSection, match="nodes"):
            decode_positions(payload, len(cloud), nodes - 1)


def test_padding_is_zeros() -> None:
    sections = [*unpack(write_content(make_content(5, 0))), Section(PADDING, bytes(10))]
    assert len(read_content(pack(sections, OLDEST_VERSION)).coordinates) == 5
    sections[-1] = Section(PADDING, bytes(9) + b"\1")
    with pytest.raises(CorruptSection, match="padding"):
        read_content(pack(sections, OLDEST_VERSION))


def test_a_made_scene_needs_no_padding() -> None:
    """Nor twenty times as many products: trained scenes are far from the bounds."""
    content = make_content(3000, 1, blocks=2, hidden=32)
    size = len(write_content(content))
    products = sum(g.prior.products for g in content.groups if isinstance(g.prior, IntegerNetwork))
    assert 20 * 3000 * products < FREE_NETWORK_PRODUCTS + NETWORK_PRODUCTS_PER_BYTE * size
    assert least_bytes(content) == least_bytes_of_all(content) == 0


def test_a_scene_of_a_quarter_million_primitives_is_far_from_the_bounds_of_positions_and_masks() -> None:
    """A surface like that of a capture, five coupled primitives an anchor, in 0.7 MB."""
    angles = np.random.default_rng(0).uniform(0, 2 * np.pi, (60_000, 2))
    radius = 400 + 60 * np.sin(5 * angles[:, :1])
    ring = np.concatenate([np.cos(angles), np.sin(angles[:, :1] + angles[:, 1:])], 1) * radius
    cloud = np.unique(np.rint(ring).astype(np.int32), axis=0)
    assert len(cloud) > 50_000
    size = 700_000
    assert 10 * 5 * len(cloud) < FREE_FLAGS + FLAGS_PER_BYTE * size
    assert 50 * walked_nodes(cloud) < FREE_NODES + NODES_PER_BYTE * size


@pytest.mark.parametrize(
    ("limit", "free", "per_byte"),
    [
        (SYMBOLS, FREE_SYMBOLS, SYMBOLS_PER_BYTE),
        (NETWORK_PRODUCTS, FREE_NETWORK_PRODUCTS, NETWORK_PRODUCTS_PER_BYTE),
        (HEAD_PRODUCTS, FREE_HEAD_PRODUCTS, HEAD_PRODUCTS_PER_BYTE),
        (FLAGS, FREE_FLAGS, FLAGS_PER_BYTE),
        (NODES, FREE_NODES, NODES_PER_BYTE),
    ],
)
def test_a_bound_is_a_constant_and_so_much_a_byte(limit: Limit, free: int, per_byte: int) -> None:
    for size in (0, 1, 1000):
        check_amount(limit, free + size * per_byte, size, "here")
        with pytest.raises(CorruptSection, match=f"here: {free + size * per_byte + 1} "):
            check_amount(limit, free + size * per_byte + 1, size, "here")


def test_the_least_bytes_are_the_fewest_that_every_bound_allows() -> None:
    for content in (idle_scene(200, network=True), idle_scene(500, heads=True)):
        size = least_bytes(content)
        amounts = (
            (SYMBOLS, len(content.coordinates) * content.dimensions.symbols_per_anchor()),
            (
                NETWORK_PRODUCTS,
                len(content.coordinates)
                * sum(layer.weight.size for g in content.groups[1:] for layer in g.prior.layers),
            ),
            (HEAD_PRODUCTS, int(content.mask.sum()) * sum(t.values.size for _, t in content.heads)),
        )
        for limit, amount in amounts:
            check_amount(limit, amount, size, "all")
        with pytest.raises(CorruptSection):
            for limit, amount in amounts:
                check_amount(limit, amount, size - 1, "all")
