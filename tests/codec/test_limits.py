"""A decoder's memory and time are bounded by the file's length: what asks for more is refused before it is done."""

import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from compgs.codec import weights
from compgs.codec.content import FileContent
from compgs.codec.fields import FieldReader
from compgs.codec.format import (
    FREE_HEAD_PRODUCTS,
    FREE_NETWORK_PRODUCTS,
    FREE_SYMBOLS,
    HEAD_PRODUCTS_PER_BYTE,
    NETWORK_PRODUCTS_PER_BYTE,
    OLDEST_VERSION,
    PADDING,
    SYMBOLS_PER_BYTE,
    Section,
    pack,
    unpack,
    version_of,
)
from compgs.codec.integer_network import IntegerLayer, IntegerNetwork
from compgs.codec.limits import HEAD_PRODUCTS, NETWORK_PRODUCTS, SYMBOLS, Limit, check_amount, least_bytes
from compgs.codec.reader import file_info, read_content, read_latents
from compgs.codec.weights import QuantizedTensor
from compgs.codec.writer import write_content
from compgs.errors import CorruptSection

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
    assert least_bytes(content) == 0


@pytest.mark.parametrize(
    ("limit", "free", "per_byte"),
    [
        (SYMBOLS, FREE_SYMBOLS, SYMBOLS_PER_BYTE),
        (NETWORK_PRODUCTS, FREE_NETWORK_PRODUCTS, NETWORK_PRODUCTS_PER_BYTE),
        (HEAD_PRODUCTS, FREE_HEAD_PRODUCTS, HEAD_PRODUCTS_PER_BYTE),
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
