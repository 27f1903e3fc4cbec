"""Kernels are compiled when they are called, by one clock; parallel ones divide their work among threads."""

import os
import threading
import time
from collections.abc import Callable

import numba
import numpy as np
import pytest

from compgs.cli import compiling as announcing
from compgs.numerics import kernel_cache
from compgs.numerics.compiled import chunk_of, njit
from compgs.numerics.compiling import COMPILING, CompilingTime, working_seconds
from compgs.numerics.threads import THREADS, Part, Threads


@pytest.fixture(autouse=True)
def nothing_is_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kernel_cache, "writable_parent", lambda: None)


def test_options_reach_the_compiler() -> None:
    kernel = njit(error_model="numpy", fastmath={"contract"})(lambda x: 1.0 / x)
    assert kernel.targetoptions["fastmath"] == {"contract"}
    assert kernel(0.0) == np.inf


def test_what_cannot_be_a_kernel_is_refused() -> None:
    with pytest.raises(TypeError, match="a function"):
        njit("f8(f8)")
    with pytest.raises(TypeError, match="but for cache"):
        njit(cache=True)(lambda x: x)


def test_nested_compilations_are_counted_once(monkeypatch: pytest.MonkeyPatch) -> None:
    now = 0.0
    monkeypatch.setattr("time.perf_counter", lambda: now)
    clock, heard = CompilingTime(), []
    clock.listen(heard.append)
    clock.start()
    now = 1.0
    clock.start()
    now = 3.0
    clock.stop()
    assert clock.spent() == 3.0
    now = 4.0
    clock.stop()
    now = 9.0
    clock.start()
    clock.stop()
    assert (clock.seconds, clock.spent(), heard) == (4.0, 4.0, [0.0, 1.0, 4.0])


def test_time_for_compiling_is_not_time_for_working() -> None:
    inner = njit(lambda x: x + 1)
    outer = njit(lambda x: inner(x) * 2)
    spent, worked = COMPILING.spent(), working_seconds()
    assert outer(3) == 8
    compiling, working = COMPILING.spent() - spent, working_seconds() - worked
    assert compiling > 5 * working > 0


def test_compiling_is_said_once_and_not_for_a_moment(capsys: pytest.CaptureFixture[str]) -> None:
    announce = announcing.Announcement()
    for seconds in (0.0, 0.3, 0.6, 4.0):
        announce(seconds)
    assert capsys.readouterr().out == "compiling, once on this machine\n"


def test_constants_in_a_call_make_no_kernel_of_their_own() -> None:
    inner = njit(lambda x, y: x + y)
    outer = njit(lambda x: inner(x, 3) + inner(x, 4))
    assert (outer(1), len(inner.overloads)) == (9, 1)


# ---- parallel kernels


@njit(parallel=True)
def fill(out, part):
    for i in chunk_of(len(out), part):
        out[i] += 10 * part[1] + part[0]


@pytest.fixture
def threads(with_threads: Callable[[int], None]) -> int:
    """As many as there may be, two at least."""
    most = max(2, numba.config.NUMBA_NUM_THREADS)
    with_threads(most)
    return most


def filled(count: int) -> np.ndarray:
    out = np.zeros(count, np.int64)
    fill(out)
    return out


def test_a_parallel_kernel_does_all_of_its_work_once_in_contiguous_parts(threads: int) -> None:
    for count in (0, 1, threads, 1000):
        expected = 10 * threads + np.arange(threads).repeat(
            [count * (i + 1) // threads - count * i // threads for i in range(threads)]
        )
        assert filled(count).tolist() == expected.tolist()


def test_on_one_thread_there_is_one_part(with_threads: Callable[[int], None]) -> None:
    with_threads(1)
    assert filled(5).tolist() == [10] * 5


def test_several_threads_may_call_parallel_kernels_at_once(threads: int) -> None:
    def call() -> None:
        results.extend(filled(100).sum() for _ in range(200))

    results: list[int] = []
    callers = [threading.Thread(target=call) for _ in range(4)]
    for caller in callers:
        caller.start()
    for caller in callers:
        caller.join()
    assert results == 800 * [filled(100).sum()]


def test_an_error_in_any_part_reaches_the_caller_when_all_parts_have_ended() -> None:
    ended = []

    def work(part: Part) -> None:
        if part[0] == failing:
            raise ValueError(f"part {part[0]}")
        time.sleep(0.05)
        ended.append(part[0])

    for failing in range(3):
        ended.clear()
        with pytest.raises(ValueError, match=f"part {failing}"):
            Threads().do(work, 3)
        assert sorted(ended) == [i for i in range(3) if i != failing]


@pytest.mark.parametrize("failing", [(0, 1, 2), (1, 2), (2,)])
def test_of_several_errors_the_caller_gets_that_of_the_first_part(failing: tuple[int, ...]) -> None:
    def work(part: Part) -> None:
        time.sleep(0.02 * (3 - part[0]))  # the last fails first
        if part[0] in failing:
            raise ValueError(f"part {part[0]}")

    with pytest.raises(ValueError, match=f"part {failing[0]}"):
        Threads().do(work, 3)


def test_two_tasks_meet_on_two_threads(threads: int) -> None:
    meeting = threading.Barrier(2, timeout=20)
    assert sorted(Threads().both(meeting.wait, meeting.wait)) == [0, 1]


def test_on_one_thread_two_tasks_come_one_after_the_other_and_an_error_ends_both(
    with_threads: Callable[[int], None],
) -> None:
    came: list[int] = []
    with_threads(1)
    Threads().both(lambda: came.append(threading.get_ident()), lambda: came.append(threading.get_ident()))
    assert came == [threading.get_ident()] * 2
    with pytest.raises(ZeroDivisionError):
        Threads().both(lambda: 1 // 0, lambda: came.append(0))
    assert len(came) == 2


def test_tasks_of_threads_may_call_parallel_kernels(threads: int) -> None:
    """They divide nothing further: as many tasks as threads, each waiting for another, would never end."""
    first, second = THREADS.both(lambda: filled(100), lambda: filled(100))
    assert first.tolist() == filled(100).tolist() and second.tolist() == [10] * 100


@njit(parallel=True, max_threads=lambda out: len(out) // 4)
def fill_large(out, part):
    for i in chunk_of(len(out), part):
        out[i] += 10 * part[1] + part[0]


def test_a_call_that_is_not_worth_it_is_not_divided(threads: int) -> None:
    small, large = np.zeros(7, np.int64), np.zeros(4 * threads, np.int64)
    fill_large(small)
    fill_large(large)
    assert small.tolist() == [10] * 7
    assert large.tolist() == (10 * threads + np.arange(threads).repeat(4)).tolist()


@pytest.mark.skipif(not hasattr(os, "fork"), reason="the system does not fork")
@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_parallel_kernels_run_in_forked_processes(threads: int) -> None:
    total = filled(100).sum()
    child = os.fork()
    if child == 0:
        os._exit(0 if filled(100).sum() == total else 1)
    assert os.waitpid(child, 0)[1] == 0
