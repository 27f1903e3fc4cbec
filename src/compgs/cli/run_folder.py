"""A run's folder: what `compgs train` leaves there, and `config.json`, which says how it came about."""

import json
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from compgs import __version__
from compgs.cli.methods import METHODS
from compgs.config import Config, config_from_dict
from compgs.errors import CheckpointError
from compgs.outputs import write_json

SETTINGS_NAME = "config.json"
CHECKPOINT_NAME = "checkpoint.safetensors"
TRAINING_NAME = "training.json"


@dataclass(frozen=True)
class SceneSource:
    """Which scene a run was trained on, and how it was read: the arguments of `load_scene`."""

    path: str
    downscale: int
    images: str
    test_every: int
    holdout: bool
    background: tuple[float, float, float] | None  # RGB, 0 to 1


@dataclass(frozen=True)
class RunSettings:
    """The content of `config.json`."""

    preset: str
    scene: SceneSource
    config: Config
    method: str = "compgs"


def file_name(folder: Path, extension: str = ".cgs") -> str:
    """The file of a run is named after its folder."""
    return f"{folder.absolute().name}{extension}"


def save_settings(folder: Path, settings: RunSettings) -> None:
    """Raises OutputError."""
    content = {
        "compgs": __version__,
        "method": settings.method,
        "preset": settings.preset,
        "scene": asdict(settings.scene),
        "settings": settings.config.to_dict(),
    }
    write_json(folder / SETTINGS_NAME, content)


@contextmanager
def beginning(folder: Path, settings: RunSettings) -> Iterator[None]:
    """A run begins: its settings are there before its first checkpoint is. If it fails without one, nothing stays.

    A run that has a checkpoint has begun before. Raises OutputError.
    """
    if (folder / CHECKPOINT_NAME).exists():
        yield
        return
    made = [path for path in (folder, *folder.parents) if not path.exists()]
    save_settings(folder, settings)
    try:
        yield
    except BaseException:
        if not (folder / CHECKPOINT_NAME).exists():
            with suppress(OSError):
                (folder / SETTINGS_NAME).unlink()
                for path in made:
                    path.rmdir()
        raise


def load_settings(folder: Path) -> RunSettings:
    """Raises CheckpointError if the folder holds no run, or not one that can be read."""
    path = folder / SETTINGS_NAME
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        return RunSettings(
            preset=str(content["preset"]),
            scene=_scene_source(content["scene"]),
            config=config_from_dict(content["settings"], str(path)),
            method=_known_method(content.get("method", "compgs")),
        )
    except FileNotFoundError as error:
        raise CheckpointError(
            f"{path}: not found; {folder} is not a run that `compgs train` began"
        ) from error
    except OSError as error:
        raise CheckpointError(f"{path}: cannot be read ({error.strerror})") from error
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise CheckpointError(f"{path}: not the settings of a run ({error}); train anew") from error


def _known_method(name: str) -> str:
    if name not in METHODS:
        raise ValueError(f"method {name!r} is not one of {', '.join(METHODS)}")
    return name


def _scene_source(values: dict[str, Any]) -> SceneSource:
    background = values["background"]
    return SceneSource(**{**values, "background": None if background is None else tuple(background)})
