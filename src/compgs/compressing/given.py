"""Cameras that somebody has already: of the capture that the splats were made from, or of a file of cameras."""

from pathlib import Path

from compgs.cameras import Camera
from compgs.errors import SceneError
from compgs.evaluation.camera_path import read_cameras


def given_cameras(path: str | Path) -> list[Camera]:
    """Read the cameras of a folder or a file (`read_cameras`), in the order of their names.

    Raises SceneError, UnsupportedCamera for what holds no cameras, or fewer than two.
    """
    cameras = read_cameras(Path(path))
    if len(cameras) < 2:
        raise SceneError(f"{path}: holds {len(cameras)} camera; at least two are needed, one to judge by")
    return [camera for _, camera in sorted(cameras, key=lambda named: named[0])]
