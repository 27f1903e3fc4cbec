"""Who renders, and when: jobs one after the other, a training's for a share of its time."""

import contextlib
import threading
import time
from collections.abc import Callable
from concurrent.futures import CancelledError

import pytest

from compgs.viewer.stage import MOST_CREDIT, OwnThread, SpareTime


def in_threads(count: int, action: Callable[[int], None]) -> list[threading.Thread]:
    def until_the_end(i: int) -> None:
        with contextlib.suppress(CancelledError):
            action(i)

    threads = [threading.Thread(target=until_the_end, args=(i,), daemon=True) for i in range(count)]
    for thread in threads:
        thread.start()
    return threads


def test_jobs_of_a_thread_of_its_own_never_overlap() -> None:
    begun, names, inside, most = [], set(), [], []
    stage = OwnThread(lambda: begun.append(threading.current_thread().name))

    def job() -> int:
        names.add(threading.current_thread().name)
        inside.append(1)
        most.append(len(inside))
        time.sleep(0.002)
        inside.pop()
        return 7

    results: list[int] = []
    threads = in_threads(8, lambda _: results.append(stage.run(job)))
    for thread in threads:
        thread.join(10)
    assert results == [7] * 8 and max(most) == 1
    assert len(begun) == 1 and names == set(begun)
    stage.close()
    with pytest.raises(CancelledError):
        stage.run(job)


class Clock:
    """Time that goes on only when it is told to."""

    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now

    def job(self, seconds: float) -> Callable[[], None]:
        def take() -> None:
            self.now += seconds

        return take


def asked(stage: SpareTime, jobs: list[Callable[[], None]]) -> list[threading.Thread]:
    """Threads that wait for the jobs, which are in the queue, in order."""
    threads = []
    for job in jobs:
        before = stage._jobs.qsize()
        threads += in_threads(1, lambda _, job=job: stage.run(job))  # type: ignore[misc]
        while stage._jobs.qsize() == before:
            time.sleep(0.001)
    return threads


def test_visitors_get_their_share_of_a_training_s_time_and_no_more() -> None:
    clock = Clock()
    stage = SpareTime(share=0.1, clock=clock)
    spent = 0.0

    def one(seconds: float) -> None:
        nonlocal spent
        clock.now += seconds
        spent += seconds

    threads = asked(stage, [lambda: one(0.2)] * 400)
    start = clock.now
    for _ in range(1000):
        clock.now += 0.1  # a step of training
        stage.tend()
    share = spent / (clock.now - start)
    assert 0.09 < share < 0.1 + 0.2 / 100
    stage.close()
    for thread in threads:
        thread.join(10)
        assert not thread.is_alive()


def test_nobody_who_comes_late_gets_all_at_once() -> None:
    clock = Clock()
    stage = SpareTime(share=0.1, clock=clock)
    clock.now += 3600.0
    asked(stage, [clock.job(0.1)] * 100)
    before = clock.now
    stage.tend()
    assert clock.now - before <= MOST_CREDIT + 0.1 + 1e-9
    stage.close()


def test_the_first_picture_may_take_long_because_kernels_are_compiled() -> None:
    clock = Clock()
    stage = SpareTime(share=0.1, clock=clock)
    asked(stage, [clock.job(60.0), clock.job(0.01)])
    stage.tend()
    clock.now += MOST_CREDIT / 0.1 + 1e-6
    before = clock.now
    stage.tend()
    assert clock.now > before
    stage.close()


def test_what_a_job_raises_reaches_who_asked_and_not_who_trains() -> None:
    stage, raised = SpareTime(), []

    def wrong() -> None:
        raise ValueError("no")

    def ask(_: int) -> None:
        try:
            stage.run(wrong)
        except (ValueError, CancelledError) as error:
            raised.append(type(error))

    (thread,) = in_threads(1, ask)
    while not stage._jobs.qsize():
        time.sleep(0.001)
    stage.tend()
    thread.join(10)
    stage.close()
    ask(0)  # after the end: nobody waits for ever
    assert raised == [ValueError, CancelledError]
