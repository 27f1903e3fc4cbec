"""Time that went into compiling kernels, and who wants to hear that some is compiled.

Knows nothing of numba, so that the command line can ask to be told before anything heavy is loaded; `compiled`
reports here.
"""

import time
from collections.abc import Callable

# Told before each compilation: the seconds that all earlier ones of this process took together.
Listener = Callable[[float], None]


class CompilingTime:
    """A clock that runs while kernels are compiled, one inside the other or one after the other."""

    def __init__(self) -> None:
        self.seconds = 0.0
        self._depth = 0  # a kernel that calls others compiles them while it is compiled
        self._since = 0.0
        self._listeners: list[Listener] = []

    def listen(self, listener: Listener) -> None:
        """Call `listener(seconds so far)` before each compilation."""
        self._listeners.append(listener)

    def start(self) -> None:
        """A compilation begins."""
        for listener in self._listeners:
            listener(self.spent())
        if self._depth == 0:
            self._since = time.perf_counter()
        self._depth += 1

    def stop(self) -> None:
        """The compilation that began last ends."""
        self._depth -= 1
        if self._depth == 0:
            self.seconds += time.perf_counter() - self._since

    def spent(self) -> float:
        """Seconds until now, with those of a compilation under way."""
        running = time.perf_counter() - self._since if self._depth else 0.0
        return self.seconds + running


COMPILING = CompilingTime()  # of this process


def working_seconds() -> float:
    """Seconds on a clock that stands still while kernels are compiled. Differences of two readings are how long
    something takes on a machine that has its kernels."""
    return time.perf_counter() - COMPILING.spent()
