"""The layout of nerfstudio and instant-ngp: one `transforms.json`, intrinsics for all frames or for each."""

from pathlib import Path
from typing import Any

import numpy as np

from compgs.cameras import Camera
from compgs.errors import SceneError, UnsupportedCamera
from compgs.scene.capture import Capture, PosedImage, check_camera, check_inside
from compgs.scene.images import image_size
from compgs.scene.ply_points import read_ply_points
from compgs.scene.transforms import file_path, number, read_transforms, world_to_camera
from compgs.scene.undistort import Distortion
from compgs.scene.views import Points

_FISHEYE = ("OPENCV_FISHEYE", "FISHEYE", "EQUIDISTANT")
_PERSPECTIVE = (
    "OPENCV",
    "PINHOLE",
    "SIMPLE_PINHOLE",
    "PERSPECTIVE",
    "SIMPLE_RADIAL",
    "RADIAL",
    "FULL_OPENCV",
)


def read_nerfstudio(folder: Path) -> Capture:
    """The capture of `folder/transforms.json`; a frame's own values go before the file's."""
    file = folder / "transforms.json"
    values = read_transforms(file)
    shared = {key: value for key, value in values.items() if key != "frames"}
    posed = []
    for index, frame in enumerate(values["frames"]):
        place = f"{file}, frame {index}"
        relative = file_path(frame, place)
        posed.append(_posed_image(relative, folder / relative, {**shared, **frame}, place))
    if not posed:
        raise SceneError(f"{file}: no frames; expected at least two views")
    return Capture(tuple(posed), None, _points(folder, values), str(file), (0.0, 0.0, 0.0))


def _points(folder: Path, values: dict[str, Any]) -> Points:
    ply = values.get("ply_file_path")
    if isinstance(ply, str) and (folder / ply).is_file():
        check_inside(folder / ply, (folder,), f"ply_file_path {ply!r}")
        return read_ply_points(folder / ply)
    return Points(np.zeros((0, 3)), np.zeros((0, 3), dtype=np.uint8))


def _posed_image(name: str, path: Path, values: dict[str, Any], place: str) -> PosedImage:
    if "w" in values and "h" in values:
        width, height = int(number(values, "w", place)), int(number(values, "h", place))
    else:
        width, height = image_size(path) if path.is_file() else (1, 1)  # a missing image is reported later
    if "fl_x" in values:
        fx = number(values, "fl_x", place)
    elif "camera_angle_x" in values:
        fx = 0.5 * width / np.tan(0.5 * number(values, "camera_angle_x", place))
    else:
        raise SceneError(f"{place}: neither fl_x nor camera_angle_x is given; export the focal length too")
    fy = number(values, "fl_y", place) if "fl_y" in values else fx
    cx = number(values, "cx", place) if "cx" in values else width / 2
    cy = number(values, "cy", place) if "cy" in values else height / 2
    camera = Camera(world_to_camera(values, place), fx, fy, cx, cy, width, height)
    check_camera(camera, place)
    return PosedImage(name, path, camera, _lens(values, place))


def _lens(values: dict[str, Any], place: str) -> Distortion | None:
    model = values.get("camera_model", "OPENCV_FISHEYE" if values.get("is_fisheye") else "OPENCV")
    k1, k2, p1, p2, k3, k4 = (
        number(values, key, place) if key in values else 0.0 for key in ("k1", "k2", "p1", "p2", "k3", "k4")
    )
    if model in _FISHEYE:
        return Distortion("OPENCV_FISHEYE", (k1, k2, k3, k4))
    if model not in _PERSPECTIVE:
        raise UnsupportedCamera(
            f"{place}: the camera model {model!r} is not supported; export undistorted images (PINHOLE)"
        )
    lens = Distortion("FULL_OPENCV", (k1, k2, p1, p2, k3, k4, 0.0, 0.0))
    return None if lens.is_identity else lens
