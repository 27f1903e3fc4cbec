"""The table of complexity around phases that are made up, and the phases' own arithmetic."""

import json
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

sys.path.append(str(Path(__file__).parents[1] / "benchmarks"))

import complexity
import complexity_phases
from complexity_phases import PHASES, repeated, view_seconds

from compgs.cli.main import main as compgs_main
from compgs.cli.main import parse
from compgs.cli.train import Train

MEMORY = {"before_mb": 100.0, "peak_mb": 2300.0}


class Phases:
    """Stands for the processes: says the same of every run."""

    def __init__(self, **more: Any) -> None:
        self.calls: list[tuple[str, Path, list[str]]] = []
        self.more = more

    def __call__(self, phase: str, folder: Path, command: Sequence[str]) -> dict[str, Any]:
        self.calls.append((phase, folder, list(command)))
        splats = 900 if "3dgs" in command else None
        seconds = {"train": 150.0, "encode": 0.25, "decode": 0.02, "render": 0.008, "evaluate": 0}[phase]
        results = {
            "views": 12,
            "width": 60,
            "height": 45,
            "threads": 1,
            "device": "cpu",
            "bytes": 17_134,
            "anchors": None if splats else 1689,
            "coupled_primitives": None if splats else 8244,
            "splats": splats,
            "psnr": 29.06,
        }
        training = {"steps": 4000, "seconds_per_step": 0.0375, "frames_per_second": 125.0}
        return {**results, **training, **MEMORY, "seconds": seconds, **self.more}


def table(tmp_path: Path, phases: Phases, *more: str) -> str:
    places = ["-o", str(tmp_path / "out"), "--runs", str(tmp_path / "runs")]
    complexity.main([str(tmp_path / "scene"), *places, *more], phases)
    return (tmp_path / "out" / "complexity_scene.md").read_text()


def test_the_table_says_what_the_phases_said(tmp_path: Path) -> None:
    text = table(tmp_path, Phases())
    assert "| paper | 2.50 | 37.5 | 250.0 | 20.0 | 8.0 | 125 | 17,134 | 1,689 | 8,244 | 29.06 |" in text
    assert "| 3dgs | 2.50 | 37.5 | 250.0 | 20.0 | 8.0 | 125 | 17,134 | none | 900 | 29.06 |" in text
    assert "| default | 2,300 (100) | 2,300 (100) | 2,300 (100) | 2,300 (100) |" in text
    assert "4000 steps; 12 held-out views, 60 x 45 pixels; commit " in text
    content = json.loads((tmp_path / "out" / "complexity_scene.json").read_text())
    assert {"commit", "machine", "scene"} <= content.keys()
    assert list(content["rows"]) == ["paper", "default", "3dgs"]


def test_memory_of_a_gpu_has_columns_of_its_own(tmp_path: Path) -> None:
    text = table(tmp_path, Phases(gpu_peak_mb=512.0), "--only", "paper")
    assert "| paper | 2,300 (100) | 2,300 (100) | 2,300 (100) | 2,300 (100) | 512 | 512 | 512 | 512 |" in text


def test_phases_are_those_of_the_program_that_runs_them() -> None:
    assert tuple(PHASES) == complexity.PHASES


def test_every_method_runs_shortly_before_it_is_measured(tmp_path: Path) -> None:
    phases = Phases()
    table(tmp_path, phases, "--steps", "4000", "-r", "2", "--seed", "3", "--only", "default", "3dgs")
    settings = []
    for _, folder, command in phases.calls[::5]:
        asked = parse(command)
        assert isinstance(asked, Train)
        found = asked.settings(folder)
        assert (found.config.training.seed, found.scene.downscale) == (3, 2)
        settings.append((folder.name, found.method, found.preset, found.config.training.steps))
    assert settings == [
        ("scene_default_warm_up", "compgs", "default", complexity.WARM_UP_STEPS),
        ("scene_default", "compgs", "default", 4000),
        ("scene_3dgs_warm_up", "3dgs", "default", complexity.WARM_UP_STEPS),
        ("scene_3dgs", "3dgs", "default", 4000),
    ]
    assert [phase for phase, _, _ in phases.calls] == 4 * list(PHASES)


def test_what_is_finished_is_measured_again_only_by_another_commit_or_with_other_settings(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    phases = Phases()

    def measured() -> int:
        before = len(phases.calls)
        table(tmp_path, phases, "--only", "paper", *more)
        return len(phases.calls) - before

    more: list[str] = []
    monkeypatch.setattr(complexity, "git_commit", lambda: "first")
    assert (measured(), measured()) == (10, 0)
    more = ["--steps", "80"]
    assert (measured(), measured()) == (10, 0)
    monkeypatch.setattr(complexity, "git_commit", lambda: "second")
    assert (measured(), measured()) == (10, 0)
    monkeypatch.setattr(complexity, "git_commit", lambda: "second+changes")
    assert (measured(), measured()) == (10, 10)


def test_a_phase_that_fails_ends_the_program(tmp_path: Path) -> None:
    with pytest.raises(SystemExit, match="decode of run: exit code"):
        complexity.run_phase("decode", tmp_path / "run", ["train", "nowhere", "-o", "x", "--steps", "-1"])


def test_a_view_counts_with_its_median_and_all_views_with_their_mean() -> None:
    rounds = [[0.1, 0.4], [0.2, 0.2], [9.0, 0.3]]  # medians 0.2 and 0.3
    expected = {"seconds": 0.25, "slowest_seconds": 0.3, "frames_per_second": 4.0}
    assert view_seconds(rounds) == pytest.approx(expected)


def test_the_first_call_is_not_among_those_whose_median_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    seconds = iter([100.0, 5.0, 1.0, 4.0, 2.0, 3.0])
    monkeypatch.setattr(complexity_phases, "timed", lambda function: (next(seconds), function()))
    assert repeated(lambda: None) == {"first_seconds": 100.0, "seconds": 3.0}


@pytest.mark.skipif(not complexity_phases.CLEAR.exists(), reason="the peak can be forgotten on Linux only")
def test_the_peak_of_a_phase_is_its_own() -> None:
    """In a process of its own, as a phase is: this one may hold memory that others have freed."""
    program = f"""
import sys; sys.path[:0] = {sys.path!r}
import numpy as np
from complexity_phases import forget_peak, peak_mb
forget_peak()
start = peak_mb()
block = np.ones(100_000_000, np.uint8)
held = peak_mb() - start
del block
after = peak_mb() - start
forget_peak()
print(held, after, peak_mb() - start)
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    held, after, forgotten = map(float, done.stdout.split())
    assert held == pytest.approx(100, abs=20) and after == pytest.approx(100, abs=20)
    assert forgotten < 50


@pytest.mark.slow
@pytest.mark.parametrize("method", ["default", "3dgs"])
def test_all_phases_of_a_tiny_run(tmp_path: Path, method: str) -> None:
    scene = tmp_path / "scene"
    assert compgs_main(["demo-scene", str(scene), "--views", "40", "--width", "64", "--height", "48"]) == 0
    places = ["-o", str(tmp_path / "out"), "--runs", str(tmp_path / "runs")]
    options = complexity.parse([str(scene), *places, "--steps", "12", "--only", method])
    (chosen,) = (m for m in complexity.METHODS if m.name == method)
    folder = tmp_path / "run"
    folder.mkdir()
    run = complexity_phases.Run(folder, complexity.train_command(chosen, scene, folder, options))
    found = {name: phase(run) for name, phase in PHASES.items()}
    assert found["train"]["steps"] == 12
    assert found["train"]["seconds_per_step"] == pytest.approx(found["train"]["seconds"] / 12)
    assert found["evaluate"]["bytes"] == run.file.stat().st_size
    for name in complexity.MEASURED:
        # The kernel counts pages thread by thread: within a megabyte.
        assert 0 < found[name]["before_mb"] <= found[name]["peak_mb"] + 1
        assert found[name]["seconds"] > 0
