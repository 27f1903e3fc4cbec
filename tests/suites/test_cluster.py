"""Ray's own cluster of two workers, one of which is killed in mid-run: the table is that of the plain loop."""

import os
import signal
import sys
import threading
import time
from pathlib import Path

import pytest

from compgs.errors import MissingDependency
from compgs.scene.generated import generate_scene
from compgs.suites import benchmark
from compgs.suites.suite import Suite, parse_suite

ray = pytest.importorskip("ray", reason="the extra `cluster` is not installed")
pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="finds the worker to kill in /proc")

TEXT = """
title = "Tiny"
seeds = [0]
[train]
steps = 60
threads = 1
[scenes.tiny]
path = "tiny"
[methods.ours]
method = "compgs"
[methods.3dgs]
method = "3dgs"
"""


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("data")
    generate_scene(folder / "tiny", views=8, width=48, height=36, seed=0)
    return folder


@pytest.fixture(scope="module")
def tiny() -> Suite:
    return parse_suite(TEXT, "tiny.toml")


def processes(word: str) -> list[int]:
    """Whose command line has a word."""
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            if word.encode() in (folder / "cmdline").read_bytes():
                found.append(int(folder.name))
        except OSError:
            continue
    return found


def parent(pid: int) -> int:
    return int(Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[1])


def kill_one_worker(output: Path, killed: list[int]) -> None:
    """The worker of the first run that has begun."""
    deadline = time.monotonic() + 120
    while not killed and time.monotonic() < deadline:
        for pid in processes(str(output)):
            try:
                if b"compgs.suites.child" in Path(f"/proc/{pid}/cmdline").read_bytes():
                    worker = parent(pid)
                    os.kill(worker, signal.SIGKILL)
                    killed.append(worker)
                    return
            except OSError:
                continue
        time.sleep(0.05)


@pytest.mark.slow
def test_a_worker_that_dies_costs_nothing_but_time_and_the_table_is_that_of_the_plain_loop(
    tiny: Suite, data: Path, tmp_path: Path
) -> None:
    serial = benchmark(tiny, tmp_path / "serial", data=data)
    killed: list[int] = []
    killer = threading.Thread(target=kill_one_worker, args=(tmp_path / "cluster", killed))
    killer.start()
    stops = signal.getsignal(signal.SIGTERM)
    ray.init(num_cpus=2, include_dashboard=False, log_to_driver=False, logging_level="error")
    try:
        cluster = benchmark(tiny, tmp_path / "cluster", data=data, cluster="local")
    finally:
        ray.shutdown()
        signal.signal(signal.SIGTERM, stops)
        killer.join()
    assert len(killed) == 1
    assert serial.failed == cluster.failed == ()
    for name in ("table.csv", "table.md", "table.tex"):
        assert (tmp_path / "cluster" / name).read_bytes() == (tmp_path / "serial" / name).read_bytes()
    # Nothing is run again: results stay as they are.
    before = {path: path.stat().st_mtime_ns for path in (tmp_path / "serial").glob("runs/*/results.json")}
    assert len(before) == 2
    benchmark(tiny, tmp_path / "serial", data=data)
    assert {path: path.stat().st_mtime_ns for path in before} == before


def test_without_ray_the_remedy_is_said_before_anything_runs(
    tiny: Suite, data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(MissingDependency, match=r"pip install '.\[cluster\]'"):
        benchmark(tiny, tmp_path / "out", data=data, cluster="local")
    assert not (tmp_path / "out").exists()
