"""What the layouts with poses in JSON share: reading the file, and poses in the axes of OpenGL."""

from pathlib import Path
from typing import Any

import numpy as np

from compgs.errors import SceneError, UnsupportedCamera
from compgs.numerics.rotations import nearest_rotation, rigid
from compgs.scene.names import as_name
from compgs.scene.text_files import read_json


def read_transforms(file: Path) -> dict[str, Any]:
    """The JSON object of the file, which has a list of `frames`. Raises SceneError."""
    values = read_json(file)
    frames = values.get("frames") if isinstance(values, dict) else None
    if not isinstance(frames, list) or not all(isinstance(frame, dict) for frame in frames):
        raise SceneError(f"{file}: expected an object with a list of frames; export it again")
    return values


def number(values: dict[str, Any], key: str, place: str) -> float:
    """A finite number. Raises SceneError where it is missing or something else."""
    value = values.get(key)
    if isinstance(value, bool) or not isinstance(value, int | float) or not np.isfinite(value):
        raise SceneError(
            f"{place}: {key} is {'missing' if value is None else repr(value)}; expected a finite number"
        )
    return float(value)


def file_path(frame: dict[str, Any], place: str, key: str = "file_path") -> str:
    """Path of a frame's image (or what `key` names), relative to the JSON file, "/" between its parts."""
    value = frame.get(key)
    if not isinstance(value, str) or not value:
        raise SceneError(f"{place}: {key} is {value!r}; expected the path of the frame's image")
    return as_name(value)


def world_to_camera(frame: dict[str, Any], place: str) -> np.ndarray:
    """[4, 4] from the frame's `transform_matrix`: camera to world, x right, y up, z backward (OpenGL)."""
    try:
        matrix = np.array(frame.get("transform_matrix"), dtype=np.float64)
    except (TypeError, ValueError):
        matrix = np.zeros(0)
    if matrix.shape not in ((4, 4), (3, 4)) or not np.isfinite(matrix).all():
        raise UnsupportedCamera(
            f"{place}: expected a transform_matrix of 4 x 4 finite numbers; export it again"
        )
    axes = matrix[:3, :3] @ np.diag([1.0, -1.0, -1.0])  # now x right, y down, z forward
    stretch = np.linalg.norm(axes, axis=0)
    if np.linalg.det(axes) <= 0 or stretch.max() > 1.01 * stretch.min() or _skew(axes / stretch) > 0.01:
        raise UnsupportedCamera(
            f"{place}: the transform_matrix is not a rotation and a position: it mirrors, stretches or shears"
            f"; export it again"
        )
    rotation = nearest_rotation(axes).T
    return rigid(rotation, -rotation @ matrix[:3, 3])


def _skew(axes: np.ndarray) -> float:
    return float(np.abs(axes.T @ axes - np.eye(3)).max())
