"""The layout of nerfstudio and instant-ngp: one `transforms.json`, intrinsics for all frames or for each."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from compgs.cameras import Camera
from compgs.errors import SceneError, UnsupportedCamera
from compgs.scene.capture import Capture, PosedImage, check_camera, check_inside
from compgs.scene.images import image_size
from compgs.scene.ply_points import read_ply_points
from compgs.scene.split_names import split_by_names
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
        check_inside(
            folder / relative, (folder,), f"the image of frame {index} in {file.name}, {relative!r},"
        )
        image = _posed_image(relative, folder / relative, {**shared, **frame}, place)
        posed.append(replace(image, mask=_mask(folder, frame, place)))
    if not posed:
        raise SceneError(f"{file}: no frames; expected at least two views")
    points, of_points = _points(folder, values)
    used, held_out, of_split = split_by_names(posed, values, str(file))
    return Capture(used, held_out, points, str(file), (0.0, 0.0, 0.0), notes=(*of_points, *of_split))


def _mask(folder: Path, frame: dict[str, Any], place: str) -> Path | None:
    """The file that a frame names. Raises SceneError if it is not there."""
    if frame.get("mask_path") is None:
        return None
    relative = file_path(frame, place, "mask_path")
    check_inside(folder / relative, (folder,), f"mask_path {relative!r}")
    if not (folder / relative).is_file():
        raise SceneError(
            f"{place}: mask_path: {folder / relative} does not exist; restore it, or leave mask_path out"
        )
    return folder / relative


def _points(folder: Path, values: dict[str, Any]) -> tuple[Points, tuple[str, ...]]:
    """Of `ply_file_path`, else none, and what is to be noted."""
    nothing = Points(np.zeros((0, 3)), np.zeros((0, 3), dtype=np.uint8))
    ply = values.get("ply_file_path")
    if ply is None:
        return nothing, ()
    if not isinstance(ply, str):
        raise SceneError(f"{folder / 'transforms.json'}: ply_file_path is {ply!r:.60}; expected a path")
    check_inside(folder / ply, (folder,), f"ply_file_path {ply!r}")
    if not (folder / ply).is_file():
        return nothing, (f"ply_file_path: {folder / ply} does not exist: the points in it are not used",)
    return read_ply_points(folder / ply), ()


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
