"""The folder of a compression: `compress.json` says how it began, so that it can go on."""

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from compgs import __version__
from compgs.cameras import Camera
from compgs.compressing.placing import UP, Placed
from compgs.config import Config, config_from_dict
from compgs.errors import CheckpointError, CompGSError, ConfigError
from compgs.evaluation.camera_path import camera_entry, camera_from_entry
from compgs.outputs import write_json

SETTINGS_NAME = "compress.json"
SCHEMA = "compgs compress 1"
MOST_VIEWS = 100_000
LEAST_SIDE, MOST_SIDE = 16, 4096  # pixels


@dataclass(frozen=True)
class Looking:
    """Says from where, and how, the input is looked at."""

    views: int = 200  # to train with
    held_out: int = 24  # others, to judge by
    width: int = 480  # pixels; of given cameras, the longer side
    height: int = 360  # pixels
    up: tuple[float, float, float] = UP  # direction of the sky
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)  # RGB, 0 to 1; files of splats have none
    cameras: str | None = None  # file or folder of cameras to look through; None: they are placed
    level: int | None = None  # of a streamed .sog (lod-meta.json); None: 0, the finest

    def check(self) -> None:
        """Raises ConfigError for what nothing could be looked at with."""
        for name, least, most in (
            ("views", 2, MOST_VIEWS),
            ("held_out", 1, MOST_VIEWS),
            ("width", LEAST_SIDE, MOST_SIDE),
            ("height", LEAST_SIDE, MOST_SIDE),
        ):
            if not least <= getattr(self, name) <= most:
                raise ConfigError(f"{name} = {getattr(self, name)}: expected {least} to {most}")
        if not (len(self.up) == 3 and np.isfinite(self.up).all() and np.any(self.up)):
            raise ConfigError(f"up = {self.up}: expected a direction, three numbers that are not all zero")
        if not (len(self.background) == 3 and all(0 <= c <= 1 for c in self.background)):
            raise ConfigError(f"background = {self.background}: expected three numbers from 0 to 1")

    def fitted(self, camera: Camera) -> Camera:
        """The same view, its longer side as long as that of the pictures wanted."""
        scale = max(self.width, self.height) / max(camera.width, camera.height)
        return camera.resized(*(max(1, round(side * scale)) for side in (camera.width, camera.height)))


@dataclass(frozen=True, eq=False)
class Begun:
    """A compression that has begun: what it goes on with."""

    source: Path
    sha256: str  # of the source
    looking: Looking
    placed: Placed
    config: Config


def folder_of(output: Path) -> Path:
    """Where a file's compression keeps its checkpoint, results and pictures: `garden.run` of `garden.cgs`."""
    return output.with_suffix(".run")


def save(folder: Path, begun: Begun) -> None:
    """Raises OutputError."""
    write_json(
        folder / SETTINGS_NAME,
        {
            "schema": SCHEMA,
            "compgs": __version__,
            "source": str(begun.source.absolute()),
            "sha256": begun.sha256,
            "looking": asdict(begun.looking),
            "train": [camera_entry(camera, f"train {i}") for i, camera in enumerate(begun.placed.train)],
            "held_out": [
                camera_entry(camera, f"held out {i}") for i, camera in enumerate(begun.placed.held_out)
            ],
            "settings": begun.config.to_dict(),
        },
    )


def load(folder: Path) -> Begun:
    """Raises CheckpointError if there is no compression to go on with."""
    path = folder / SETTINGS_NAME
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        if content["schema"] != SCHEMA:
            raise ValueError(f"schema {content['schema']!r}, expected {SCHEMA!r}")
        looking: dict[str, Any] = {
            k: tuple(v) if isinstance(v, list) else v for k, v in content["looking"].items()
        }
        return Begun(
            Path(content["source"]),
            str(content["sha256"]),
            Looking(**looking),
            Placed(_cameras(content["train"], path), _cameras(content["held_out"], path)),
            config_from_dict(content["settings"], str(path)),
        )
    except FileNotFoundError as error:
        raise CheckpointError(f"{path}: not found; there is no compression to go on with") from error
    except OSError as error:
        raise CheckpointError(f"{path}: cannot be read ({error.strerror})") from error
    except (CompGSError, ValueError, TypeError, KeyError, AttributeError) as error:
        raise CheckpointError(f"{path}: not what compress wrote ({error}); compress anew") from error


def _cameras(entries: list[Any], path: Path) -> tuple[Camera, ...]:
    return tuple(camera_from_entry(entry, f"{path}: camera {i}")[1] for i, entry in enumerate(entries))
