"""Who renders for all visitors, and when: one thread, so that kernels never run twice at once.

Kernels use all cores, and two of them at once abort the process where there is no OpenMP. A viewer of a file has a
thread for them; a viewer of a training does without one: the training itself renders between two of its steps, for a
small share of its time.
"""

import contextlib
import queue
import time
from collections.abc import Callable
from concurrent.futures import CancelledError, Future, ThreadPoolExecutor
from typing import Any, Protocol, TypeVar

T = TypeVar("T")
SHARE = 0.08  # of a training's time for all rendering: with what encoding and sending costs less than a tenth
MOST_CREDIT = 0.5  # seconds: nobody who looks after an hour gets six minutes at once


class Stage(Protocol):
    """Where jobs are done, one after the other."""

    def run(self, job: Callable[[], T]) -> T:
        """What the job gives, once it has had its turn. Raises what it raises, and CancelledError after `close`."""
        ...

    def close(self) -> None: ...


class OwnThread:
    """Jobs in the order in which they come, in a thread of their own. `begin`: its first job."""

    def __init__(self, begin: Callable[[], None] = lambda: None) -> None:
        self._thread = ThreadPoolExecutor(1, "compgs-render", begin)

    def run(self, job: Callable[[], T]) -> T:
        try:
            future = self._thread.submit(job)
        except RuntimeError as error:  # closed
            raise CancelledError from error
        return future.result()

    def close(self) -> None:
        self._thread.shutdown(wait=False, cancel_futures=True)


class SpareTime:
    """Jobs wait until the thread that has better things to do spares them a share of its time (`tend`)."""

    def __init__(self, share: float = SHARE, clock: Callable[[], float] = time.perf_counter) -> None:
        self._clock = clock
        self._share = share
        self._credit = 0.0  # seconds that may be spent; below 0 they have been
        self._since = clock()
        self._first = True
        self._closed = False
        self._jobs: queue.SimpleQueue[tuple[Callable[[], Any], Future[Any]]] = queue.SimpleQueue()

    def run(self, job: Callable[[], T]) -> T:
        future: Future[T] = Future()
        self._jobs.put((job, future))
        if self._closed:
            self._cancel()
        return future.result()

    def tend(self) -> None:
        """Do what waits, as long as there is time for it; to be called often, always by the same thread."""
        now = self._clock()
        self._credit = min(self._credit + self._share * (now - self._since), MOST_CREDIT)
        while self._credit >= 0:
            try:
                job, future = self._jobs.get_nowait()
            except queue.Empty:
                break
            try:
                future.set_result(job())
            except Exception as error:
                future.set_exception(error)
            except BaseException:  # the training is stopped
                future.cancel()
                raise
            before, now = now, self._clock()
            # The first one loads or compiles kernels, once.
            self._credit -= min(now - before, MOST_CREDIT) if self._first else now - before
            self._first = False
        self._since = now

    def close(self) -> None:
        self._closed = True
        self._cancel()

    def _cancel(self) -> None:
        with contextlib.suppress(queue.Empty):
            while True:
                self._jobs.get_nowait()[1].cancel()
