"""`njit`, as every kernel of the package uses it: compiled once on a machine, never stale, safe among threads.

The options are numba's. There is no `cache`: kernels are always kept (`kernel_cache`).

Kernels with `parallel=True` run one at a time. Without OpenMP or TBB, numba's own threads serve one caller only, and
end the process when a second thread calls: Python threads that render take turns instead. Processes that are *forked*
after a parallel kernel has run cannot run another, in any of numba's threading layers; use the start method `spawn`.
"""

import threading
from collections.abc import Callable
from types import FunctionType
from typing import Any

import numba
from numba.core import event
from numba.core.registry import CPUDispatcher

from compgs.numerics.compiling import COMPILING
from compgs.numerics.kernel_cache import cache_of

_ONE_AT_A_TIME = threading.RLock()  # as a handler of a signal may run kernels within a kernel's call


class ParallelKernel(CPUDispatcher):
    """A compiled function with threads of its own."""

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        with _ONE_AT_A_TIME:
            return super().__call__(*args, **kwargs)


def njit(function: Callable[..., Any] | None = None, **options: Any) -> Any:
    """`@njit` or `@njit(parallel=True, ...)`: the function, compiled when it is first called with new types."""
    if function is None:
        return lambda given: njit(given, **options)
    if not isinstance(function, FunctionType) or "cache" in options:
        raise TypeError("expected a function, and numba's options but for cache")
    if getattr(numba.config, "DISABLE_JIT", False):
        return function
    kind = ParallelKernel if options.get("parallel") else CPUDispatcher
    kernel: Any = kind(py_func=function, targetoptions={"nopython": True, "boundscheck": None, **options})
    kernel._cache = cache_of(function)
    return kernel


class _Clock(event.Listener):
    def on_start(self, event: Any) -> None:
        COMPILING.start()

    def on_end(self, event: Any) -> None:
        COMPILING.stop()


event.register("numba:compile", _Clock())
