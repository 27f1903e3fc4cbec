"""A compression that has a time keeps to it, however busy the machine becomes meanwhile.

The number of steps is planned before the first one. While they are taken, the time that is left is compared with what
the steps that are left will take; where it is too short, some are passed over: what is due after them is done, but
nothing is learned in them. All schedules then go on as in a run of fewer steps.
"""

import math
import time
from typing import Protocol

from compgs.training import TrainingStatus

FEWEST = 200  # steps: fewer make nothing that could be looked at
# Steps with which a file shows what its splats do (docs/results/compress.md); with fewer it is called rough.
ENOUGH = 1_500
LATE = 1.02  # of the time that is left: less is not worth passing over a step


class SkipsSteps(Protocol):
    """A training whose steps need not all be learned in."""

    step: int

    def skip_steps(self, steps: int) -> None: ...


class Deadline:
    """Keeps a run to its time: called between any two steps, and told how the run gets on."""

    def __init__(self, end: float, steps: int, *, late: float = 0.0) -> None:
        """`end`: of the training, on the clock of `time.monotonic`; `steps` of the run; `late`: seconds after the end
        in which even the fewest steps are taken, as known before the first one.
        """
        self.end = end
        self.steps = steps
        self.late = late
        self.taken = 0  # steps that were learned in
        self._behind = 0.0  # steps to pass over for each that is taken
        self._owed = 0.0

    def tell(self, status: TrainingStatus) -> None:
        """How long the steps that are left will take."""
        left, remaining = self.end - time.monotonic(), status.steps - status.step
        needed = status.seconds_left or 0.0
        fewest = max(1, FEWEST - self.taken)
        if remaining <= fewest or needed <= left / LATE:
            self._behind = 0.0
        else:
            affordable = remaining * max(left, 0.0) / needed
            self._behind = remaining / max(affordable, fewest) - 1.0

    def __call__(self, trainer: SkipsSteps) -> None:
        self.taken += 1
        self._owed += self._behind
        steps = min(math.floor(self._owed), self.steps - trainer.step - 1)
        if steps > 0:
            trainer.skip_steps(steps)
            self._owed -= steps
