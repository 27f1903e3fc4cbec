"""Threads that divide the work of a kernel.

A parallel kernel of the package is an ordinary compiled function, whose last argument says which part of its loop it is
to do. (numba can divide loops itself: compiling takes three times as long then, and its threads serve one caller at a
time.) The caller does the first part, other threads the rest; as many in all as `numba.set_num_threads` says.
"""

import os
import threading
from collections.abc import Callable
from queue import SimpleQueue
from typing import TypeVar

import numba

A = TypeVar("A")
B = TypeVar("B")
Part = tuple[int, int]  # (which, of how many)
WHOLE: Part = (0, 1)


class Threads:
    """Threads that wait for work. They are started when they are first needed, and end with the process."""

    def __init__(self) -> None:
        self.start_anew()

    def start_anew(self) -> None:
        """Forget the threads: after a fork there are none."""
        self._work: SimpleQueue[_Task] = SimpleQueue()
        self._started = 0
        self._starting = threading.Lock()

    def do(self, work: Callable[[Part], None], count: int) -> None:
        """`work((i, count))` for each i below count, at the same time. Raises what the first of those raised that did,
        once all ended.
        """
        self._start(count - 1)
        done: SimpleQueue[tuple[int, BaseException | None]] = SimpleQueue()
        for i in range(1, count):
            self._work.put((work, (i, count), done))
        errors: list[BaseException | None] = [None] * (1 + count)
        errors[1] = _attempt(work, (0, count))
        for _ in range(1, count):
            # Kernels cannot be stopped: Ctrl-C, too, waits for those that write into the caller's arrays.
            try:
                i, error = done.get()
            except KeyboardInterrupt as stop:
                errors[0] = stop
                i, error = done.get()
            errors[1 + i] = error
        for error in errors:
            if error is not None:
                raise error

    def both(self, first: Callable[[], A], second: Callable[[], B]) -> tuple[A, B]:
        """What they return, computed at the same time if there is a thread for each. Raises what the first raised, else
        what the second did.
        """
        if numba.get_num_threads() == 1:
            return first(), second()
        of_first: list[A] = []
        of_second: list[B] = []

        def work(part: Part) -> None:
            if part[0] == 0:
                of_first.append(first())
            else:
                of_second.append(second())

        self.do(work, 2)
        return of_first[0], of_second[0]

    def _start(self, count: int) -> None:
        if self._started < count:
            with self._starting:
                while self._started < count:
                    name = f"compgs-{self._started + 1}"
                    threading.Thread(target=self._serve, name=name, daemon=True).start()
                    self._started += 1

    def _serve(self) -> None:
        # Of this thread: it divides nothing further, or all might wait for each other.
        numba.set_num_threads(1)
        while True:
            work, part, done = self._work.get()
            done.put((part[0], _attempt(work, part)))
            del work, done  # the caller's arrays are not held until the next task


_Task = tuple[Callable[[Part], None], Part, SimpleQueue]


def _attempt(work: Callable[[Part], None], part: Part) -> BaseException | None:
    try:
        work(part)
    except BaseException as error:
        return error
    return None


THREADS = Threads()
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=THREADS.start_anew)
