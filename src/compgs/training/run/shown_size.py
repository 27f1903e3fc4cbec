"""The size of the file as a run shows it while it goes on."""

import time
from collections.abc import Callable

from compgs.training.run.time_left import SPARED


class ShownSize:
    """Bytes of the file if it were written now, estimated anew whenever a run can spare the time.

    An estimate looks at every primitive. On a GPU, whose steps take milliseconds, it would take as long as dozens of
    them.
    """

    def __init__(
        self, estimated_bytes: Callable[[], int], clock: Callable[[], float] = time.perf_counter
    ) -> None:
        self.estimated_bytes = estimated_bytes
        self.clock = clock
        self.bytes = 0
        self._due = 0.0
        self._begun = False

    def look(self, *, last: bool) -> float:
        """Estimate the size if it is time for that, or if this is the `last` report. Returns the seconds spent."""
        start = self.clock()
        if start < self._due and not last:
            return 0.0
        self.bytes = self.estimated_bytes()
        took = self.clock() - start
        # The first may compile kernels: how long it takes says nothing about the others.
        self._due = self.clock() + SPARED * took if self._begun else 0.0
        self._begun = True
        return took
