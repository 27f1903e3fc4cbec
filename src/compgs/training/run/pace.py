"""How fast the steps of a run are."""

import time


class Pace:
    """Seconds per step, of the last steps; what the first step takes to compile or load kernels does not count."""

    def __init__(self) -> None:
        self.seconds = 0.0  # unknown before the second step
        self._size: object = None
        self._since: float | None = None
        self._steps = 0

    def step(self) -> None:
        """Count a step."""
        if self._since is None:
            self._since = time.perf_counter()
        else:
            self._steps += 1

    def look(self, size: object = None) -> float:
        """Seconds per step, smoothed; the mean is forgotten when steps become twice as fast, as after compiling, or
        look at pictures of another size.
        """
        now = time.perf_counter()
        if self._since is not None and self._steps:
            recent = (now - self._since) / self._steps
            steady = self.seconds and size == self._size and recent >= 0.5 * self.seconds
            self._size = size
            self.seconds = 0.9 * self.seconds + 0.1 * recent if steady else recent
            self._since, self._steps = now, 0
        return self.seconds

    def pause(self, seconds: float) -> None:
        """Leave out seconds that were spent on something else than steps."""
        if self._since is not None:
            self._since += seconds
