"""Whole files: content -> bytes -> content, sizes against the tables' own code length, refusals."""

import sys
from dataclasses import fields, replace
from pathlib import Path

import numba
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from compgs.codec import integer_network
from compgs.codec.anchor_order import canonical_order
from compgs.codec.content import Dimensions, FileContent, cross_entropy_bits, dequantize
from compgs.codec.format import MAX_SYMBOL, PADDING, pack, unpack
from compgs.codec.integer_network import IntegerNetwork
from compgs.codec.reader import file_info, read_content, read_latents
from compgs.codec.tables import HyperTable
from compgs.codec.writer import write_content
from compgs.errors import CorruptSection, NotEncodable

sys.path.append(str(Path(__file__).parents[2] / "benchmarks"))
from made_content import make_content

ROWS = ("coordinates", "mask", "reference_hyper", "reference", "covariance", "residual_hyper", "residual")
STREAM_SECTIONS = {
    "reference_hyper": "reference hyperprior",
    "reference": "reference embeddings",
    "covariance": "covariance",
    "residual_hyper": "residual hyperprior",
    "residual": "residual embeddings",
}


def by_position(content: FileContent) -> dict[str, np.ndarray]:
    order = np.lexsort(content.coordinates.T)
    return {name: getattr(content, name)[order] for name in ROWS}


def assert_same(a: FileContent, b: FileContent) -> None:
    """Same scene, whatever the order of its anchors."""
    for name, rows in by_position(a).items():
        other = by_position(b)[name]
        assert rows.dtype == other.dtype and rows.shape == other.shape and (rows == other).all(), name
    for field in fields(FileContent):
        if field.name in ROWS:
            continue
        x, y = getattr(a, field.name), getattr(b, field.name)
        if field.name.endswith("_tables"):
            assert [(t.lowest, t.levels.tolist()) for t in x] == [(t.lowest, t.levels.tolist()) for t in y]
        elif field.name == "networks":
            assert {n: _plain(v) for n, v in x.items()} == {n: _plain(v) for n, v in y.items()}
        elif field.name == "heads":
            assert [(n, t.exponent, t.values.tolist()) for n, t in x] == [
                (n, t.exponent, t.values.tolist()) for n, t in y
            ]
        else:
            assert x == y, field.name


def _plain(network: IntegerNetwork) -> list:
    return [
        (layer.weight.tolist(), layer.bias.tolist(), layer.shift, layer.rectify) for layer in network.layers
    ]


dimensions = st.builds(
    Dimensions,
    coupled_primitives=st.integers(1, 12),
    reference_dim=st.integers(1, 40),
    residual_dim=st.integers(1, 9),
    reference_hyper_dim=st.integers(1, 6),
    residual_hyper_dim=st.integers(1, 12),
    heads=st.sampled_from(["separate", "paired"]),
    width=st.integers(1, 64),
)


@given(
    st.integers(1, 120),
    st.integers(0, 1 << 20),
    dimensions,
    st.sampled_from([0.0, 0.3, 1.0]),
    st.sampled_from([0, 7]),
)
@settings(max_examples=25, deadline=None)
def test_any_content_comes_back(anchors: int, seed: int, d: Dimensions, kept: float, hidden: int) -> None:
    content = make_content(anchors, seed, d, kept=kept, hidden=hidden)
    data = write_content(content)
    read, latents = read_latents(data)
    assert_same(read, content)
    assert (canonical_order(read.coordinates) == np.arange(anchors)).all()
    assert write_content(read) == data
    again = dequantize(read)
    for name in ("reference", "covariance", "residual"):
        assert (getattr(latents, name) == getattr(again, name)).all()
        assert getattr(latents, name).dtype == np.int32


def test_dequantized_latents_are_symbols_plus_predicted_means() -> None:
    content = read_content(write_content(make_content(40, 1)))
    latents = dequantize(content)

    def means(name: str, x: np.ndarray) -> np.ndarray:
        (layer,) = content.networks[name].layers
        y = x.astype(np.int64) @ layer.weight.T.astype(np.int64)
        y = ((y + (1 << (layer.shift - 1))) >> layer.shift) + layer.bias
        return y[:, : len(layer.bias) // 2]

    f = content.reference * 4096 + means("reference", content.reference_hyper * 4096)
    assert (latents.reference == f).all()
    assert (latents.covariance == content.covariance * 4096 + means("covariance", f)).all()
    context = np.concatenate([content.residual_hyper * 4096, f], 1)
    g = content.residual * 4096 + means("residual", context).reshape(content.residual.shape)
    assert (latents.residual == g[content.mask]).all()


def test_extreme_symbols_come_back_through_the_escape() -> None:
    content = make_content(30, 2)
    for i, name in enumerate(STREAM_SECTIONS):
        array = getattr(content, name)
        array.reshape(30, -1)[3 * i, :] = MAX_SYMBOL
        array.reshape(30, -1)[3 * i + 1, :] = -MAX_SYMBOL
    content.residual[~content.mask] = 0
    assert_same(read_content(write_content(content)), content)


def test_order_of_anchors_does_not_change_the_bytes() -> None:
    content = make_content(200, 3)
    order = np.random.default_rng(0).permutation(200)
    shuffled = replace(content, **{name: getattr(content, name)[order] for name in ROWS})
    assert write_content(shuffled) == write_content(content)


def test_symbols_of_missing_coupled_primitives_are_ignored() -> None:
    content = make_content(50, 4, kept=0.5)
    noisy = replace(
        content, residual=np.where(content.mask[:, :, None], content.residual, 77).astype(np.int32)
    )
    assert write_content(noisy) == write_content(content)


def test_streams_take_their_cross_entropy() -> None:
    content = make_content(8000, 5)
    data = write_content(content)
    sizes = {section.name: section.bytes for section in file_info(data).sections}
    bits = cross_entropy_bits(content)
    for name, section in STREAM_SECTIONS.items():
        assert sizes[section] > 4000
        assert bits[name] <= 8 * sizes[section] < 1.002 * bits[name] + 64, name


def test_results_do_not_depend_on_threads_or_block_sizes(monkeypatch: pytest.MonkeyPatch) -> None:
    content = make_content(3000, 6, hidden=16)
    data = write_content(content)
    threads = numba.get_num_threads()
    try:
        numba.set_num_threads(1)
        monkeypatch.setattr(integer_network, "BLOCK_ROWS", 77)
        assert write_content(content) == data
        assert_same(read_content(data), content)
    finally:
        numba.set_num_threads(threads)


def test_info_accounts_for_every_byte() -> None:
    content = make_content(100, 7)
    data = write_content(content)
    info = file_info(data)
    assert info.bytes == len(data) == sum(section.bytes for section in info.sections)
    assert (info.anchors, info.coupled, info.dimensions) == (100, int(content.mask.sum()), content.dimensions)
    assert info.metadata == content.metadata
    assert sum(s.bits_per_anchor for s in info.sections) == pytest.approx(info.bits_per_anchor)


def test_a_scene_that_compresses_too_well_is_padded_so_that_it_can_be_read() -> None:
    d = Dimensions(64, reference_dim=1, residual_dim=32, reference_hyper_dim=1, residual_hyper_dim=1)
    content = make_content(3000, 8, d, symbols=False, kept=1.0)
    data = write_content(content)
    assert PADDING in [section.number for section in unpack(data)]
    assert_same(read_content(data), content)
    assert write_content(read_content(data)) == data


def broken(content: FileContent, name: str) -> FileContent:
    """Content with one thing that the format cannot hold."""
    table = content.reference_hyper_tables[0]
    changes: dict[str, dict] = {
        "no anchors": {row: getattr(content, row)[:0] for row in ROWS},
        "shape": {"reference": content.reference[:, 1:]},
        "dtype": {"covariance": content.covariance.astype(np.float32)},
        "symbol": {"reference_hyper": content.reference_hyper + MAX_SYMBOL + 50},
        "voxel size": {"voxel_size": float("nan")},
        "step": {"covariance_step": 0.0},
        "background": {"background": (0.0, float("inf"), 0.0)},
        "dimension": {"dimensions": replace(content.dimensions, width=0)},
        "heads": {"dimensions": replace(content.dimensions, heads="odd")},
        "tables": {"reference_hyper_tables": content.reference_hyper_tables[1:]},
        "levels": {
            "reference_hyper_tables": (
                HyperTable(0, np.full(3, 200, np.uint8)),
                *content.reference_hyper_tables[1:],
            )
        },
        "lowest": {
            "reference_hyper_tables": (HyperTable(1 << 30, table.levels), *content.reference_hyper_tables[1:])
        },
        "networks": {"networks": {"reference": content.networks["reference"]}},
        "network size": {"networks": content.networks | {"covariance": content.networks["reference"]}},
        "metadata": {"metadata": {"note": "x" * 5000}},
        "duplicates": {"coordinates": np.repeat(content.coordinates[:1], len(content.coordinates), 0)},
        "range": {"coordinates": content.coordinates * (1 << 22)},
    }
    return replace(content, **changes[name])


BROKEN = (
    "no anchors,shape,dtype,symbol,voxel size,step,background,dimension,heads,tables,levels,lowest,networks,"
)
BROKEN += "network size,metadata,duplicates,range"


@pytest.mark.parametrize("name", BROKEN.split(","))
def test_what_cannot_be_represented_is_refused_before_writing(name: str) -> None:
    with pytest.raises(NotEncodable):
        write_content(broken(make_content(20, 9), name))


def test_masks_must_agree_with_the_scene_section() -> None:
    a, b = (unpack(write_content(make_content(60, 10, kept=kept))) for kept in (0.2, 0.9))
    mixed = [y if x.number == 3 else x for x, y in zip(a, b, strict=True)]
    with pytest.raises(CorruptSection, match="masks"):
        read_content(pack(mixed))
