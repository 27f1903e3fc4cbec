"""Cameras that somebody has already: of the capture that the splats were made from, or of a file of cameras.

Photographs need not be there: where their size is not written down, the focal length must be an angle.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np

from compgs.cameras import Camera
from compgs.errors import SceneError, UnsupportedCamera
from compgs.evaluation.camera_path import camera_from_entry
from compgs.numerics.rotations import rigid
from compgs.scene.blender import read_blender
from compgs.scene.capture import Capture, check_camera
from compgs.scene.colmap import find_sparse_model
from compgs.scene.colmap_capture import read_colmap
from compgs.scene.nerfstudio import read_nerfstudio

LAYOUTS = {"transforms.json": read_nerfstudio, "transforms_train.json": read_blender}
LONGEST_LENS = 16.0  # widths of the picture: a focal length in pixels, and a size that nobody knows, are more
EXPECTED = (
    "expected the folder of a COLMAP model (sparse/0), transforms.json, transforms_train.json, or a list of cameras as "
    "3DGS (cameras.json) and compgs write them"
)


def given_cameras(path: str | Path) -> list[Camera]:
    """Of a folder or a file, in the order of their names; lens distortion is left out.

    Raises SceneError, UnsupportedCamera for what holds no cameras, or fewer than two.
    """
    place = Path(path)
    if place.is_dir():
        cameras = _named(_of_folder(place))
    elif place.name in LAYOUTS and place.is_file():
        cameras = _named(LAYOUTS[place.name](place.parent))
    else:
        cameras = _of_list(place)
    if len(cameras) < 2:
        raise SceneError(f"{place}: holds {len(cameras)} camera; at least two are needed, one to judge by")
    for name, camera in cameras:
        check_camera(camera, f"{place}: {name}")
        if camera.width == 1 and camera.fx > LONGEST_LENS:
            raise UnsupportedCamera(
                f"{place}: {name}: a focal length in pixels, but not the size of the picture; add w and h"
            )
    return [camera for _, camera in sorted(cameras, key=lambda named: named[0])]


def _of_folder(folder: Path) -> Capture:
    sparse = find_sparse_model(folder)
    if sparse is not None:
        return read_colmap(folder, sparse, folder / "images")
    for name, read in LAYOUTS.items():
        if (folder / name).is_file():
            return read(folder)
    raise SceneError(f"{folder}: no cameras found; {EXPECTED}")


def _named(capture: Capture) -> list[tuple[str, Camera]]:
    return [(posed.name, posed.camera) for posed in capture.images]


def _of_list(file: Path) -> list[tuple[str, Camera]]:
    try:
        entries = json.loads(file.read_text(encoding="utf-8"))
    except OSError as error:
        raise SceneError(f"{file}: cannot be read ({error.strerror})") from error
    except (ValueError, RecursionError) as error:
        raise SceneError(f"{file}: not a file of cameras ({error}); {EXPECTED}") from error
    if not isinstance(entries, list) or not entries:
        raise SceneError(f"{file}: not a list of cameras; {EXPECTED}")
    return [_camera(entry, f"{file}: camera {i}") for i, entry in enumerate(entries)]


def _camera(entry: Any, place: str) -> tuple[str, Camera]:
    """As 3DGS writes it (`position`, and `rotation` from camera to world), else as compgs does."""
    if not isinstance(entry, dict) or "position" not in entry:
        return camera_from_entry(entry, place)
    try:
        position = np.array(entry["position"], dtype=np.float64).reshape(3)
        rotation = np.array(entry["rotation"], dtype=np.float64).reshape(3, 3).T
        fx, fy, width, height = (float(entry[key]) for key in ("fx", "fy", "width", "height"))
    except (KeyError, TypeError, ValueError) as error:
        raise UnsupportedCamera(
            f"{place}: expected position, rotation, fx, fy, width and height ({error})"
        ) from error
    pose = rigid(rotation, -rotation @ position)
    return camera_from_entry(
        {
            "name": str(entry.get("img_name", place)),
            "world_to_camera": pose.tolist(),
            **{"fx": fx, "fy": fy, "cx": width / 2, "cy": height / 2, "width": width, "height": height},
        },
        place,
    )
