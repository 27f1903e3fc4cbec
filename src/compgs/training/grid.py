"""How fine the grid of the anchors is: coarser where bits are dear (not in the paper).

With a large lambda most of the anchors that the points give would be pruned again. On a coarser grid fewer begin, each
position takes fewer bits, and a run takes less time.
"""

from compgs.config import Config
from compgs.training.control import LAMBDA_RANGE, USUAL_LAMBDA


def grid_spacings(config: Config) -> float:
    """Median distances of the points to a voxel, where no size of voxels is given."""
    m = config.model
    dearer = min(config.training.lmbda, LAMBDA_RANGE[1]) / USUAL_LAMBDA
    return m.voxel_spacings * max(1.0, dearer) ** m.voxel_rate_exponent
