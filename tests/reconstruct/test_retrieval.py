"""Photographs that show the same are found by their features alone, and neighbours by name always are compared."""

import numpy as np
import pytest

from compgs.reconstruct.mapping import Job, matched_pairs
from compgs.reconstruct.reconstruct import EXHAUSTIVE_UP_TO, ReconstructOptions, chosen_matching
from compgs.reconstruct.retrieval import global_descriptors, nearest_word, pairs_to_compare, vocabulary


def walk(places: np.ndarray, seed: int = 0) -> list[np.ndarray]:
    """Features of photographs at places on a ring of 600 landmarks, each of which shows 60 of them, with noise."""
    chance = np.random.default_rng(seed)
    landmarks = chance.gamma(0.5, size=(600, 128))
    shown = [landmarks[(place + np.arange(60)) % 600] for place in places]
    return [each * chance.uniform(0.8, 1.2, each.shape) for each in shown]


def test_photographs_that_overlap_are_more_alike_than_those_that_do_not() -> None:
    places = np.random.default_rng(1).permutation(40) * 15
    looks = global_descriptors(walk(places))
    np.testing.assert_allclose(np.linalg.norm(looks, axis=1), 1, rtol=1e-5)
    similarity = looks @ looks.T
    apart = np.abs(places[:, None] - places[None])
    apart = np.minimum(apart, 600 - apart)
    overlapping, others = similarity[apart == 15], similarity[apart >= 60]
    assert overlapping.min() > others.max()


def test_most_pairs_that_overlap_are_compared_though_names_say_nothing() -> None:
    places = np.random.default_rng(1).permutation(100) * 6
    pairs = set(pairs_to_compare(walk(places), near=0, alike=10))
    apart = np.abs(places[:, None] - places[None])
    apart = np.minimum(apart, 600 - apart)
    halves = {(i, j) for i in range(100) for j in range(i + 1, 100) if apart[i, j] <= 24}
    assert len(halves & pairs) > 0.9 * len(halves)
    assert len(pairs) < 0.25 * 100 * 99 / 2


def test_each_pair_comes_once_and_neighbours_by_name_are_among_them() -> None:
    pairs = pairs_to_compare(walk(np.arange(30) * 20), near=3, alike=4)
    assert len(pairs) == len(set(pairs)) and all(first < second for first, second in pairs)
    assert {(i, j) for i in range(30) for j in range(i + 1, min(30, i + 4))} <= set(pairs)


def test_a_photograph_without_features_still_has_its_neighbours() -> None:
    descriptors = walk(np.arange(6) * 20)
    descriptors[3] = np.zeros((0, 128), np.uint8)
    assert (3, 4) in pairs_to_compare(descriptors)


def test_words_are_the_means_of_what_is_nearest_to_them() -> None:
    chance = np.random.default_rng(0)
    features = chance.normal(size=(500, 8)).astype(np.float32)
    words = vocabulary(features, chance)
    distances = ((features[:, None] - words[None]) ** 2).sum(2)
    np.testing.assert_array_equal(nearest_word(features, words), distances.argmin(1))
    assert distances.min(1).mean() < 0.6 * ((features - features.mean(0)) ** 2).sum(1).mean()


@pytest.mark.parametrize(
    ("photographs", "ordered", "expected"),
    [
        (EXHAUSTIVE_UP_TO, False, "exhaustive"),
        (EXHAUSTIVE_UP_TO + 1, False, "retrieval"),
        (10, True, "exhaustive"),
        (120, True, "sequential"),
    ],
)
def test_many_photographs_are_not_compared_each_with_each(
    photographs: int, ordered: bool, expected: str
) -> None:
    assert chosen_matching(ReconstructOptions(), photographs, ordered=ordered) == expected
    assert (
        chosen_matching(ReconstructOptions(matching="exhaustive"), photographs, ordered=ordered)
        == "exhaustive"
    )


def test_time_grows_with_the_photographs_not_with_their_square() -> None:
    job = Job("", "", "", "OPENCV", "one", "retrieval", 10, 4096, 1600, None, 0)
    assert matched_pairs(400, job) == 2 * matched_pairs(200, job) < 0.25 * 400 * 399 / 2
