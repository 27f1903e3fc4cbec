"""A run's folder: what `compgs train` leaves there, and `config.json`, which says how it came about."""

import json
import shlex
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from compgs import __version__
from compgs.config import Config, config_from_dict
from compgs.errors import CheckpointError, OutputError
from compgs.methods import METHODS
from compgs.outputs import write_json

if TYPE_CHECKING:
    from compgs.scene.views import Scene

SETTINGS_NAME = "config.json"
CHECKPOINT_NAME = "checkpoint.safetensors"
TRAINING_NAME = "training.json"
RESULTS_NAME = "results.json"


@dataclass(frozen=True)
class SceneSource:
    """Which scene a run was trained on, and how it was read: the arguments of `load_scene`."""

    path: str
    downscale: int | str  # or auto
    images: str
    test_every: int
    holdout: bool
    background: tuple[float, float, float] | None  # RGB, 0 to 1
    split: str = "auto"  # which views are held out (`--hold-out`); older runs have none


@dataclass(frozen=True)
class RunSettings:
    """The content of `config.json`."""

    preset: str
    scene: SceneSource
    config: Config
    method: str = "compgs"
    splats: str | None = None  # file of splats that the run began with
    tiles: str | None = None  # columns x rows, of a run that trains its capture in tiles
    tile: dict[str, Any] | None = None  # of the run of one tile: what of the plan it needs (`tile_entry`)
    # What the training has decided (`training.plan.Plan.to_dict`); None before it has, and of methods without a plan.
    plan: dict[str, Any] | None = None

    def learned_poses(self, scene: "Scene") -> bool:
        """Whether the run learned the poses of the scene's training views."""
        if self.plan is not None:
            return bool(self.plan.get("poses", False))
        return self.config.training.learns_poses(in_doubt=bool(scene.poses_in_doubt))


def file_name(folder: Path, extension: str = ".cgs") -> str:
    """The file of a run is named after its folder."""
    return f"{folder.absolute().name}{extension}"


def manifest_of(folder: Path) -> Path:
    """Where a run that trains its capture in tiles describes them."""
    from compgs.formats.tiled import MANIFEST, SUFFIX

    return folder / file_name(folder, SUFFIX) / MANIFEST


def add_facts(folder: Path, facts: dict[str, Any], name: str = TRAINING_NAME) -> dict[str, Any]:
    """Add to what training.json, or another file of a run, says; returns all of it. Raises OutputError."""
    path, known = folder / name, {}
    with suppress(OSError, ValueError):  # a run that was stopped after its last step has none
        known = json.loads(path.read_text(encoding="utf-8"))
    facts = {**(known if isinstance(known, dict) else {}), **facts}
    write_json(path, facts)
    return facts


def save_settings(folder: Path, settings: RunSettings) -> None:
    """Raises OutputError."""
    content = {
        "compgs": __version__,
        "method": settings.method,
        "preset": settings.preset,
        "scene": asdict(settings.scene),
        "settings": settings.config.to_dict(),
        **({"from_splats": settings.splats} if settings.splats is not None else {}),
        **({"tiles": settings.tiles} if settings.tiles is not None else {}),
        **({"tile": settings.tile} if settings.tile is not None else {}),
        **({"plan": settings.plan} if settings.plan is not None else {}),
    }
    write_json(folder / SETTINGS_NAME, content)


class EarlierRun:
    """What is in a run's folder already. All of it stays until the new run has a checkpoint of its own."""

    def __init__(self, folder: Path, settings: RunSettings) -> None:
        self.folder = folder
        self.settings = settings  # of the new run
        self.replaced = False
        self._checkpoint = _identity(folder / CHECKPOINT_NAME)

    def look(self) -> None:
        """Give way to the new run if its first checkpoint is there. Raises OutputError."""
        if not self.replaced and _identity(self.folder / CHECKPOINT_NAME) != self._checkpoint:
            save_settings(self.folder, self.settings)
            forget_results(self.folder)
            self.replaced = True


@contextmanager
def beginning(folder: Path, settings: RunSettings, *, anew: bool = True) -> Iterator[EarlierRun | None]:
    """A run begins (`anew`) or goes on. Yields the earlier run that it takes the place of, if there is one.

    Else the run's settings are there before its first checkpoint is, and if it fails without one, nothing stays.
    Raises OutputError.
    """
    if anew and any(path.exists() for path in _made_by_runs(folder)):
        earlier = EarlierRun(folder, settings)
        try:
            yield earlier
        finally:
            earlier.look()
        return
    if (folder / CHECKPOINT_NAME).exists():
        yield None
        return
    made = [path for path in (folder, *folder.parents) if not path.exists()]
    save_settings(folder, settings)
    try:
        yield None
    except BaseException:
        if not (folder / CHECKPOINT_NAME).exists():
            with suppress(OSError):
                (folder / SETTINGS_NAME).unlink()
                for path in made:
                    path.rmdir()
        raise


def forget_results(folder: Path) -> None:
    """Remove what an earlier run made of its checkpoint: it would be taken for the new run's. Raises OutputError."""
    for path in _made_by_runs(folder)[1:]:
        try:
            path.unlink(missing_ok=True)
        except OSError as error:
            raise OutputError(f"{path}: cannot be replaced ({error.strerror})") from error


def _made_by_runs(folder: Path) -> list[Path]:
    """The checkpoint, and what is made of it in the end."""
    names = [CHECKPOINT_NAME, TRAINING_NAME, RESULTS_NAME, "per_view.json"]
    suffixes = sorted({method.suffix for method in METHODS.values()})
    files = [file_name(folder, suffix) for suffix in suffixes]
    return [*(folder / name for name in names + files), manifest_of(folder)]


def _identity(path: Path) -> tuple[int, int] | None:
    """Identify a file's present content; None if there is no file. Files here are replaced, never changed."""
    try:
        found = path.stat()
    except FileNotFoundError:
        return None
    return found.st_ino, found.st_mtime_ns


def load_settings(folder: Path) -> RunSettings:
    """Raises CheckpointError if the folder holds no run, or not one that can be read."""
    path = folder / SETTINGS_NAME
    try:
        return run_settings(json.loads(path.read_text(encoding="utf-8")), str(path))
    except FileNotFoundError as error:
        if (folder / CHECKPOINT_NAME).is_file():
            raise CheckpointError(
                f"{path}: not found, so it is not known how the scene was read; a run that began in Python goes on "
                f"there, by compgs.train with the same scene and settings, output and resume"
            ) from error
        raise CheckpointError(
            f"{path}: not found; {folder} is not a run that `compgs train` began"
        ) from error
    except OSError as error:
        raise CheckpointError(f"{path}: cannot be read ({error.strerror})") from error
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise CheckpointError(f"{path}: not the settings of a run ({error}); train anew") from error


def run_settings(content: dict[str, Any], place: str) -> RunSettings:
    """Read what `save_settings` has written. Settings that an earlier version did not write have their defaults.

    Raises ConfigError, which names the `place`, and what a mapping of another kind raises.
    """
    method = _known_method(content.get("method", "compgs"))
    return RunSettings(
        preset=str(content["preset"]),
        scene=_scene_source(content["scene"]),
        config=config_from_dict(content["settings"], place, METHODS[method].settings),
        method=method,
        splats=content.get("from_splats"),
        tiles=_given(content, "tiles", str),
        tile=_given(content, "tile", dict),
        plan=_given(content, "plan", dict),
    )


def file_and_run(path: Path) -> tuple[Path, RunSettings | None]:
    """Return a run's file and its settings, from the run's folder or its file. Any other path stays as it is.

    Raises CheckpointError for a folder of a run that has not written its file.
    """
    folder = path if path.is_dir() else path.parent
    if not (folder / SETTINGS_NAME).is_file():
        from compgs.opening import scene_file

        return scene_file(path), None
    if not path.is_dir():
        with suppress(CheckpointError):
            settings = load_settings(folder)
            if path.name == _written_by(folder, settings).name:
                return path, settings
        return path, None
    settings = load_settings(folder)
    file = _written_by(folder, settings)
    if not file.is_file():
        command = f"compgs train -o {shlex.quote(str(folder))} --resume"
        raise CheckpointError(
            f"{folder}: the run has not written {file.name} yet; continue it with: {command}"
        )
    return file, settings


def _written_by(folder: Path, settings: RunSettings) -> Path:
    if settings.tiles is not None:
        return manifest_of(folder)
    return folder / file_name(folder, METHODS[settings.method].suffix)


def read_otherwise(begun: SceneSource, now: SceneSource) -> str:
    """Name, as options, what is read otherwise than when a run on the scene began; empty if nothing is."""
    options = {
        "downscale": "-r",
        "test_every": "--test-every",
        "split": "--hold-out",
        "background": "--background",
    }
    differing = [
        f"{option} {_as_typed(getattr(begun, name))} (now {_as_typed(getattr(now, name))})"
        for name, option in options.items()
        if getattr(begun, name) != getattr(now, name)
    ]
    return ", ".join(differing + (["--no-eval"] if now.holdout and not begun.holdout else []))


def _as_typed(value: Any) -> str:
    if value is None:
        return "not given"
    return " ".join(f"{part:g}" for part in value) if isinstance(value, tuple) else str(value)


def _given(content: dict[str, Any], name: str, kind: type) -> Any:
    """None where there is none. Raises ValueError for another type."""
    value = content.get(name)
    if value is not None and not isinstance(value, kind):
        raise ValueError(f"{name} is {value!r:.80}")
    return value


def _known_method(name: str) -> str:
    if name not in METHODS:
        raise ValueError(f"method {name!r} is not one of {', '.join(METHODS)}")
    return name


def _scene_source(values: dict[str, Any]) -> SceneSource:
    background = values["background"]
    return SceneSource(**{**values, "background": None if background is None else tuple(background)})
