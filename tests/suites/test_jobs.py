"""Runs are done once, continued after a stop, and their failures are said."""

import json
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from compgs.interrupt import Terminated
from compgs.suites import jobs as jobs_module
from compgs.suites.jobs import Job, jobs_of, run_job
from compgs.suites.serial import run_serially
from compgs.suites.suite import Suite


@pytest.fixture
def commands(monkeypatch: pytest.MonkeyPatch) -> list[list[str]]:
    """Arguments of `compgs`, which does not run."""
    said: list[list[str]] = []

    def run(arguments: list[str], log: Path) -> int:
        said.append(list(arguments))
        log.write_text("reading\nerror: no space\n")
        return 0

    monkeypatch.setattr(jobs_module, "_run", run)
    return said


def first_job(suite: Suite, folder: Path) -> Job:
    return jobs_of(suite, folder / "data", folder)[0]


def test_options_of_a_suite_are_those_of_the_command_line(suite: Suite, tmp_path: Path) -> None:
    asked = {"steps": 5, "lpips": True, "flip": False, "lpips_weights": "weights.npz"}
    command = first_job(replace(suite, train=asked), tmp_path).command
    assert "--lpips" in command and "--flip" not in command
    assert command[command.index("--lpips-weights") + 1] == "weights.npz"
    assert command[command.index("--steps") + 1] == "5"


def test_a_finished_run_is_not_repeated_and_one_of_other_settings_is(
    suite: Suite, tmp_path: Path, commands: list[list[str]], finish: Callable[..., None]
) -> None:
    job = first_job(suite, tmp_path)
    finish(job, 25.0, 1000)
    assert run_job(job).error == "" and commands == []
    other = Job(**{**job.__dict__, "command": (*job.command, "--set", "model.width=32")})
    run_job(other)
    assert commands == [[*other.command, "-o", str(job.folder), "--overwrite"]]


def test_a_stopped_run_continues_from_its_checkpoint(
    suite: Suite, tmp_path: Path, commands: list[list[str]]
) -> None:
    job = first_job(suite, tmp_path)
    run_job(job)  # stopped before its first checkpoint
    run_job(job)
    (job.folder / "checkpoint.safetensors").write_bytes(b"x")
    run_job(job)
    begins = [*job.command, "-o", str(job.folder), "--overwrite"]
    assert commands == [begins, begins, ["train", "-o", str(job.folder), "--resume"]]


def test_a_failure_is_the_last_line_of_what_was_said_and_the_others_go_on(
    suite: Suite, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    codes = iter([0, 1, 0])

    def run(arguments: list[str], log: Path) -> int:
        log.write_text("reading\nerror: no space\n")
        return next(codes)

    monkeypatch.setattr(jobs_module, "_run", run)
    jobs = jobs_of(suite, tmp_path / "data", tmp_path)[:3]
    outcomes = list(run_serially(jobs))
    assert [outcome.error for outcome in outcomes] == ["", "exit code 1: error: no space", ""]


def test_a_run_s_process_is_compgs_and_leaves_what_it_says_in_the_folder(
    suite: Suite, tmp_path: Path
) -> None:
    job = first_job(suite, tmp_path)  # its scene does not exist
    outcome = run_job(job)
    assert outcome.error.startswith("exit code 1: error: ") and "north_folder" in outcome.error
    assert "north_folder" in (job.folder / "output.txt").read_text()
    assert json.loads((job.folder / "job.json").read_text())["scene"] == "north"
    assert not job.done


def test_a_run_ends_when_the_process_that_started_it_is_killed() -> None:
    # The child would wait for its parent for ever: `compgs serve` does.
    program = (
        "import subprocess, sys; p = subprocess.Popen([sys.executable, '-m', 'compgs.suites.child', 'serve', '.', "
        "'--port', '0'], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True); "
        "print(p.pid, p.stdout.readline().strip(), flush=True); p.wait()"
    )
    parent = subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True)
    assert parent.stdout is not None
    child = int(parent.stdout.readline().split()[0])
    assert Path(f"/proc/{child}").exists() or sys.platform != "linux"
    parent.kill()
    parent.wait()
    deadline = time.monotonic() + 20
    while sys.platform == "linux" and _alive(child):
        assert time.monotonic() < deadline, "the run outlived its parent"
        time.sleep(0.05)


def _alive(pid: int) -> bool:
    status = Path(f"/proc/{pid}/stat")
    try:
        return status.read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


@pytest.mark.parametrize(("stop", "told"), [(KeyboardInterrupt, 0), (Terminated, 1)])
def test_a_request_to_end_is_passed_on_to_the_run_which_ctrl_c_reaches_by_itself(
    stop: type[KeyboardInterrupt], told: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    said: list[str] = []

    class Process:
        def __init__(self, *_: object, **__: object) -> None:
            self.waits = iter([stop(), 0])

        def wait(self) -> int:
            found = next(self.waits)
            said.append("wait")
            if isinstance(found, BaseException):
                raise found
            return found

        def terminate(self) -> None:
            said.append("terminate")

    monkeypatch.setattr(subprocess, "Popen", Process)
    with pytest.raises(stop):
        jobs_module._run([], tmp_path / "output.txt")
    assert said == ["wait", *["terminate"] * told, "wait"]
