"""Few values in place of many."""

import numpy as np

from compgs.formats.palette import codebook, palette


def test_a_codebook_holds_few_values_exactly() -> None:
    values = np.array([[1.0, -2.0], [5.0, 1.0], [-2.0, 5.0]], np.float32)
    book, index = codebook(values, 256)
    assert book.shape == (256,) and book.dtype == np.float32 and index.dtype == np.uint8
    np.testing.assert_allclose(book[index], values, atol=1e-6)
    assert (np.diff(book) >= 0).all()


def test_every_value_gets_the_nearest_of_the_book() -> None:
    values = np.random.default_rng(0).normal(size=5000)
    book, index = codebook(values, 64)
    distances = np.abs(values[:, None] - book)
    np.testing.assert_allclose(np.abs(values - book[index]), distances.min(1), atol=1e-6)


def test_a_codebook_of_a_normal_distribution_is_near_the_best_there_is() -> None:
    values = np.random.default_rng(0).normal(size=200_000)
    book, index = codebook(values, 64)
    # Panter and Dite 1951: sqrt(3) pi / (2 n^2) of the variance, for many levels.
    best = np.sqrt(3) * np.pi / 2 / 64**2
    assert ((values - book[index]) ** 2).mean() < 1.05 * best


def test_a_palette_that_is_large_enough_holds_everything() -> None:
    vectors = np.random.default_rng(0).normal(size=(50, 9)).astype(np.float32)
    centers, labels = palette(vectors, 64)
    assert len(centers) == 50
    np.testing.assert_allclose(centers[labels], vectors, atol=1e-6)


def test_equal_vectors_take_one_entry() -> None:
    vectors = np.repeat(np.array([[1.0, 2.0], [3.0, 4.0]], np.float32), 20, axis=0)
    centers, labels = palette(vectors, 16)
    assert len(centers) == 2
    np.testing.assert_array_equal(centers[labels], vectors)


def test_far_clusters_are_found_before_near_ones_are_divided() -> None:
    chance = np.random.default_rng(0)
    middles = chance.normal(size=(8, 12)) * 100
    which = chance.integers(8, size=400)
    vectors = (middles[which] + chance.normal(size=(400, 12))).astype(np.float32)
    centers, labels = palette(vectors, 8)
    assert len(centers) == 8
    for cluster in range(8):
        assert len(set(labels[which == cluster])) == 1
    np.testing.assert_allclose(centers[labels[0]], vectors[which == which[0]].mean(0), rtol=1e-4, atol=1e-4)


def test_the_same_vectors_give_the_same_palette() -> None:
    vectors = np.random.default_rng(0).normal(size=(300, 9)).astype(np.float32)
    one, other = palette(vectors, 40), palette(vectors, 40)
    assert len(one[0]) == 40 and set(one[1]) == set(range(40))
    np.testing.assert_array_equal(one[0], other[0])
    np.testing.assert_array_equal(one[1], other[1])
