"""Helpers compile early what a command will need; nothing depends on them."""

import os
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from numba import types

from compgs.codec.octree import Level
from compgs.numerics import ahead, kernel_cache
from compgs.numerics.ahead import Entry, entry_of, listed
from compgs.numerics.compiled import njit

fcntl = pytest.importorskip("fcntl", reason="the system has no locks that end with their process")

STAGES = ("decode", "render", "train", "encode")
INT = (types.int64,)


@pytest.fixture
def folder(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    monkeypatch.setattr(kernel_cache, "writable_parent", lambda: tmp_path)
    return tmp_path


def double(x):
    return 2 * x


def lock_of(kernel: object) -> Path:
    cache = kernel._cache
    return cache._cache_file.path(cache._index_key(INT, kernel.targetctx.codegen())).with_suffix(".lock")


def hits(kernel: object) -> int:
    return sum(kernel.stats.cache_hits.values())


# ---- the list


@pytest.mark.parametrize(
    "arguments",
    [
        (),
        (types.int64, types.float64, types.boolean, types.none),
        (
            types.float32[:, ::1],
            types.uint8[::1],
            types.boolean[::1],
            types.float32[:, :],
            types.float32[::1, :],
        ),
        (types.Array(types.float32, 2, "C", readonly=True),),
        (types.UniTuple(types.int64, 2), types.Tuple((types.int64, types.float64))),
        (types.NamedTuple((types.uint64, types.int32[::1], types.int64[::1], types.int16[::1]), Level),),
    ],
    ids=str,
)
def test_types_are_spelled_so_that_they_can_be_read_again(arguments: tuple[types.Type, ...]) -> None:
    assert Entry("", "", ahead.spelled(arguments)).types() == arguments


@pytest.mark.parametrize("stage", STAGES)
def test_every_listed_kernel_exists(stage: str) -> None:
    for entry in listed((stage,)):
        assert entry_of(entry.kernel(), entry.types()) == entry


def test_what_decoding_needs_is_listed(tiny_cgs: Path) -> None:
    program = (
        "import compgs; from compgs.numerics.ahead import used_kernels, listed; "
        f"compgs.decode({str(tiny_cgs)!r}, 'cpu'); missing = set(used_kernels()) - set(listed(('decode',))); "
        "assert not missing, missing"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.returncode == 0, f"{done.stderr}\nbenchmarks/cold_start.py --list writes the list"


# ---- who compiles what


def test_helpers_share_the_list_and_begin_where_the_command_ends() -> None:
    entries = [Entry("m", str(i), "()") for i in range(10)]
    assert ahead.order(entries, 0, 2)[0].name == "9"
    assert ahead.order(entries, 1, 2)[0].name == "4"
    assert all(sorted(ahead.order(entries, turn, 3)) == entries for turn in range(3))


def test_a_helper_compiles_into_the_cache(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    kernel = njit(double)
    monkeypatch.setattr(Entry, "kernel", lambda self: kernel)
    ahead.help_compile([Entry("", "", "(int64,)")])
    again = njit(double)
    assert (again(4), hits(again)) == (8, 1)


def test_a_helper_leaves_alone_what_somebody_is_compiling(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kernel = njit(double)
    lock = lock_of(kernel)
    lock.parent.mkdir(parents=True)
    monkeypatch.setattr(Entry, "kernel", lambda self: kernel)
    with lock.open("wb") as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        ahead.help_compile([Entry("", "", "(int64,)")])
        assert not kernel.overloads
    ahead.help_compile([Entry("", "", "(int64,)")])
    assert kernel.overloads


def test_a_helper_ends_with_its_command(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    parents = iter([1, 1, 2, 2])
    kernels = [njit(double), njit(double)]
    waiting = iter(kernels)
    monkeypatch.setattr(os, "getppid", lambda: next(parents))
    monkeypatch.setattr(Entry, "kernel", lambda self: next(waiting))
    ahead.help_compile([Entry("", "", "(int64,)"), Entry("", "", "(float64,)")])
    assert [len(kernel.overloads) for kernel in kernels] == [1, 0]


def test_who_needs_a_kernel_that_another_compiles_waits_for_it(folder: Path) -> None:
    first, second = njit(double), njit(double)
    first(1)
    (file,) = folder.rglob("*.kernel")
    aside = file.with_suffix(".aside")
    file.rename(aside)
    held = lock_of(second).open("wb")
    fcntl.flock(held, fcntl.LOCK_EX)

    def finish() -> None:
        time.sleep(0.2)
        aside.rename(file)
        held.close()

    other = threading.Thread(target=finish)
    other.start()
    assert (second(4), hits(second)) == (8, 1)
    other.join()


def test_a_process_that_ends_while_it_compiles_stops_nobody(folder: Path) -> None:
    kernel = njit(double)
    lock_of(kernel).parent.mkdir(parents=True)
    held = lock_of(kernel).open("wb")
    fcntl.flock(held, fcntl.LOCK_EX)
    threading.Timer(0.2, held.close).start()
    assert (kernel(4), hits(kernel)) == (8, 0)
    again = njit(double)
    assert (again(4), hits(again)) == (8, 1)


# ---- when there are helpers


@pytest.fixture
def started(folder: Path, monkeypatch: pytest.MonkeyPatch) -> list[list[str]]:
    """Commands of the helpers that would be started, on a machine of four cores."""
    commands: list[list[str]] = []
    monkeypatch.setattr(ahead, "cores", lambda: 4)
    monkeypatch.setattr(subprocess, "Popen", lambda command, **options: commands.append(command))
    monkeypatch.setattr(ahead, "listed", lambda stages: [Entry("compgs.codec.rans", "", "")])
    return commands


def test_helpers_are_started_where_kernels_are_missing(started: list[list[str]]) -> None:
    ahead.start_helpers("decode")
    assert [command[-2:] for command in started] == [["0/3", "decode"], ["1/3", "decode"], ["2/3", "decode"]]


def test_no_helpers_are_started_where_there_are_kernels(started: list[list[str]]) -> None:
    kernel_cache.folder_of("compgs.codec.rans").mkdir(parents=True)
    ahead.start_helpers("decode")
    assert started == []


def test_no_helpers_are_started_on_one_core(
    started: list[list[str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ahead, "cores", lambda: 1)
    ahead.start_helpers("decode")
    assert started == []


def test_no_helpers_are_started_where_kernels_cannot_be_kept(
    started: list[list[str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(kernel_cache, "writable_parent", lambda: None)
    ahead.start_helpers("decode")
    assert started == []


def test_a_helper_is_a_process_that_ends_by_itself(tmp_path: Path) -> None:
    variables = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}
    command = [sys.executable, "-P", "-m", "compgs.numerics.ahead", "0/1"]
    done = subprocess.run(command, env=variables, capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def test_arrays_of_the_list_are_those_of_numpy() -> None:
    kernel = njit(double)
    kernel(np.ones((2, 3), np.float32))
    assert entry_of(kernel, kernel.signatures[0]).types() == (types.float32[:, ::1],)
