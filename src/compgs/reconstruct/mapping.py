"""Features, matches, poses: COLMAP's stages, in a process of their own that is watched from here."""

import contextlib
import json
import sqlite3
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from queue import Empty, Queue
from typing import Any, Literal

from compgs.errors import SceneError
from compgs.extras import require
from compgs.reconstruct.adjusting import ROUNDS
from compgs.reconstruct.cameras import SharedCamera
from compgs.reconstruct.retrieval import ALIKE, NEAR

Stage = Literal["features", "matching", "mapping", "adjusting"]
Progress = Callable[[Stage, int, int], None]  # stage, done, total


def silent(stage: Stage, done: int, total: int) -> None:
    """Say nothing of the progress."""


LOOK_SECONDS = 1.0  # between two looks at how far a stage is
TAIL = 3  # last lines of COLMAP's log that an error shows


@dataclass(frozen=True)
class Job:
    """What the worker is told, as JSON."""

    images: str  # folder
    database: str  # file that it makes
    models: str  # folder for sparse models
    lens: str  # COLMAP's name of the camera model
    shared: SharedCamera
    matching: Literal["exhaustive", "sequential", "retrieval"]
    overlap: int  # sequential: neighbours on each side
    features: int  # most of a photograph
    feature_size: int  # pixels: larger photographs are shrunk to find features
    threads: int | None
    seed: int


@dataclass(frozen=True)
class AdjustJob:
    """What the worker is told to adjust given cameras, as JSON."""

    images: str  # folder: photographs of one camera lie in one folder
    database: str  # file that it makes
    pairs: str  # file: two names a line
    given: str  # folder of the sparse model
    names: dict[str, str]  # of the given model's images -> of files in `images`
    adjusted: str  # folder for the new model
    features: int  # most of a photograph
    feature_size: int  # pixels: larger photographs are shrunk to find features
    threads: int | None
    seed: int


def check_colmap() -> None:
    """Raises MissingDependency, with the remedy, where pycolmap is not installed."""
    require("reconstruct", "finding poses")


def run_colmap(job: Job, photographs: int, progress: Progress) -> None:
    """Runs the stages; sparse models are then in `job.models`, one folder each. Raises SceneError if COLMAP fails."""
    pairs = matched_pairs(photographs, job)
    log = Path(job.database).with_name("colmap.log")
    with _worker(asdict(job), log) as process:
        _watch(process, Path(job.database), photographs, pairs, progress)


def adjust_cameras(job: AdjustJob, photographs: int, progress: Progress) -> dict[str, Any]:
    """Runs the adjustment; the new model is then in `job.adjusted`. What the worker tells of it. Raises SceneError."""
    database = Path(job.database)
    with _worker(asdict(job), database.with_name("colmap.log")) as process:
        _watch(process, database, photographs, 0, progress)
    told: dict[str, Any] = json.loads(database.with_name("adjusted.json").read_text(encoding="utf-8"))
    return told


def undistort_images(images: Path, model: Path, target: Path) -> None:
    """Writes `target`/images and `target`/sparse, of pinhole cameras. Raises SceneError if COLMAP fails."""
    job = {"images": str(images), "model": str(model), "undistorted": str(target)}
    with _worker(job, target.with_name("undistortion.log")):
        pass


@contextlib.contextmanager
def _worker(job: dict[str, Any], log: Path) -> Iterator["subprocess.Popen[str]"]:
    """The process at work; it is waited for at the end, or ended if the block fails. Raises SceneError if it fails."""
    with log.open("wb") as errors:
        process = subprocess.Popen(
            [sys.executable, "-m", "compgs.reconstruct.worker"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=errors,
            text=True,
        )
    try:
        assert process.stdin is not None
        with contextlib.suppress(BrokenPipeError):  # it ended at once; its exit code says so
            process.stdin.write(json.dumps(job))
            process.stdin.close()
        yield process
        code = process.wait()
    finally:
        process.kill()
        process.wait()
    if code:
        last = " | ".join(log.read_text(encoding="utf-8", errors="replace").splitlines()[-TAIL:])
        raise SceneError(f"{job['images']}: COLMAP ended with exit code {code}: {last}")


def matched_pairs(photographs: int, job: Job) -> int:
    """How many pairs of photographs are compared, about."""
    every = photographs * (photographs - 1) // 2
    if job.matching == "retrieval":
        return min(every, photographs * (NEAR + ALIKE))
    # `overlap` neighbours, and as many at distances of powers of two
    return min(every, 2 * photographs * job.overlap) if job.matching == "sequential" else every


def _watch(
    process: "subprocess.Popen[str]", database: Path, photographs: int, pairs: int, progress: Progress
) -> None:
    lines: Queue[str | None] = Queue()

    def read() -> None:
        assert process.stdout is not None
        for line in process.stdout:
            lines.put(line)
        lines.put(None)

    threading.Thread(target=read, daemon=True).start()
    stage: Stage | None = None
    registered = 0
    while True:
        try:
            line = lines.get(timeout=LOOK_SECONDS)
        except Empty:
            if stage == "features":
                progress(stage, _count(database, "keypoints"), photographs)
            elif stage == "matching":
                progress(stage, min(pairs, _count(database, "matches")), pairs)
            continue
        if line is None:
            return
        told = json.loads(line)
        if told["event"] == "registered":
            # Of the model that is being built: a later one starts again.
            registered = min(photographs, registered + told["count"])
            progress("mapping", registered, photographs)
        elif told["event"] == "pairs":
            pairs = told["count"]
        elif told["event"] == "round":
            progress("adjusting", told["count"], ROUNDS)
        else:
            stage = told["event"]
            totals = {"matching": pairs, "adjusting": ROUNDS}
            progress(told["event"], 0, totals.get(told["event"], photographs))


def _count(database: Path, table: str) -> int:
    """Rows of a table of COLMAP's database, which it is writing."""
    with contextlib.suppress(sqlite3.Error):
        connection = sqlite3.connect(f"{database.absolute().as_uri()}?mode=ro", uri=True, timeout=0.1)
        try:
            return int(connection.execute(f"SELECT COUNT(*) FROM {table}").fetchone()[0])
        finally:
            connection.close()
    return 0
