"""A run for each tile, in a folder of its own, by the machinery of suites; and all of them merged into one scene."""

import dataclasses
import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from compgs.errors import OutputError, TrainingError
from compgs.formats.tiled_writer import NewTile, write_tiles
from compgs.suites.cluster import Needs, check_ray, run_on_cluster
from compgs.suites.jobs import JOB_NAME, LOG_NAME, Job, Outcome
from compgs.suites.serial import run_serially
from compgs.tiles.plan import PLAN_NAME, Plan

BLOCKS = "blocks"  # folder of the tiles' runs inside the run's


@dataclass(frozen=True)
class TileJob(Job):
    """The training of one tile. It is done when its file is there: tiles are evaluated together."""

    settings: str = ""  # JSON of all that the tile depends on
    compute: tuple[str, ...] = ()  # options that say where and how fast, not what

    @property
    def asked(self) -> dict[str, Any]:
        """What makes it this run and no other; not where the run's folder lies, which may move."""
        return {"tile": self.scene, "settings": json.loads(self.settings)}

    @property
    def continues_by(self) -> tuple[str, ...]:
        return self.compute

    @property
    def file(self) -> Path:
        return self.folder / f"{self.folder.name}.cgs"

    @property
    def done(self) -> bool:
        return self.file.is_file() and self.begun


def tile_jobs(
    plan: Plan, folder: Path, settings: dict[str, Any], compute: Sequence[str] = ()
) -> list[TileJob]:
    """One for each tile of the plan that is in `folder`. `settings`: of the run, as its config.json has them."""
    folder = folder.absolute()
    jobs = []
    for tile in plan.tiles:
        whole = {"settings": settings, "ground": dataclasses.asdict(plan.ground), "tile": tile.to_dict()}
        jobs.append(
            TileJob(
                scene=tile.name,
                method="compgs",
                rate="",
                seed=0,
                command=("tiles", "--tile", f"{folder / PLAN_NAME}#{tile.name}", *compute),
                folder=folder / BLOCKS / tile.name,
                settings=json.dumps(whole),
                compute=tuple(compute),
            )
        )
    return jobs


def forget(jobs: Sequence[TileJob]) -> None:
    """Let the runs begin anew, whatever they have done. Raises OutputError."""
    for job in jobs:
        path = job.folder / JOB_NAME
        try:
            path.unlink(missing_ok=True)
        except OSError as error:
            raise OutputError(f"{path}: cannot be replaced ({error.strerror})") from error


def run_tiles(
    jobs: Sequence[TileJob],
    *,
    cluster: str | None = None,
    needs: Needs | None = None,
    progress: Callable[[int, int, str], None] | None = None,
) -> None:
    """Train what has not been trained, here or on a Ray cluster; `progress(done, total, tile)` as runs begin and end.

    Raises TrainingError when all that could be trained has been and some could not, ConfigError, MissingDependency,
    OSError.
    """
    if cluster is not None:
        check_ray()
    show = progress or (lambda done, total, what: None)
    outcomes: list[Outcome] = []

    def started(job: Job) -> None:
        show(len(outcomes), len(jobs), f"tile {job.scene}")

    running: Iterator[Outcome] = (
        run_serially(jobs, started) if cluster is None else run_on_cluster(jobs, cluster, needs, started)
    )
    for outcome in running:
        outcomes.append(outcome)
        show(len(outcomes), len(jobs), f"tile {outcome.job.scene}")
    failed = [outcome for outcome in outcomes if outcome.error]
    if failed:
        first = failed[0]
        raise TrainingError(
            f"{len(failed)} of {len(jobs)} tiles failed; tile {first.job.scene}: {first.error}; "
            f"{first.job.folder / LOG_NAME} has the rest"
        )


def merge(plan: Plan, jobs: Sequence[TileJob], folder: Path) -> Path:
    """The scene of all tiles, in a folder of its own; the path of its manifest. Raises OutputError, BitstreamError."""
    cores = {tile.name: tile.core for tile in plan.tiles}
    tiles = (NewTile(job.scene, job.file.read_bytes(), cores[job.scene]) for job in jobs)
    return write_tiles(folder, tiles, plan.ground)
