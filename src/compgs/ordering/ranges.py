"""Into which ranges of octree levels an encoder cuts the anchors (docs/bitstream.md, "Coarse to fine").

A file has one section of latents for each range, so that its beginning is a coarse scene; and what anchors of earlier
ranges have is context for those of later ones (`neighbours.py`).
"""

import numpy as np

# The least anchors of a file for each further range: what a range adds, some thirty bytes, then stays below 1 % of the
# ten bytes or so of an anchor.
ANCHORS_PER_RANGE = 350
MOST_RANGES = 8  # that an encoder makes
SMALLEST_PART = 32  # the first range has at least this part of the anchors: fewer show nothing


def chosen_levels(counts: np.ndarray) -> list[int]:
    """Last level of each range an encoder makes, from `order.level_counts` [depth + 1]: every range but the first has
    at least half as many anchors as all before it.
    """
    total = int(counts[-1])
    ends = [len(counts) - 1]
    most = min(MOST_RANGES, 1 + total // ANCHORS_PER_RANGE)
    for level in range(len(counts) - 2, -1, -1):
        if len(ends) == most or SMALLEST_PART * counts[level] < total:
            break
        if 3 * counts[level] <= 2 * counts[ends[-1]]:
            ends.append(level)
    return ends[::-1]
