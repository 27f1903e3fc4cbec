"""What a training decides, for people: said before the first step, and by `compgs train --plan`, which stops there."""

from dataclasses import replace
from typing import TYPE_CHECKING, Any

from compgs.cli.console import say, warn
from compgs.cli.run_folder import SETTINGS_NAME, RunSettings
from compgs.errors import CheckpointError
from compgs.words import duration, size

if TYPE_CHECKING:
    from compgs.scene import Scene
    from compgs.training import Plan

PLANNED = "compgs"  # the method whose trainings have a plan
LONG = 7200  # seconds from which on a run is told how to be shorter


def planned(settings: RunSettings, scene: "Scene", device: str | None, tiles: int = 1) -> RunSettings:
    """The settings with the plan of a run on the scene, unless they have one. Raises ConfigError."""
    if settings.method != PLANNED or settings.plan is not None:
        return settings
    from compgs.training import plan_for
    from compgs.training.run.run import chosen_device

    if settings.tiles is not None and tiles == 1:
        tiles = tiles_of(settings.tiles, scene)
    plan = plan_for(scene, settings.config, chosen_device(device), tiles)
    return replace(settings, plan=plan.to_dict())


def with_time(settings: RunSettings, scene: "Scene", seconds: float, device: str | None) -> RunSettings:
    """The settings with as many steps as a training of about `seconds` takes: some are tried, and thrown away."""
    from compgs.compressing.pace import steps_within

    fitting = steps_within(scene, settings.config, seconds, device)
    say(f"steps: {fitting.steps:,} fit into {duration(seconds)} at the pace of the first ones")
    if fitting.late:
        warn(f"the fewest that show anything take {duration(fitting.late)} longer than that")
    config = settings.config
    return replace(settings, config=replace(config, training=replace(config.training, steps=fitting.steps)))


def tiles_of(grid: str, scene: "Scene") -> int:
    """How many tiles a capture is divided into."""
    from compgs.formats.tiled_ground import parse_grid
    from compgs.tiles.plan import grid_for

    columns, rows = parse_grid(grid) or grid_for(scene)
    return columns * rows


def plan_in(settings: RunSettings) -> "Plan | None":
    """The plan that the settings of a run hold. Raises CheckpointError for what is none."""
    if settings.plan is None:
        return None
    from compgs.training import Plan

    try:
        return Plan.from_dict(settings.plan)
    except ValueError as error:
        raise CheckpointError(f"{SETTINGS_NAME}: {error}; train anew") from error


def say_lines(plan: dict[str, Any]) -> None:
    """The plan for people."""
    from compgs.training import Plan

    for line in Plan.from_dict(plan).in_words():
        say(line)


def say_expected(plan: "Plan", scene: "Scene", settings: RunSettings, device: str | None) -> None:
    """How long the run takes, and how large its file becomes, as far as that is known before it."""
    from compgs.compressing.pace import seconds_per_step
    from compgs.training.plan import expected_bytes

    steps, asked = settings.config.training.steps, settings.config.training.target_bytes
    if settings.tiles is not None:
        say("time: not known for a capture in tiles")
    else:
        pace = seconds_per_step(scene, settings.config, device, plan)
        shorter = "; --time 1h takes as many as fit into an hour" if pace * steps > LONG else ""
        say(
            f"time: about {duration(pace * steps)}, {steps:,} steps at the pace of the first ones, "
            f"{pace:.3f} s each{shorter}"
        )
    bytes_ = expected_bytes(plan.start)
    if asked is not None:
        say(f"file: {size(asked)}, as asked for")
    elif scene.guessed:
        say("file: size not known: points are found only as the run begins")
    elif bytes_ is None or settings.tiles is not None:
        say("file: size not known: no scene of about so many anchors has been measured")
    else:
        say(f"file: about {size(round(bytes_))}, measured scenes were within a factor of 2, at worst 3.5")
