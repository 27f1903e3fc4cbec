"""The binary coder: exact tables, rate against the entropy, both directions alike."""

import zlib
from collections.abc import Callable

import mpmath
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numba import njit
from numpy.typing import NDArray

from compgs.codec import binary_coder as bc


@njit
def code_with_probabilities(coder, data, p1, bits):
    for i in range(len(bits)):
        bits[i] = bc.code_bit(coder, data, p1[i], bits[i])


@njit
def code_adaptively(coder, data, states, index, bits):
    for i in range(len(bits)):
        bits[i] = bc.adaptive_bit(coder, data, states, index[i], 1023, bits[i])


@njit
def code_mixed(coder, data, mixer, contexts, bits):
    for i in range(len(bits)):
        for k in range(contexts.shape[1]):
            mixer.contexts[k] = contexts[i, k]
        bits[i] = bc.mixed_bit(coder, data, mixer, 0, 1, 0, 400, 4, bits[i])


Coding = Callable[[NDArray[np.int64], NDArray[np.uint8], NDArray[np.int64]], object]


def encoded(coding: Coding, bits: NDArray[np.int64]) -> bytes:
    coder, data = np.zeros(bc.CODER_FIELDS, np.int64), np.empty(4 * len(bits) + 16, np.uint8)
    bc.start_encoder(coder)
    coding(coder, data, bits.copy())
    return data[: bc.finish_encoder(coder, data)].tobytes()


def decoded(coding: Coding, data: bytes, count: int) -> tuple[NDArray[np.int64], int]:
    coder, body = np.zeros(bc.CODER_FIELDS, np.int64), np.frombuffer(data, np.uint8).copy()
    bits = np.zeros(count, np.int64)
    bc.start_decoder(coder, body)
    coding(coder, body, bits)
    return bits, int(bc.finish_decoder(coder))


def test_tables_are_the_correctly_rounded_ones() -> None:
    with mpmath.workdps(40):
        for x in range(-2048, 2048):
            p1 = 65536 / (1 + mpmath.exp(-mpmath.mpf(x) / 256))
            assert bc.SQUASH[x + 2048] == int(mpmath.floor(p1 + mpmath.mpf(1) / 2)), x
        assert (
            int(mpmath.floor(mpmath.mpf(2) ** 64 * mpmath.exp(-mpmath.mpf(1) / 256))) == bc._EXP_MINUS_1_256
        )


def test_stretch_inverts_squash_within_its_resolution() -> None:
    p1 = bc.SQUASH[bc.STRETCH + 2048]
    inside = np.abs(bc.STRETCH) < bc.LOGIT_LIMIT
    middle = 16 * np.arange(4096) + 8
    assert (np.abs(p1 - middle)[inside] <= 65).all()  # one step of the logit is at most 64
    assert (np.diff(bc.STRETCH) >= 0).all()


def test_tables_never_change() -> None:
    """Their CRC32 as little-endian int32. A change of a table is a change of the format."""
    tables = (bc.SQUASH, bc.STRETCH, bc.RATE, bc.CONFIDENCE)
    crcs = [zlib.crc32(t.astype("<i4").tobytes()) for t in tables]
    assert crcs == [1981583311, 3305989170, 1734766870, 2200363447]


@given(st.lists(st.tuples(st.integers(1, 65535), st.integers(0, 1)), max_size=300))
@settings(max_examples=150, deadline=None)
def test_any_bits_with_any_probabilities_come_back(pairs: list[tuple[int, int]]) -> None:
    p1 = np.array([p for p, _ in pairs], np.int64)
    bits = np.array([b for _, b in pairs], np.int64)

    def coding(coder, data, bits):
        code_with_probabilities(coder, data, p1, bits)

    data = encoded(coding, bits)
    back, length = decoded(coding, data, len(bits))
    assert (back == bits).all()
    assert length == len(data)


def test_code_length_is_that_of_the_probabilities() -> None:
    rng = np.random.default_rng(1)
    p1 = rng.integers(100, 65436, 200_000)
    bits = (rng.integers(0, 65536, len(p1)) < p1).astype(np.int64)
    ideal = -np.log2(np.where(bits == 1, p1, 65536 - p1) / 65536).sum()
    data = encoded(lambda c, d, b: code_with_probabilities(c, d, p1, b), bits)
    assert ideal <= 8 * len(data) < ideal * 1.0001 + 16


def test_adaptive_states_reach_the_entropy_of_their_contexts() -> None:
    rng = np.random.default_rng(2)
    p = np.array([0.01, 0.2, 0.5, 0.97])
    index = rng.integers(0, 4, 100_000)
    bits = (rng.random(len(index)) < p[index]).astype(np.int64)
    entropy = -(p * np.log2(p) + (1 - p) * np.log2(1 - p)).mean() * len(bits)

    def coding(coder, data, bits):
        code_adaptively(coder, data, bc.make_states(4), index, bits)

    data = encoded(coding, bits)
    assert 0.98 * entropy < 8 * len(data) < 1.02 * entropy
    back, length = decoded(coding, data, len(bits))
    assert (back == bits).all()
    assert length == len(data)


def test_mixing_finds_the_context_that_knows() -> None:
    """One input decides the bit with 95 %, the other is noise: within 2 % of the better one's entropy."""
    rng = np.random.default_rng(3)
    known, noise = rng.integers(0, 8, 60_000), rng.integers(0, 64, 60_000)
    bits = ((known & 1) ^ (rng.random(len(known)) < 0.05)).astype(np.int64)
    contexts = np.stack([known, 8 + noise], axis=1)
    entropy = -(0.05 * np.log2(0.05) + 0.95 * np.log2(0.95)) * len(bits)

    def coding(coder, data, bits):
        code_mixed(coder, data, bc.make_mixer([8, 64], 2, 1, bc.WEIGHT_ONE // 2), contexts, bits)

    data = encoded(coding, bits)
    assert 8 * len(data) < 1.02 * entropy
    back, length = decoded(coding, data, len(bits))
    assert (back == bits).all()
    assert length == len(data)


@pytest.mark.parametrize("count", [1, 100, 5000])
def test_states_stay_within_their_bits(count: int) -> None:
    states = bc.make_states(2)
    for _ in range(count):
        bc.learn(states, 0, 0, 1023)
        bc.learn(states, 1, 1, 1023)
    low, high = (int(s) >> bc.COUNT_BITS for s in states)
    assert 0 <= low < 1 << 21 < high < 1 << 22


def test_a_buffer_too_short_is_told_and_not_overrun() -> None:
    bits = np.random.default_rng(4).integers(0, 2, 800)
    coder, guarded = np.zeros(bc.CODER_FIELDS, np.int64), np.full(60, 7, np.uint8)
    bc.start_encoder(coder)
    code_with_probabilities(coder, guarded[:50], np.full(800, 1 << 15), bits)
    assert bc.finish_encoder(coder, guarded[:50]) == 100
    assert (guarded[50:] == 7).all()


@given(st.binary(max_size=40), st.integers(0, 200))
@settings(max_examples=300, deadline=None)
def test_the_decoder_accepts_exactly_what_the_encoder_writes(data: bytes, count: int) -> None:
    p1 = np.random.default_rng(count).integers(1, 65536, count)

    def coding(coder, data, bits):
        code_with_probabilities(coder, data, p1, bits)

    bits, length = decoded(coding, data, count)
    if length == len(data):
        assert encoded(coding, bits) == data
    own = encoded(coding, bits)
    assert (decoded(coding, own, count)[0] == bits).all()


def test_superfluous_bytes_are_noticed() -> None:
    p1 = np.full(2000, 20_000)
    bits = (np.random.default_rng(5).random(2000) < 0.3).astype(np.int64)

    def coding(coder, data, bits):
        code_with_probabilities(coder, data, p1, bits)

    data = encoded(coding, bits)
    for altered in [data + b"\0", data + b"\xff", data + data]:
        assert decoded(coding, altered, len(bits))[1] != len(altered)
