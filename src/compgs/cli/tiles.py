"""`compgs tiles`: a capture in tiles, each a run of its own, and the scene that they make together."""

import json
from contextlib import ExitStack
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from tyro.conf import arg

from compgs.cli.command import NO_DEFAULT, ReadingOptions, check_measures
from compgs.cli.console import say
from compgs.cli.ending import say_next
from compgs.cli.of_a_tile import settings_of_tile
from compgs.cli.plan import planned, say_lines
from compgs.cli.progress import counting_runs
from compgs.cli.ranks import several
from compgs.cli.run_folder import (
    TRAINING_NAME,
    RunSettings,
    forget_results,
    manifest_of,
    save_settings,
)
from compgs.cli.settings import with_settings
from compgs.cli.training_command import NEEDED_BYTES, TrainingCommand
from compgs.cli.usage import UsageError, settings_of_options
from compgs.errors import ConfigError
from compgs.extras import require
from compgs.methods import settings_of
from compgs.occupied import occupied
from compgs.outputs import check_output_folder, write_json
from compgs.words import size

if TYPE_CHECKING:
    from compgs.scene import Scene
    from compgs.tiles import Plan, TileJob

METHOD = "compgs"  # whose files tiles are
MOST_PROCESSORS = 600.0  # of --cpus and --gpus: no machine has more


@dataclass(frozen=True, kw_only=True)
class Tiles(TrainingCommand):
    """Train a capture larger than memory: divide it on the ground, train tile by tile, evaluate all together.

    The run's folder then holds RUN.tiles, a folder with a .cgs file for each tile, which every other command takes in
    the place of a file; plan.json, how the capture was divided; and the runs of the tiles in blocks/.

    Examples

    compgs tiles scenes/city -o runs/city --grid 4x3

    compgs tiles scenes/city --plan

    compgs tiles -o runs/city --resume

    compgs tiles scenes/city -o runs/city --grid 8x6 --cluster ADDRESS --gpus 1

    compgs tiles --tile runs/city/plan.json#0_0 -o block
    """

    grid: Annotated[str | None, arg(metavar="auto|NxM", help_behavior_hint="(default: auto)")] = None
    """N tiles along the capture and M across; auto: one for every 250 000 points or 400 views."""

    tile: Annotated[str | None, arg(metavar="PLAN#NAME", help_behavior_hint=NO_DEFAULT)] = None
    """Train one tile of the plan.json in a run's folder, as a batch system would; the run does this for each."""

    cluster: Annotated[str | None, arg(metavar="ADDRESS|local", help_behavior_hint=NO_DEFAULT)] = None
    """Train tiles on a Ray cluster, or several at once on this machine (`local`). Needs the extra `cluster`."""

    cpus: Annotated[float, arg(metavar="N")] = 1.0
    """CPU cores that a tile takes on a cluster."""

    gpus: Annotated[float, arg(metavar="N")] = 0.0
    """GPUs that a tile takes on a cluster."""

    def run_in(self, folder: Path, to_the_end: ExitStack) -> None:
        """Train all tiles, or the one that is asked for, in the run's folder."""
        if self.tile is not None:
            super().run_in(folder, to_the_end)
            return
        if several():
            raise UsageError("torchrun's processes share one training, and tiles are several; use --cluster")
        check_output_folder(folder, overwrite=self.overwrite or self.resume, needed_bytes=NEEDED_BYTES)
        to_the_end.enter_context(occupied(folder))
        self.train_tiles(folder, self.settings(folder))

    @property
    def is_of_a_tile(self) -> bool:
        """Whether it is asked for one tile of a run that has begun."""
        return self.tile is not None

    def settings_of_new(self) -> RunSettings:
        """Return the command line's settings. Raises UsageError, CheckpointError."""
        from compgs.formats.tiled_ground import parse_grid

        self.check_processors()
        if self.tile is not None:
            self.check_alone()
            return settings_of_tile(self.tile)
        grid, preset = self.grid or "auto", self.preset or "default"
        with settings_of_options():
            parse_grid(grid)
            start = settings_of(METHOD, preset)
        source = self.scene_source(holdout=self.eval)
        return RunSettings(preset, source, with_settings(start, self.assignments()), METHOD, tiles=grid)

    def settings_of_begun(self, folder: Path) -> RunSettings:
        """Return the settings of a run to continue, which must be those that are given. Raises UsageError,
        CheckpointError.
        """
        self.check_processors()
        begun = super().settings_of_begun(folder)
        if begun.tiles is None:
            raise UsageError(
                f"--resume: {folder} is one training; continue it with compgs train -o {folder} --resume"
            )
        if self.grid not in (None, "auto", begun.tiles):
            raise UsageError(f"--grid {self.grid}: the run to continue began with {begun.tiles}")
        return begun

    def check_alone(self) -> None:
        """Raises UsageError for options beside --tile that the plan has."""
        reading = any(getattr(self, f.name) != f.default for f in fields(ReadingOptions))
        others = (self.scene, self.source, self.grid, self.preset)
        if reading or self.assignments() or any(each is not None for each in others):
            raise UsageError(
                "--tile takes the scene and settings from PLAN; remove SCENE, --grid, --preset and other settings"
            )
        if self.cluster is not None:
            raise UsageError("--cluster: one tile is trained on one machine; leave --tile out")

    def check_processors(self) -> None:
        """Raises UsageError for what no machine has."""
        if not (0 < self.cpus <= MOST_PROCESSORS and 0 <= self.gpus <= MOST_PROCESSORS):
            raise UsageError(
                f"--cpus {self.cpus:g} --gpus {self.gpus:g}: expected cores above 0, no negative GPUs"
            )

    def train_tiles(self, folder: Path, settings: RunSettings) -> None:
        """Plan, train what has not been trained, merge, evaluate. Raises as all of that does."""
        from compgs.suites.cluster import Needs
        from compgs.tiles import forget, merge, run_tiles, tile_jobs

        if self.cluster is not None:
            require("cluster", "--cluster")
        self.prepare_training("decode", "render")
        check_measures(lpips=self.lpips_weights or self.lpips, flip=self.flip)
        path = Path(settings.scene.path).absolute()  # machines of a cluster start elsewhere
        settings = replace(settings, scene=replace(settings.scene, path=str(path)))
        scene, settings = self.read(settings)
        self.check_held_out(scene, settings)
        plan, settings = self.planned_tiles(settings, scene, folder)
        jobs = tile_jobs(plan, folder, _what_counts(settings), self.options_of_tiles())
        if not self.resume:
            forget_results(folder)
            forget(jobs)
        say_plan(plan)
        try:
            with counting_runs("tiles") as progress:
                run_tiles(jobs, cluster=self.cluster, needs=Needs(self.cpus, self.gpus), progress=progress)
        except KeyboardInterrupt as stop:
            raise type(stop)(f"interrupted\ncontinue with: compgs tiles -o {folder} --resume") from None
        manifest = merge(plan, jobs, manifest_of(folder).parent)
        write_json(folder / TRAINING_NAME, _training(jobs))
        whole = sum(file.stat().st_size for file in manifest.parent.iterdir())
        say(f"{manifest.parent}: {len(jobs)} tiles, {size(whole)}")
        self.evaluate(scene, manifest, folder, settings)
        say_next(manifest.parent, Path(settings.scene.path))

    def planned_tiles(
        self, settings: RunSettings, scene: "Scene", folder: Path
    ) -> "tuple[Plan, RunSettings]":
        """The run's plan, made and written unless there is one to continue with; and the settings with its grid."""
        from compgs.formats.tiled_ground import parse_grid
        from compgs.tiles.plan import PLAN_NAME, grid_for, plan_tiles, read_plan, write_plan

        assert settings.tiles is not None
        if self.resume and (folder / PLAN_NAME).is_file():
            return read_plan(folder / PLAN_NAME), settings
        try:
            columns, rows = parse_grid(settings.tiles) or grid_for(scene)
            plan = plan_tiles(scene, columns, rows)
        except ConfigError as error:
            raise UsageError(f"--{error}") from error
        settings = planned(replace(settings, tiles=plan.grid), scene, self.device, columns * rows)
        assert settings.plan is not None
        say_lines(settings.plan)
        save_settings(folder, settings)
        write_plan(folder, plan)
        return plan, settings

    def options_of_tiles(self) -> list[str]:
        """Options of a tile's training that say where and how fast."""
        threads = self.threads
        if threads is None and self.cluster is not None:
            threads = max(1, int(self.cpus))  # several share a machine
        options = [] if threads is None else ["--threads", str(threads)]
        return options if self.device is None else [*options, "--device", self.device]


def _what_counts(settings: RunSettings) -> dict[str, Any]:
    """Return what tiles depend on among a run's settings: not where the scene lies now."""
    ordinary = {"split": "auto"}  # runs from before there was another have none
    reading = {
        name: value
        for name, value in asdict(settings.scene).items()
        if name != "path" and ordinary.get(name) != value
    }
    return {
        "preset": settings.preset,
        "scene": reading,
        "config": settings.config.to_dict(),
        "plan": settings.plan,
    }


def say_plan(plan: "Plan") -> None:
    """What is trained."""
    points, views = ([f(tile) for tile in plan.tiles] for f in (lambda t: t.points, lambda t: len(t.views)))
    say(
        f"{plan.grid} tiles of {min(points):,} to {max(points):,} points in their cores and {min(views)} to "
        f"{max(views)} views"
    )


def _training(jobs: "list[TileJob]") -> dict[str, Any]:
    """training.json of all tiles together."""
    tiles = {}
    for job in jobs:
        path = job.folder / TRAINING_NAME
        facts = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}
        tiles[job.scene] = {name: value for name, value in facts.items() if name != "curve"}
    summed = ("steps", "anchors", "seconds")
    sums = {name: sum(tile.get(name, 0) for tile in tiles.values()) for name in summed}
    return {"method": METHOD, **sums, "tiles": tiles}
