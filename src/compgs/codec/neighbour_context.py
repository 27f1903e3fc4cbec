"""What the anchors around have of a group (docs/bitstream.md, "Neighbours").

Of each anchor: whether there were any before, how much they deviate from what is expected without them, and by how much
on average in each channel. The first two go into the group's network; its means follow the others. Nearer neighbours
count for more. Integers below 2^53, so that float64 adds them exactly.
"""

from collections.abc import Callable

import numpy as np

from compgs.codec.integer_network import ACTIVATION_LIMIT, FRACTION_BITS, IntegerNetwork, centre_of
from compgs.numerics.compiled import njit, portion
from compgs.ordering.neighbours import AROUND, NEAREST_WEIGHT, Neighbours

BESIDES = 2  # inputs of the network, before what its means follow: known, activity


def neighbour_context(
    network: IntegerNetwork,  # of the group
    earlier: np.ndarray,  # [M, C] int32, Q12: the group's latents of all anchors of earlier ranges
    offsets: np.ndarray,  # [M + n, 3] int32: of these and the range's own
    neighbours: Callable[[], Neighbours],  # asked for only if there are earlier ranges
) -> np.ndarray:  # [n, 2 + C] int32, Q12
    """Of the n anchors of a range."""
    centre = centre_of(network)
    out = np.zeros((len(offsets) - len(earlier), BESIDES + len(centre)), np.int32)
    if len(earlier):
        found = neighbours()
        _say(found.node, found.around, offsets, earlier, centre.astype(np.float64), out)
    return out


@njit(parallel=True)
def _say(node, around, offsets, earlier, centre, out, share):
    known, channels = len(earlier), len(centre)
    low, high = -float(ACTIVATION_LIMIT), float(ACTIVATION_LIMIT - 1)
    for i in portion(len(out), share):
        a = known + i
        sums = np.zeros(channels)
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
            size = 0.0
            for c in range(channels):
                deviation = min(max(earlier[j, c] - centre[c], low), high)
                sums[c] += float(weight) * deviation
                size += abs(deviation)
            weights += weight
            activity += weight * (np.int64(size) // channels)
        out[i, 0] = 1 << FRACTION_BITS
        out[i, 1] = activity // weights
        for c in range(channels):
            out[i, 2 + c] = np.int64(sums[c]) // weights
