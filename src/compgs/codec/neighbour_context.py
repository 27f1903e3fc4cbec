"""What the anchors around have of a group (docs/bitstream.md, "Neighbours").

Of each anchor: whether there were any before, how much they deviate from what is expected without them, and by how much
on average in each channel. The first two go into the group's network; its means follow the others. Nearer neighbours
count for more. Integers below 2^53, so that float64 adds them exactly.
"""

from collections.abc import Callable

import numpy as np

from compgs.codec.integer_network import ACTIVATION_LIMIT, FRACTION_BITS, IntegerNetwork, centre_of
from compgs.numerics.compiled import chunk_of, njit, rows_a_thread
from compgs.ordering.neighbours import AROUND, BESIDES, NEAREST_WEIGHT, Neighbours


def neighbour_context(
    network: IntegerNetwork,  # of the group
    earlier: np.ndarray,  # [M, C] int32, Q12: the group's latents of all anchors of earlier ranges
    offsets: np.ndarray,  # [M + n, 3] int32: of these and the range's own
    neighbours: Callable[[], Neighbours],  # asked for only if there are earlier ranges
) -> np.ndarray:  # [n, 2 + C] int32, Q12
    """Compute the context of the n anchors of a range."""
    centre = centre_of(network)
    out = np.zeros((len(offsets) - len(earlier), BESIDES + len(centre)), np.int32)
    if len(earlier):
        found = neighbours()
        deviations = np.empty((len(earlier), len(centre)))
        sizes = np.empty(len(earlier), np.int64)
        _deviate(earlier, centre.astype(np.float64), deviations, sizes)
        _describe_neighbours(found.node, found.around, offsets, deviations, sizes, out)
    return out


@njit(parallel=True, max_threads=rows_a_thread(512))
def _deviate(earlier, centre, deviations, sizes, part):
    """How far latents are from the centre, in each channel and on average."""
    channels = len(centre)
    low, high = -float(ACTIVATION_LIMIT), float(ACTIVATION_LIMIT - 1)
    for j in chunk_of(len(earlier), part):
        size = 0.0
        for c in range(channels):
            deviations[j, c] = min(max(earlier[j, c] - centre[c], low), high)
            size += abs(deviations[j, c])
        sizes[j] = np.int64(size) // channels


@njit(parallel=True, max_threads=rows_a_thread(512))
def _describe_neighbours(node, around, offsets, deviations, sizes, out, part):
    known, channels = deviations.shape
    sums = np.empty(channels)
    for i in chunk_of(len(out), part):
        a = known + i
        sums[:] = 0.0
        weights, activity = np.int64(0), np.int64(0)
        for place in range(AROUND):
            j = around[node[i], place]
            if j < 0:
                continue
            distance = (
                abs(np.int64(offsets[a, 0]) - offsets[j, 0])
                + abs(np.int64(offsets[a, 1]) - offsets[j, 1])
                + abs(np.int64(offsets[a, 2]) - offsets[j, 2])
            )
            weight = 1 + NEAREST_WEIGHT // distance
            weights += weight
            activity += weight * sizes[j]
            factor = float(weight)
            for c in range(channels):
                sums[c] += factor * deviations[j, c]
        out[i, 0] = 1 << FRACTION_BITS
        out[i, 1] = activity // weights
        # Rounded down, as whole numbers are divided, which would take as long as all else here.
        divisor = float(weights)
        inverse = 1.0 / divisor
        for c in range(channels):
            quotient = np.floor(sums[c] * inverse)  # at most one too large or too small
            left = sums[c] - quotient * divisor
            out[i, 2 + c] = np.int32(
                quotient + (1.0 if left >= divisor else 0.0) - (1.0 if left < 0.0 else 0.0)
            )
