"""Masks of coupled primitives: round trips, rate, robustness."""

import hashlib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays
from numpy.typing import NDArray

from compgs.codec.mask_coder import decode_masks, encode_masks
from compgs.errors import CorruptSection, NotEncodable


def random_masks(p: float, anchors: int = 5000, coupled: int = 10, seed: int = 0) -> NDArray[np.bool_]:
    return np.random.default_rng(seed).random((anchors, coupled)) < p


@given(arrays(np.bool_, array_shapes(min_dims=2, max_dims=2, min_side=0, max_side=64)))
@settings(max_examples=150, deadline=None)
def test_any_masks_come_back(mask: NDArray[np.bool_]) -> None:
    data = encode_masks(mask)
    back = decode_masks(data, *mask.shape)
    assert back.dtype == np.bool_
    assert back.shape == mask.shape
    assert (back == mask).all()


def test_all_true_costs_nothing() -> None:
    assert encode_masks(np.ones((300_000, 10), np.bool_)) == b""
    assert decode_masks(b"", 7, 3).all()


def test_all_false_costs_next_to_nothing() -> None:
    mask = np.zeros((20_000, 10), np.bool_)
    data = encode_masks(mask)
    assert len(data) < 80
    assert not decode_masks(data, *mask.shape).any()


@pytest.mark.parametrize("p", [0.05, 0.5, 0.75, 0.98])
def test_independent_flags_cost_their_entropy(p: float) -> None:
    mask = random_masks(p, anchors=40_000)
    entropy = -(p * np.log2(p) + (1 - p) * np.log2(1 - p)) * mask.size
    assert 8 * len(encode_masks(mask)) < 1.005 * entropy + 2000  # bits, of learning


def test_flags_that_depend_on_each_other_cost_less() -> None:
    """Slots filled from the first on, K + 1 equally likely cases: log2(K + 1) bits an anchor."""
    filled = np.random.default_rng(1).integers(0, 11, (40_000, 1))
    mask = np.arange(10) < filled
    assert 8 * len(encode_masks(mask)) < 1.02 * np.log2(11) * len(mask)


def test_the_bytes_never_change() -> None:
    """A change of these bytes is a change of the format."""
    mask = ((np.arange(1, 9971) * 2654435761 >> 13) % 8 < 5).reshape(997, 10)
    data = encode_masks(mask)
    assert (len(data), hashlib.sha256(data).hexdigest()[:16]) == (266, "7498388cd3c4ffce")


@given(st.binary(max_size=60), st.integers(0, 40), st.integers(0, 64))
@settings(max_examples=300, deadline=None)
def test_the_decoder_accepts_exactly_what_the_encoder_writes(data: bytes, anchors: int, coupled: int) -> None:
    try:
        mask = decode_masks(data, anchors, coupled)
    except CorruptSection:
        return
    assert mask.shape == (anchors, coupled)
    assert encode_masks(mask) == data


def test_altered_data_are_refused_or_other_masks() -> None:
    mask = random_masks(0.7, anchors=300)
    data = encode_masks(mask)
    rng = np.random.default_rng(6)
    refused = 0
    for _ in range(200):
        altered = bytearray(data)
        altered[rng.integers(0, len(data))] ^= 1 << rng.integers(0, 8)
        try:
            assert (decode_masks(bytes(altered), *mask.shape) != mask).any()
        except CorruptSection:
            refused += 1
    assert refused > 100


@pytest.mark.parametrize("extra", [b"\0", b"\xff", bytes(40)])
def test_superfluous_bytes_are_refused(extra: bytes) -> None:
    mask = random_masks(0.7, anchors=300)
    with pytest.raises(CorruptSection, match="masks: the data are not 300 x 10 flags"):
        decode_masks(encode_masks(mask) + extra, *mask.shape)


def test_more_flags_than_the_data_hold_are_refused() -> None:
    data = encode_masks(random_masks(0.5, anchors=3000))
    for anchors, coupled in [(2000, 10), (3000, 9), (0, 10), (1000, 0)]:
        with pytest.raises(CorruptSection, match="masks: the data are not"):
            decode_masks(data, anchors, coupled)


def test_dimensions_beyond_the_limits_are_refused_before_anything_is_allocated() -> None:
    for anchors, coupled in [(1 << 40, 10), ((1 << 24) + 1, 1), (300, 65), (-1, 1), (1, -1)]:
        with pytest.raises(CorruptSection, match="expected at most"):
            decode_masks(b"", anchors, coupled)


def test_too_many_slots_are_refused_before_coding() -> None:
    with pytest.raises(NotEncodable, match="65 coupled"):
        encode_masks(np.zeros((3, 65), np.bool_))
