"""Methods by their names: settings, training, writing; what is asked for is checked before anything is computed."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from compgs.config import PRESETS, Config, check_config, config_from_dict, load_config
from compgs.errors import ConfigError
from compgs.extras import require
from compgs.methods.method import Method
from compgs.methods.registry import METHODS
from compgs.notes import note
from compgs.occupied import occupied_if_given
from compgs.paths import as_path
from compgs.progress import shown_training

if TYPE_CHECKING:
    from compgs.devices import Device
    from compgs.model.splats import SplatModel
    from compgs.scene.views import Scene
    from compgs.training.plan import Plan
    from compgs.training.run.any_trainer import Watch
    from compgs.training.run.profile import StepProfile
    from compgs.training.run.status import TrainingStatus


def method_of(name: str) -> Method:
    """Raises ConfigError for a name that no method has."""
    if name not in METHODS:
        raise ConfigError(f"method {name!r} does not exist; there are {', '.join(METHODS)}")
    return METHODS[name]


def settings_of(method: str, preset: str = "default") -> Config:
    """Settings of a method, with a section of its own if it has one. Raises ConfigError for an unknown name."""
    known = method_of(method)
    if preset in known.presets:
        values = {section: dict(changed) for section, changed in known.presets[preset].items()}
        return config_from_dict(values, f"preset {preset} of {method}", known.settings)
    if preset not in PRESETS and known.presets:
        names = ", ".join((*PRESETS, *known.presets))
        raise ConfigError(f"preset {preset!r} of method {method} does not exist; there are {names}")
    return load_config(preset, known.settings)


def train(
    scene: "Scene | str | Path",
    config: Config | None = None,
    *,
    method: str = "compgs",
    preset: str | None = None,
    splats: "SplatModel | str | Path | None" = None,
    output: str | Path | None = None,
    resume: bool = False,
    steps: int | None = None,
    lmbda: float | None = None,
    seed: int | None = None,
    progress: "Callable[[TrainingStatus], None] | Literal[False] | None" = None,
    device: "Device | None" = None,
    profile: "StepProfile | None" = None,
    watch: "Watch | None" = None,
    plan: "Plan | None" = None,
) -> Any:
    """Train a scene, or the one in a folder, by a method; the result can be rendered, and written by
    `compgs.methods.write` (of `compgs`, also by `compgs.encode`).

    Settings are those of `config` (`compgs.methods.settings_of`), or of a preset, `default` if there is neither;
    `steps`, `lmbda` (the weight of the rate) and `seed` go before them. A terminal and a notebook show how
    far it is (`compgs.progress`), unless `progress` is False, or a function, which gets a `TrainingStatus`. With
    `output`, a folder, checkpoints are written there, also when the run is interrupted; `resume` continues from the
    last one exactly as if the run had not stopped (`compgs train --resume` cannot: it does not know how the scene was
    read). `splats`, or a file of them, take the place of the plain 3DGS that a method begins with. `profile` gathers
    where the time goes. `watch(trainer)` is called between any two steps: `trainer.snapshot()` can be rendered. `plan`
    (`compgs.training.plan_for`) is what has been decided already, as for a tile of a capture; only the method `compgs`
    has one. Default device: CUDA where there is one.

    Raises ConfigError (without torch MissingDependency), CheckpointError, OutputError, SplatFileError, and
    TrainingError when the optimization cannot go on.
    """
    require("train", "training")
    from compgs.model.splats import SplatModel
    from compgs.scene import as_scene
    from compgs.training.run.distributed import rank
    from compgs.training.run.run import Run

    known = method_of(method)
    changes = {"steps": steps, "lmbda": lmbda, "seed": seed}
    chosen = _changed(known, _chosen_config(known, config, preset), changes)
    if splats is not None and not known.from_splats:
        raise ConfigError(f"splats: method {method} does not begin with plain 3DGS; leave them out")
    if output is not None:
        output = as_path(output, "output", "folder")
    read = as_scene(scene)
    start = (
        splats
        if splats is None or isinstance(splats, SplatModel)
        else opened_splats(as_path(splats, "splats"), read)
    )
    # Of several processes that train together, the first writes.
    with shown_training(progress) as show, occupied_if_given(None if rank() > 0 else output):
        run = Run(
            method,
            output=output,
            resume=resume,
            on_progress=show,
            device=device,
            profile=profile,
            watch=watch,
            plan=plan,
        )
        return known.train(read, chosen, run, start)


def write(model: Any, path: str | Path, *, method: str = "compgs", config: Config | None = None) -> int:
    """Write what a method trained, replacing what is at `path`; the number of bytes. `config`: of the training.

    Raises ConfigError, OutputError, NotEncodable, SplatFileError.
    """
    known = method_of(method)
    return known.write(model, Path(path), config or settings_of(method))


def opened_splats(path: str | Path, scene: "Scene") -> "SplatModel":
    """The splats of a file, to begin with. Raises SplatFileError, BitstreamError, ConfigError for another scene."""
    from compgs.model.splats import SplatModel
    from compgs.opening import open_scene

    model = open_scene(path, background=scene.background)
    if not isinstance(model, SplatModel):
        raise ConfigError(f"{path}: expected a file of splats, found another kind of scene; export it first")
    if model.antialiased:
        note(Path(path), "its splats are antialiased, training goes on without: small ones begin too bright")
        model = replace(model, splats=replace(model.splats, antialiased=False))
    return model


def _changed(method: Method, config: Config, changes: "dict[str, Any]") -> Config:
    """Replace these settings of the training, those that are not None. Raises ConfigError for what is out of range, or
    what the method has no use for.
    """
    given = {name: value for name, value in changes.items() if value is not None}
    for name in given:
        if "training" not in method.uses and f"training.{name}" not in method.uses:
            raise ConfigError(
                f"{name}: not a setting of method {method.name}, which has {', '.join(method.uses)}"
            )
    changed = replace(config, training=replace(config.training, **given))
    check_config(changed)
    return changed


def _chosen_config(method: Method, config: Config | None, preset: str | None) -> Config:
    """The given one, or a preset's; of neither, the preset `default`. Raises ConfigError for both, or a bad one."""
    if config is not None and preset is not None:
        raise ConfigError(
            f"config and preset={preset!r} were both given: give one; compgs.load_config({preset!r}) is a config"
        )
    if config is None:
        return settings_of(method.name, preset or "default")
    if not isinstance(config, method.settings):
        gives = (
            "compgs.load_config"
            if method.settings is Config
            else f"compgs.methods.settings_of({method.name!r})"
        )
        raise ConfigError(
            f"config: expected what {gives} gives, found {config!r}; a preset is given as preset='quick'"
        )
    check_config(config)
    return config
