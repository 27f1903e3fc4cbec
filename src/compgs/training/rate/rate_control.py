"""A file of a given size from one training: lambda follows the size that the file would have now.

    e = log((size - fixed) / (target - fixed));    log lambda += integral * e + proportional * (e - e before)

where `fixed` is what no lambda changes: the networks' weights. The rest answers slowly, as the embeddings have to move,
and weakly: it goes with lambda^-g, g being 0.1 to 0.3 once all has settled. The gains are chosen for that: a tenth of
the run until the size is right, without overshoot for any such g. While anchors still grow, today's size says little
about the last one, and lambda follows gently. Towards the end the embeddings hardly move any more, and a lambda that
went on integrating would run away for nothing.

Pruning cannot be taken back, and between two of them lambda swings by factors to make up for a few per cent. So pruning
reckons with a lambda that follows slowly.
"""

import math
from dataclasses import dataclass, replace
from typing import Any

from compgs.training.plan import LAMBDA_RANGE

# lambda at least, below which growth does not follow it any more, and at most.
LOWEST, HIGHEST = LAMBDA_RANGE[0], 1.0
LOOKS = 100  # estimates of the size in a run; each costs about as much as a training step


@dataclass(frozen=True)
class RateState:
    """What the control remembers between two estimates of the size."""

    lmbda: float
    error: float | None = None  # log(size / target) at the last estimate after growth; None before the first
    share: float = 1.0  # of the present bytes that later pruning will leave
    slow: float | None = None  # lambda as pruning sees it; None: as it is
    written: float = 1.0  # of the bytes that training pays for, what a file takes

    @property
    def lmbda_of_pruning(self) -> float:
        return self.lmbda if self.slow is None else self.slow

    @staticmethod
    def restored(values: dict[str, Any]) -> "RateState":
        """Read the state of a checkpoint. Raises ValueError, TypeError for what is no state."""
        state = RateState(**values)
        numbers = (state.lmbda, state.error or 0.0, state.share, state.slow or 0.0, state.written)
        if not all(math.isfinite(number) for number in numbers):
            raise ValueError(f"the state of lambda is not finite: {values}")
        return state


def due(step: int, steps: int, rate_start: float) -> bool:
    """Whether the size is estimated after this step. `rate_start`: share of the run before the rate joins the loss."""
    # A tenth of the run later: the entropy networks begin by knowing nothing.
    return step % max(1, steps // LOOKS) == 0 and step >= (rate_start + 0.1) * steps


def follow(state: RateState, size: float, target: float, *, progress: float, grown: bool) -> RateState:
    """The state after an estimate of the size.

    `size` and `target`: bytes without those that lambda cannot change, both above 0. `progress`: of the run, 0 to 1.
    `grown`: no anchors are added any more.
    """
    error = math.log(size / target)
    if not grown:
        # The file shrinks by a tenth after growth at one lambda (plush_480, 2 000 steps).
        return _moved(state, 0.2 * (error - 0.1))
    # Towards the end of the run the integral gain falls to zero.
    integral, proportional = 2.0 * min(1.0, (1.0 - progress) / (1.0 - 0.92)), 15.0
    change = integral * error
    if state.error is not None:
        change += proportional * (error - state.error)
    return replace(_moved(state, change), error=error)


def _moved(state: RateState, change: float) -> RateState:
    most = math.log(1.6)  # at one estimate
    change = min(max(change, -most), most)
    lmbda = min(max(state.lmbda * math.exp(change), LOWEST), HIGHEST)
    slow = max(state.lmbda_of_pruning, LOWEST)
    # A twentieth of the way, in the logarithm: it takes a fifth of the run to follow.
    return replace(state, lmbda=lmbda, slow=slow * (lmbda / slow) ** 0.05)
