"""`njit`, as every kernel of the package uses it: compiled once on a machine, never stale, in any number of threads.

The options are numba's. There is no `cache`: kernels are always kept (`kernel_cache`). With `parallel=True` a kernel
is called by several threads at once (`threads`), each with its part of the work as the last argument, which callers
from Python leave out:

    @njit(parallel=True)
    def double(x, y, part):
        for i in chunk_of(len(x), part):
            y[i] = 2 * x[i]

    double(x, y)

To hand over a part takes 20 microseconds, in virtual machines 100 and more: with `max_threads`, a function of the same
arguments, a kernel says among how many threads a call is worth to be divided at most.

Parts are contiguous. What stands before the loop is done by every thread. Arrays of one call must not overlap; of other
kernels `no_alias=True` promises that.

Any number of Python threads may call kernels at the same time. Processes are to be started with `spawn`: kernels run
in forked ones, too, but torch's threads do not survive a fork.
"""

from collections.abc import Callable
from types import FunctionType
from typing import Any

import numba
from numba.core import compiler, event, types
from numba.core.registry import CPUDispatcher

from compgs.numerics.compiling import COMPILING
from compgs.numerics.kernel_cache import cache_of
from compgs.numerics.threads import THREADS, WHOLE, Part


class Kernel(CPUDispatcher):
    """A compiled function."""

    def get_call_template(self, args: Any, kws: Any) -> Any:
        """What another kernel calls: one version for all values of a type. (numba would compile one for each constant
        that stands in a call.)"""
        kws = {name: types.unliteral(kind) for name, kind in kws.items()}
        return super().get_call_template(tuple(map(types.unliteral, args)), kws)


class ParallelKernel(Kernel):
    """A compiled function whose calls are divided among threads."""

    # Of a call's arguments: among how many threads at most it is worth to divide it; None: among all
    max_threads: Callable[..., int] | None = None

    def __call__(self, *args: Any) -> None:
        call = super().__call__
        count = numba.get_num_threads()
        if self.max_threads is not None:
            count = min(count, self.max_threads(*args))
        if count <= 1:
            call(*args, WHOLE)
        else:
            THREADS.do(lambda part: call(*args, part), count)


class _WithoutOverlaps(compiler.Compiler):
    """Compiles a function whose arrays do not overlap, which spares loops their checks and loads, as numba does for
    bodies of parallel loops."""

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self.state.flags.noalias = True


def njit(function: Callable[..., Any] | None = None, **options: Any) -> Any:
    """`@njit` or `@njit(parallel=True, ...)`: the function, compiled when it is first called with new types."""
    if function is None:
        return lambda given: njit(given, **options)
    if not isinstance(function, FunctionType) or "cache" in options:
        raise TypeError("expected a function, and numba's options but for cache")
    parallel, max_threads = options.pop("parallel", False), options.pop("max_threads", None)
    compiled_by = _WithoutOverlaps if options.pop("no_alias", parallel) else compiler.Compiler
    if getattr(numba.config, "DISABLE_JIT", False):
        return (lambda *args: function(*args, WHOLE)) if parallel else function
    kernel: Any
    if parallel:
        options = {"nogil": True, "error_model": "numpy", **options}
        kernel = ParallelKernel(function, targetoptions=_options(options), pipeline_class=compiled_by)
        kernel.max_threads = max_threads
    else:
        kernel = Kernel(function, targetoptions=_options(options), pipeline_class=compiled_by)
    kernel._cache = cache_of(function)
    return kernel


def rows_a_thread(least: int) -> Callable[..., int]:
    """Return `max_threads` with which each thread has `least` rows of the last argument or more."""
    return lambda *arguments: len(arguments[-1]) // least


def _options(options: dict[str, Any]) -> dict[str, Any]:
    """Complete the options as numba's own njit does; an entry for C, which nobody uses, is not compiled."""
    return {"nopython": True, "boundscheck": None, "no_cfunc_wrapper": True, **options}


@njit
def chunk_of(count: int, part: Part) -> range:
    """What a part of the work has of range(count); for kernels."""
    number, parts = part
    return range(count * number // parts, count * (number + 1) // parts)


class _Clock(event.Listener):
    def on_start(self, event: Any) -> None:
        COMPILING.start()

    def on_end(self, event: Any) -> None:
        COMPILING.stop()


event.register("numba:compile", _Clock())
