"""What neighbours say is whole numbers, rounded down: the same as Python's own, which have no limits."""

import numpy as np
import pytest

from compgs.codec.integer_network import ACTIVATION_LIMIT, IntegerLayer, IntegerNetwork
from compgs.codec.neighbour_context import neighbour_context
from compgs.ordering.neighbours import AROUND, NEAREST_WEIGHT, Neighbours

CHANNELS = 3


def network(centre: list[int]) -> IntegerNetwork:
    bias = np.array([*centre, *[0] * CHANNELS], np.int64)
    weight = np.zeros((2 * CHANNELS, 2), np.int32)
    return IntegerNetwork((IntegerLayer(weight, bias, 0, False),))


def said(earlier: np.ndarray, offsets: np.ndarray, around: np.ndarray, centre: list[int]) -> np.ndarray:
    node = np.arange(len(offsets) - len(earlier), dtype=np.int32) % len(earlier)
    return neighbour_context(network(centre), earlier, offsets, lambda: Neighbours(node, around))


@pytest.mark.parametrize("seed", range(4))
def test_neighbours_count_as_whole_numbers_do(seed: int) -> None:
    chance = np.random.default_rng(seed)
    known, new = 40, 300
    largest = ACTIVATION_LIMIT - 1 if seed % 2 else 5
    earlier = chance.integers(-largest, largest + 1, (known, CHANNELS)).astype(np.int32)
    reach = 3 if seed < 2 else 1 << 20
    offsets = chance.integers(0, reach, (known + new, 3)).astype(np.int32)
    offsets[known:, 0] += reach  # nobody is where another is
    around = chance.integers(-1, known, (known, AROUND)).astype(np.int32)
    around[:, 13] = np.arange(known)  # the own node's is always there
    centre = [0, 7, -9]

    out = said(earlier, offsets, around, centre)
    for i in range(new):
        sums, weights = [0] * CHANNELS, 0
        for j in around[i % known].tolist():
            if j < 0:
                continue
            distance = int(np.abs(offsets[known + i].astype(int) - offsets[j].astype(int)).sum())
            weight = 1 + NEAREST_WEIGHT // distance
            weights += weight
            for c in range(CHANNELS):
                deviation = int(earlier[j, c]) - centre[c]
                sums[c] += weight * min(max(deviation, -ACTIVATION_LIMIT), ACTIVATION_LIMIT - 1)
        assert out[i, 2:].tolist() == [total // weights for total in sums]


@pytest.mark.parametrize(
    "value", [-ACTIVATION_LIMIT, -8_000_001, -1, 0, 1, 3, 7_654_321, ACTIVATION_LIMIT - 1]
)
def test_neighbours_that_deviate_alike_say_just_that(value: int) -> None:
    """Quotients that come out even are where rounding errors would show."""
    chance = np.random.default_rng(1)
    known, new = 30, 200
    earlier = np.full((known, CHANNELS), value, np.int32)
    offsets = chance.integers(0, 50, (known + new, 3)).astype(np.int32)
    offsets[known:, 0] += 50
    around = np.tile(np.arange(AROUND, dtype=np.int32), (known, 1))
    assert (said(earlier, offsets, around, [0, 0, 0])[:, 2:] == value).all()
