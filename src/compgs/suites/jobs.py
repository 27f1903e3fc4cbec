"""The runs of a suite: one `compgs train` each, in a folder of its own, never repeated, continued after a stop."""

import json
import re
import subprocess
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from compgs.errors import SceneError
from compgs.evaluation.reports.runs import RESULTS_NAME
from compgs.interrupt import Terminated
from compgs.outputs import write_json
from compgs.suites.suite import MethodEntry, SceneEntry, SetValue, Suite

RUNS = "runs"  # folder of the runs inside the output
JOB_NAME = "job.json"  # in a run's folder: what was asked for
LOG_NAME = "output.txt"
CHECKPOINT_NAME = "checkpoint.safetensors"


@dataclass(frozen=True)
class Job:
    """One run."""

    scene: str
    method: str  # its name in tables
    rate: str  # what sets it apart on its curve: `lambda 0.001`; empty where there is but one
    seed: int
    command: tuple[str, ...]  # arguments of `compgs`, without the output
    folder: Path

    @property
    def asked(self) -> dict[str, Any]:
        """What makes it this run and no other, as JSON has it."""
        return {**asdict(self), "folder": self.folder.name, "command": list(self.command)}

    @property
    def continues_by(self) -> tuple[str, ...]:
        """Options with which it is continued after a stop, beside `--resume`."""
        return ()

    @property
    def done(self) -> bool:
        """Whether the folder holds the results of exactly this run."""
        return (self.folder / RESULTS_NAME).is_file() and self.begun

    @property
    def begun(self) -> bool:
        try:
            return json.loads((self.folder / JOB_NAME).read_text(encoding="utf-8")) == self.asked
        except (OSError, ValueError):
            return False


@dataclass(frozen=True)
class Outcome:
    """What became of a job."""

    job: Job
    error: str = ""  # the last line of what it said, if it failed


def jobs_of(suite: Suite, data: Path, output: Path) -> list[Job]:
    """Scene by scene; of each all methods and rates with one seed, then the next seed: a whole table comes early."""
    return [
        _job(suite, scene, method, rate, seed, data, output)
        for seed in suite.seeds
        for scene in suite.scenes
        for method in suite.methods
        for rate in method.rates
    ]


def check_scenes(suite: Suite, data: Path) -> None:
    """Raises SceneError that names every scene that is missing, and where it is published."""
    missing = [scene for scene in suite.scenes if not (data / scene.path).is_dir()]
    if missing:
        named = "; ".join(
            f"{scene.name} ({data / scene.path}"
            + (f", published at {scene.published})" if scene.published else ")")
            for scene in missing
        )
        raise SceneError(
            f"{len(missing)} of {len(suite.scenes)} scenes are missing: {named}; --data names the folder they are in, "
            "--scenes runs some of them"
        )


def run_job(job: Job) -> Outcome:
    """Train, encode, decode, evaluate, in a process of its own. A job that is done is left alone.

    A job that was stopped continues from its checkpoint and gives the same file. Raises OSError where the folder
    cannot be written.
    """
    if job.done:
        return Outcome(job)
    job.folder.mkdir(parents=True, exist_ok=True)
    if job.begun and (job.folder / CHECKPOINT_NAME).is_file():
        arguments = ["train", "-o", str(job.folder), "--resume", *job.continues_by]
    else:
        arguments = [*job.command, "-o", str(job.folder), "--overwrite"]
        write_json(job.folder / JOB_NAME, job.asked)
    log = job.folder / LOG_NAME
    code = _run(arguments, log)
    if code:
        said = log.read_text(encoding="utf-8", errors="replace").strip().splitlines()
        return Outcome(job, f"exit code {code}: {said[-1] if said else 'nothing was said'}")
    return Outcome(job)


def _run(arguments: Sequence[str], log: Path) -> int:
    """The exit code of `compgs`, which ends with this process, whatever ends this one (`child.py`)."""
    with log.open("ab") as out:
        process = subprocess.Popen(
            [sys.executable, "-m", "compgs.suites.child", *arguments],
            stdin=subprocess.PIPE,
            stdout=out,
            stderr=subprocess.STDOUT,
        )
        try:
            return process.wait()
        except KeyboardInterrupt as stop:
            if isinstance(stop, Terminated):  # of which only this process knows; Ctrl-C reaches both
                process.terminate()
            process.wait()  # it is writing its checkpoint
            raise


def rate_name(settings: Mapping[str, SetValue]) -> str:
    """`lambda 0.001`, `target_bytes 60000`, of the settings of a rate."""
    names = {"training.lmbda": "lambda"}
    return ", ".join(
        f"{names.get(key, key.partition('.')[2])} {_word(value)}" for key, value in settings.items()
    )


def _job(
    suite: Suite,
    scene: SceneEntry,
    method: MethodEntry,
    rate: Mapping[str, SetValue],
    seed: int,
    data: Path,
    output: Path,
) -> Job:
    reading = ["-r", str(scene.downscale), "--images", scene.images, "--test-every", str(scene.test_every)]
    if scene.hold_out != "auto":  # not beside those who ran before there was this option
        reading += ["--hold-out", scene.hold_out]
    options = [part for key, value in suite.train.items() for part in _option(key, value)]
    settings = [f"{key}={_word(value)}" for key, value in {**method.set, **rate}.items()]
    command = [
        "train", str(data / scene.path), *reading, "--method", method.method, "--preset", method.preset,
        *options, *(part for setting in settings for part in ("--set", setting)), "--seed", str(seed),
    ]  # fmt: skip
    named = rate_name(rate)
    folder = "_".join(_for_folder(part) for part in (scene.name, method.name, named, f"seed{seed}") if part)
    return Job(scene.name, method.name, named, seed, tuple(command), output / RUNS / folder)


def _option(name: str, value: SetValue) -> Iterable[str]:
    option = f"--{name.replace('_', '-')}"
    if isinstance(value, bool):
        return [option] if value else []
    return [option, _word(value)]


def _word(value: SetValue) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, float):
        return f"{value:g}"
    if isinstance(value, list):
        return ",".join(map(_word, value))
    return str(value)


def _for_folder(name: str) -> str:
    return re.sub(r"[^\w.+-]+", "-", name)
