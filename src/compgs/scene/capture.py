"""What the reader of every layout hands over: where the images lie and how they were taken, no pixels yet."""

import os
from dataclasses import dataclass
from pathlib import Path, PureWindowsPath

import numpy as np

from compgs.cameras import Camera
from compgs.errors import SceneError, UnsupportedCamera
from compgs.scene.undistort import Distortion
from compgs.scene.views import Points

MAX_DISTANCE = 1e9  # world units from the origin: the Earth's radius in centimetres is less
MAX_COORDINATE = 1e30  # world units, of a point: beyond it distances overflow single precision


@dataclass(frozen=True, eq=False)
class PosedImage:
    """An image on disk with its camera, at the size that the camera was calibrated for."""

    name: str
    path: Path
    camera: Camera
    distortion: Distortion | None = None  # None: the image is a pinhole image already
    mask: Path | None = None  # file that says which pixels count (`scene/masks.py`); None: all
    turned: bool = False  # the camera is of the image as its orientation tag turns it, not as it is stored


@dataclass(frozen=True, eq=False)
class Capture:
    """A scene of which no pixel has been read yet."""

    images: tuple[PosedImage, ...]
    test_names: frozenset[str] | None  # names of the held-out views; None: the layout does not say
    points: Points
    points_source: str  # the file of the points, for messages
    background: tuple[float, float, float]  # what the layout's images stand on by default
    cut_out: bool = True  # transparent pixels do not count; False: they show the background
    notes: tuple[str, ...] = ()
    files: tuple[Path, ...] = ()  # that were read, beside images and masks
    split: str = ""  # what names the held-out views; empty: nothing
    # Mean distance from where points are seen to where they should be, pixels of the cameras; None: not known.
    reprojection_error: float | None = None


def usable_positions(positions: np.ndarray) -> np.ndarray:  # positions: [P, 3] float64
    """[P] bool: points that have a place, finite also in single precision."""
    return (np.abs(positions) < MAX_COORDINATE).all(axis=1)  # False where not a number


def check_inside(path: Path, folders: tuple[Path, ...], what: str) -> None:
    """Raises SceneError for a path that leads out of the folders: of a scene from elsewhere, nothing else is read.

    Links are followed, as somebody put them there; `..` in names of a scene's files is not. The first folder is the
    scene's; `what` lies there.
    """
    place = Path(os.path.normpath(path.absolute()))
    of_windows = any(PureWindowsPath(path.relative_to(f)).drive for f in folders if path.is_relative_to(f))
    if of_windows or not any(place.is_relative_to(os.path.normpath(folder.absolute())) for folder in folders):
        raise SceneError(
            f"{folders[0]}: {what} lies outside of the scene's folder; move it there, and name it relative to that"
        )


def check_camera(camera: Camera, place: str) -> None:
    """Raises UnsupportedCamera where intrinsics or pose cannot be used; `place` names file and view."""
    intrinsics = (camera.fx, camera.fy, camera.cx, camera.cy)
    if camera.width < 1 or camera.height < 1 or max(camera.width, camera.height) > 1 << 20:
        raise UnsupportedCamera(
            f"{place}: an image size of {camera.width}x{camera.height} pixels makes no sense"
        )
    if not np.isfinite(intrinsics).all() or camera.fx <= 0 or camera.fy <= 0:
        raise UnsupportedCamera(
            f"{place}: focal lengths must be above 0 and finite, found fx {camera.fx}, fy {camera.fy}, "
            f"cx {camera.cx}, cy {camera.cy}; calibrate again"
        )
    if not np.isfinite(camera.world_to_camera).all():
        raise UnsupportedCamera(
            f"{place}: the pose is not finite; remove the image from the model or register it again"
        )
    if np.abs(camera.world_to_camera[:3, 3]).max() > MAX_DISTANCE:
        raise UnsupportedCamera(
            f"{place}: the camera is more than {MAX_DISTANCE:g} world units from the origin; remove the image "
            f"from the model or register it again"
        )
