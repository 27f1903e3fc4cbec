"""A COLMAP data set: a sparse model beside a folder of images."""

from pathlib import Path

import numpy as np

from compgs.cameras import Camera
from compgs.errors import SceneError, UnsupportedCamera
from compgs.numerics.rotations import rigid, rotation_from_quaternion
from compgs.scene.capture import Capture, PosedImage, check_camera, usable_positions
from compgs.scene.colmap import UNDISTORT_COMMAND, ColmapCamera, ColmapImage, read_sparse_model
from compgs.scene.undistort import MODELS, Distortion
from compgs.scene.unused import larger_models
from compgs.scene.views import Points

# Models with one focal length for both axes
_ONE_FOCAL = ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE")


def read_colmap(folder: Path, sparse: Path, images: Path) -> Capture:
    """The capture whose sparse model lies in `sparse` and whose images in `images`."""
    model = read_sparse_model(sparse)
    if not model.images:
        raise SceneError(
            f"{sparse}: the sparse model has no registered images; run `colmap mapper` on {folder}"
        )
    posed = []
    for image in model.images:
        place = f"{sparse}, image {image.name!r}"
        camera, lens = _pinhole_and_lens(model.cameras[image.camera_id], _pose(image, place), place)
        check_camera(camera, place)
        posed.append(PosedImage(image.name, images / image.name, camera, lens))
    finite = usable_positions(model.points.positions)
    points = Points(model.points.positions[finite], model.points.colors[finite])
    notes: tuple[str, ...] = ()
    if not finite.all():
        notes = (f"{(~finite).sum()} points without a finite position were left out",)
    notes += larger_models(sparse, len(posed))
    return Capture(tuple(posed), None, points, str(sparse), (0.0, 0.0, 0.0), notes=notes)


def _pose(image: ColmapImage, place: str) -> np.ndarray:
    """[4, 4] world to camera."""
    quaternion = image.quaternion
    if not np.isfinite(quaternion).all() or not np.isfinite(image.translation).all() or not quaternion.any():
        raise UnsupportedCamera(
            f"{place}: the pose is not usable (quaternion {quaternion.tolist()}, translation "
            f"{image.translation.tolist()}); both must be finite, the quaternion not zero: remove the image "
            f"from the model or register it again"
        )
    return rigid(rotation_from_quaternion(quaternion), image.translation)


def _pinhole_and_lens(
    camera: ColmapCamera, world_to_camera: np.ndarray, place: str
) -> tuple[Camera, Distortion | None]:
    fx, *rest = camera.params
    fy, cx, cy, *coefficients = (fx, *rest) if camera.model in _ONE_FOCAL else rest
    pinhole = Camera(world_to_camera, fx, fy, cx, cy, camera.width, camera.height)
    if camera.model in ("SIMPLE_PINHOLE", "PINHOLE"):
        return pinhole, None
    if camera.model not in MODELS:
        raise UnsupportedCamera(
            f"{place}: images of the camera model {camera.model} cannot be undistorted on loading; "
            f"do it once with: {UNDISTORT_COMMAND}"
        )
    if not np.isfinite(coefficients).all():
        raise UnsupportedCamera(f"{place}: the distortion {coefficients} is not finite; calibrate again")
    lens = Distortion(camera.model, tuple(coefficients))
    return pinhole, None if lens.is_identity else lens
