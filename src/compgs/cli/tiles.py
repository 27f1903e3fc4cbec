"""`compgs train --tiles`: a capture in tiles, each a run of its own, and the scene that they make together."""

import json
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from compgs.cli.command import ReadingOptions, check_measures
from compgs.cli.console import say
from compgs.cli.ending import say_next
from compgs.cli.plan import plan_in, planned, say_lines
from compgs.cli.progress import counting_runs
from compgs.cli.ranks import several
from compgs.cli.run_folder import (
    SETTINGS_NAME,
    TRAINING_NAME,
    RunSettings,
    forget_results,
    load_settings,
    manifest_of,
    save_settings,
)
from compgs.cli.usage import UsageError, settings_of_options
from compgs.errors import CheckpointError, ConfigError
from compgs.extras import require
from compgs.outputs import write_json
from compgs.words import size

if TYPE_CHECKING:
    from compgs.cli.train import Train
    from compgs.config import Config
    from compgs.scene import Scene
    from compgs.tiles import Plan, TileJob

ALONE = "compgs"  # the method whose files tiles are
NEVER = 600.0  # of --cpus and --gpus: nobody has a machine with more


def check_options(command: "Train") -> None:
    """Raises UsageError, ConfigError for options that do not go with tiles, or with one of them only."""
    in_tiles = command.tiles is not None
    if in_tiles and command.tile is not None:
        raise UsageError("--tiles trains all tiles and --tile one of them; give one")
    if command.tiles is not None:
        from compgs.tiles.plan import parse_grid

        with settings_of_options():
            parse_grid(command.tiles)
        if command.method not in (None, ALONE):
            raise UsageError(f"--tiles: tiles are .cgs files, which --method {command.method} does not write")
    if in_tiles and several():
        raise UsageError(
            "--tiles: torchrun's processes share one training; start it without, or with --cluster"
        )
    if in_tiles or command.tile is not None:
        what = "--tiles" if in_tiles else "--tile"
        for option, given, why in (
            (
                "--target-size",
                command.target_size,
                "sizes are found for a whole file; --lmbda weighs the rate",
            ),
            ("--viewer", command.viewer, "there is no whole scene to look at before all tiles are trained"),
            ("--from-splats", command.from_splats, "tiles begin with the scene's points"),
            ("--profile", command.profile, "each tile is another process; --profile one of them alone"),
        ):
            if given:
                raise UsageError(f"{option} with {what}: {why}")
    if command.tile is not None and not command.resume:
        others = (command.scene, command.source, command.method, command.preset)
        reading = any(getattr(command, f.name) != f.default for f in fields(ReadingOptions))
        if reading or command.assignments() or any(each is not None for each in others):
            raise UsageError("--tile: scene and settings are those of the run with the plan; leave them out")
    if not (0 < command.cpus <= NEVER and 0 <= command.gpus <= NEVER):
        raise UsageError(
            f"--cpus {command.cpus:g} --gpus {command.gpus:g}: expected cores above 0, no negative GPUs"
        )
    if command.cluster is not None and not (in_tiles or command.resume):
        raise UsageError(
            "--cluster: one training runs on one machine; with --tiles each tile may have another"
        )


def settings_of_tile(place: str) -> RunSettings:
    """Return the settings of a tile of the run at `RUN/plan.json#NAME`. Raises UsageError, CheckpointError."""
    from compgs.formats.tiled import ground_entry
    from compgs.tiles.plan import read_plan

    path, mark, name = place.rpartition("#")
    if not mark:
        raise UsageError(
            f"--tile {place}: expected the plan.json of a run and a tile, as in runs/city/plan.json#0_1"
        )
    plan = read_plan(Path(path))
    with settings_of_options():
        tile = plan.tile(name)
    settings = load_settings(Path(path).parent)
    entry = {"ground": ground_entry(plan.ground), **tile.to_dict()}
    return replace(settings, tiles=None, tile=entry, config=_of_a_tile(settings, tile.spacing))


def _of_a_tile(settings: RunSettings, spacing: float) -> "Config":
    """Voxels as the tile's own points ask for: those outside are perhaps thinned out, and would ask for larger ones.
    All else that a training decides is decided once for the capture, as all tiles are drawn in one picture.
    """
    plan = plan_in(settings)
    if plan is None:
        raise CheckpointError(f"{SETTINGS_NAME}: holds no plan for the tiles; train anew")
    m = settings.config.model
    size = m.voxel_size or plan.voxel_spacings * spacing
    return replace(settings.config, model=replace(m, voxel_size=size))


def block(scene: "Scene", settings: RunSettings) -> "Scene":
    """What of a scene the run of a tile is trained on; all of it for any other run. Raises SceneError."""
    if settings.tile is None:
        return scene
    from compgs.tiles import block_scene

    part = block_scene(scene, *_ground_and_tile(settings.tile))
    say(f"{part.name}: {len(part.train_views)} of the views, {len(part.points.positions):,} of the points")
    return part


def cut(model: Any, settings: RunSettings) -> None:
    """Leave out of the run of a tile what is another tile's. Raises TrainingError."""
    if settings.tile is not None:
        from compgs.tiles import cut_to_core

        cut_to_core(model, *_ground_and_tile(settings.tile))


def _ground_and_tile(entry: dict[str, Any]) -> tuple[Any, Any]:
    """Raises CheckpointError for what is none."""
    from compgs.tiles.ground import Ground
    from compgs.tiles.plan import Tile

    try:
        return Ground.from_entry(entry["ground"]), Tile.from_dict(entry)
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise CheckpointError(
            f"{SETTINGS_NAME}: not the tile of a plan ({error!s:.200}); train anew"
        ) from error


def train_tiles(command: "Train", settings: RunSettings) -> None:
    """Plan, train what has not been trained, merge, evaluate. Raises as all of that does."""
    from compgs.tiles import forget, merge, run_tiles, tile_jobs

    folder = command.output
    assert folder is not None
    if command.cluster is not None:
        require("cluster", "--cluster")
    command.prepare_training("decode", "render")
    check_measures(lpips=command.lpips_weights or command.lpips, flip=command.flip)
    path = Path(settings.scene.path).absolute()  # machines of a cluster start elsewhere
    settings = replace(settings, scene=replace(settings.scene, path=str(path)))
    scene, settings = command.read(settings)
    command.check_held_out(scene, settings)
    plan, settings = _plan(command, settings, scene, folder)
    jobs = tile_jobs(plan, folder, _what_counts(settings), _compute(command))
    if not command.resume:
        forget_results(folder)
        forget(jobs)
    say_plan(plan)
    try:
        with counting_runs("tiles") as progress:
            run_tiles(jobs, cluster=command.cluster, needs=_needs(command), progress=progress)
    except KeyboardInterrupt as stop:
        raise type(stop)(f"interrupted\ncontinue with: compgs train -o {folder} --resume") from None
    manifest = merge(plan, jobs, manifest_of(folder).parent)
    write_json(folder / TRAINING_NAME, _training(jobs))
    whole = sum(file.stat().st_size for file in manifest.parent.iterdir())
    say(f"{manifest.parent}: {len(jobs)} tiles, {size(whole)}")
    command.evaluate(scene, manifest, folder, settings)
    say_next(manifest.parent)


def _plan(
    command: "Train", settings: RunSettings, scene: "Scene", folder: Path
) -> "tuple[Plan, RunSettings]":
    """The run's plan, made and written unless there is one to continue with; and the settings with its grid."""
    from compgs.tiles.plan import PLAN_NAME, grid_for, parse_grid, plan_tiles, read_plan, write_plan

    assert settings.tiles is not None
    if command.resume and (folder / PLAN_NAME).is_file():
        return read_plan(folder / PLAN_NAME), settings
    try:
        columns, rows = parse_grid(settings.tiles) or grid_for(scene)
        plan = plan_tiles(scene, columns, rows)
    except ConfigError as error:
        raise UsageError(f"--{error}") from error
    settings = planned(replace(settings, tiles=plan.grid), scene, command.device, columns * rows)
    assert settings.plan is not None
    say_lines(settings.plan)
    save_settings(folder, settings)
    write_plan(folder, plan)
    return plan, settings


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


def _compute(command: "Train") -> list[str]:
    """Options of a tile's training that say where and how fast."""
    threads = command.threads
    if threads is None and command.cluster is not None:
        threads = max(1, int(command.cpus))  # several share a machine
    options = [] if threads is None else ["--threads", str(threads)]
    return options if command.device is None else [*options, "--device", command.device]


def _needs(command: "Train") -> Any:
    from compgs.suites.cluster import Needs

    return Needs(command.cpus, command.gpus)


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
    return {"method": ALONE, **sums, "tiles": tiles}
