"""Few values in place of many: a codebook of numbers (Lloyd 1982), a palette of vectors. Deterministic."""

import heapq

import numpy as np

ROUNDS = 48  # of moving every number of a codebook to the middle of what is nearest to it
BINS = 4096  # of the histogram from which a codebook begins
AXIS_ROUNDS = 3  # of power iteration: the axis need not be exact


def codebook(values: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray]:
    """`size` float32 numbers, ascending, and for each value the index of the nearest (uint8 for 256)."""
    flat = np.sort(values.astype(np.float64).reshape(-1))
    sums = np.concatenate([[0.0], np.cumsum(flat)])
    # As dense as the third root of the values' density, which is best for many levels (Panter and Dite 1951).
    counts, edges = np.histogram(flat, BINS)
    density = np.concatenate([[0.0], np.cumsum(np.cbrt(counts))])
    centers = np.interp(np.linspace(0, density[-1], size), density, edges)
    for _ in range(ROUNDS):
        edges = np.searchsorted(flat, (centers[1:] + centers[:-1]) / 2)
        first, last = np.append(0, edges), np.append(edges, len(flat))
        filled = last > first
        centers[filled] = ((sums[last] - sums[first])[filled]) / (last - first)[filled]
    book = np.sort(centers).astype(np.float32)
    middles = (book[1:].astype(np.float64) + book[:-1]) / 2
    return book, np.searchsorted(middles, values).astype(np.uint8 if size <= 256 else np.int64)


def palette(vectors: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Find at most `size` centers [P, C] float32 for vectors [M, C], and for each vector the index of its center [M]
    int64.

    The group of vectors that is farthest from its middle, in squares, is divided across its longest axis, again and
    again. Where there are hardly fewer centers than vectors this leaves a fraction of the error of centers that are
    chosen by chance and then moved, in a fraction of the time.
    """
    groups = [_group(vectors, np.arange(len(vectors)), 0)]
    while len(groups) < size and groups[0][0] < 0:
        _, _, rows, middle = heapq.heappop(groups)
        beyond = _beyond_middle(vectors[rows] - middle)
        heapq.heappush(groups, _group(vectors, rows[beyond], 2 * len(groups)))
        heapq.heappush(groups, _group(vectors, rows[~beyond], 2 * len(groups) + 1))
    centers = np.stack([middle for _, _, _, middle in groups]).astype(np.float32)
    labels = np.empty(len(vectors), np.int64)
    for i, (_, _, rows, _) in enumerate(groups):
        labels[rows] = i
    return centers, labels


def _group(vectors: np.ndarray, rows: np.ndarray, number: int) -> tuple[float, int, np.ndarray, np.ndarray]:
    """Squares of the distances to the middle (negative: the largest comes first), a number for ties, rows, middle."""
    values = vectors[rows].astype(np.float64)
    middle = values.mean(0)
    return -float(((values - middle) ** 2).sum()), number, rows, middle


def _beyond_middle(offsets: np.ndarray) -> np.ndarray:
    """[m] bool: on which side of their middle vectors [m, C] lie, along the axis of their largest spread."""
    axis = offsets[np.argmax((offsets**2).sum(1))]
    for _ in range(AXIS_ROUNDS):
        axis = offsets.T @ (offsets @ axis)
        axis /= np.linalg.norm(axis) + np.finfo(np.float64).tiny
    beyond = offsets @ axis > 0
    # Differences that rounding makes may have no two sides: then any division is as good.
    return beyond if beyond.any() and not beyond.all() else np.arange(len(offsets)) % 2 == 0
