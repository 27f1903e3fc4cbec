"""Few values in place of many: a codebook of numbers, a palette of vectors (Lloyd 1982). Deterministic."""

import numpy as np

ROUNDS = 12  # of moving every center to the middle of what is nearest to it
# Vectors compared with centers at once: their table of distances stays small.
BLOCK = 1 << 12


def codebook(values: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray]:
    """`size` float32 numbers, ascending, and for each value the index of the nearest (uint8 for 256)."""
    flat = np.sort(values.astype(np.float64).reshape(-1))
    sums = np.concatenate([[0.0], np.cumsum(flat)])
    # From the middle between equal shares and equal steps: dense regions and far values both get some.
    shares = flat[np.linspace(0, len(flat) - 1, size).round().astype(np.int64)]
    centers = (shares + np.linspace(flat[0], flat[-1], size)) / 2
    for _ in range(ROUNDS * 4):
        edges = np.searchsorted(flat, (centers[1:] + centers[:-1]) / 2)
        first, last = np.append(0, edges), np.append(edges, len(flat))
        filled = last > first
        centers[filled] = ((sums[last] - sums[first])[filled]) / (last - first)[filled]
    book = np.sort(centers).astype(np.float32)
    middles = (book[1:].astype(np.float64) + book[:-1]) / 2
    return book, np.searchsorted(middles, values).astype(np.uint8 if size <= 256 else np.int64)


def palette(vectors: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray]:
    """At most `size` centers [P, C] float32 for vectors [M, C], and for each vector the index of its center [M] int64.

    In two levels, so that the time is that of the square root of the size: regions first, centers within each.
    """
    vectors = np.ascontiguousarray(vectors, np.float32)
    if len(vectors) <= size:
        return vectors, np.arange(len(vectors))
    regions = _lloyd(vectors, max(1, round(size**0.5)))[1]
    counts = np.bincount(regions)
    # Each region's share of the centers, one at least.
    shares = np.maximum(np.floor(counts * (size - len(counts)) / len(vectors)).astype(np.int64) + 1, 1)
    centers, labels, start = [], np.empty(len(vectors), np.int64), 0
    for region in np.flatnonzero(counts):
        rows = np.flatnonzero(regions == region)
        found, nearest = _lloyd(vectors[rows], min(int(shares[region]), len(rows)))
        centers.append(found)
        labels[rows] = start + nearest
        start += len(found)
    return np.concatenate(centers), labels


def _lloyd(vectors: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Centers [count, C] and the index of the nearest for each vector."""
    chance = np.random.default_rng(0)
    centers = vectors[np.sort(chance.choice(len(vectors), count, replace=False))].copy()
    labels = _nearest(vectors, centers)
    for _ in range(ROUNDS):
        sums = np.zeros(centers.shape, np.float64)
        np.add.at(sums, labels, vectors)
        members = np.bincount(labels, minlength=count)
        filled = members > 0
        centers[filled] = (sums[filled] / members[filled, None]).astype(np.float32)
        labels = _nearest(vectors, centers)
    return centers, labels


def _nearest(vectors: np.ndarray, centers: np.ndarray) -> np.ndarray:
    labels = np.empty(len(vectors), np.int64)
    squares = (centers**2).sum(1)
    for start in range(0, len(vectors), BLOCK):
        block = slice(start, start + BLOCK)
        labels[block] = (squares - 2 * vectors[block] @ centers.T).argmin(1)
    return labels
