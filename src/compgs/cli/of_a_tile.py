"""The run of one tile of a capture: its settings, its part of the capture, and what of it is the tile's own."""

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from compgs.cli.console import say
from compgs.cli.plan import plan_in
from compgs.cli.run_folder import SETTINGS_NAME, RunSettings, load_settings
from compgs.cli.usage import UsageError, settings_of_options
from compgs.errors import CheckpointError

if TYPE_CHECKING:
    from compgs.config import Config
    from compgs.scene import Scene


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
    from compgs.formats.tiled_ground import Ground
    from compgs.tiles.plan import Tile

    try:
        return Ground.from_entry(entry["ground"]), Tile.from_dict(entry)
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise CheckpointError(
            f"{SETTINGS_NAME}: not the tile of a plan ({error!s:.200}); train anew"
        ) from error
