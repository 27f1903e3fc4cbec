"""Kernels are compiled when they are called, by one clock, and parallel ones take turns."""

import importlib
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from numba.core.registry import CPUDispatcher

import compgs
from compgs.cli import compiling as announcing
from compgs.numerics import kernel_cache
from compgs.numerics.compiled import ParallelKernel, njit
from compgs.numerics.compiling import COMPILING, CompilingTime, working_seconds

PACKAGE = Path(compgs.__file__).parent


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


# numba's own threads ("workqueue") end the process when a second thread calls while they work.
TWO_THREADS = """
import sys, threading
import numpy as np
from numba import njit as unlocked, prange, threading_layer
from compgs.numerics.compiled import njit

def total(x, parts):
    for i in prange(len(parts)):
        s = 0.0
        for j in range(len(x)):
            s += x[j] * i
        parts[i] = s

kernel = (njit if sys.argv[1] == "ours" else unlocked)(parallel=True)(total)
x = np.ones(20_000)
kernel(x, np.zeros(8))
def call():
    for _ in range(50):
        parts = np.zeros(8)
        kernel(x, parts)
        found.append(parts.tolist())
found = []
threads = [threading.Thread(target=call) for _ in range(4)]
for thread in threads: thread.start()
for thread in threads: thread.join()
assert found == 200 * [[20_000.0 * i for i in range(8)]]
print(threading_layer())
"""


def test_parallel_kernels_of_several_threads_take_turns() -> None:
    variables = os.environ | {"NUMBA_THREADING_LAYER": "workqueue", "NUMBA_NUM_THREADS": "2"}
    command = [sys.executable, "-c", TWO_THREADS, "ours"]
    done = subprocess.run(command, env=variables, capture_output=True, text=True, timeout=120)
    assert (done.returncode, done.stdout.strip()) == (0, "workqueue"), done.stderr


def test_no_kernel_without_the_lock_calls_a_parallel_one() -> None:
    """Inside a kernel nobody takes the lock."""
    for file in sorted(PACKAGE.rglob("*.py")):
        text = file.read_text(encoding="utf-8")
        if "import njit" not in text:
            continue
        module = importlib.import_module(
            ".".join(("compgs", *file.relative_to(PACKAGE).with_suffix("").parts))
        )
        for kernel in vars(module).values():
            if isinstance(kernel, CPUDispatcher) and not isinstance(kernel, ParallelKernel):
                called = [kernel.py_func.__globals__.get(name) for name in kernel.py_func.__code__.co_names]
                assert not any(isinstance(other, ParallelKernel) for other in called), kernel
