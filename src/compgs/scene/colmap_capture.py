"""A COLMAP data set: a sparse model beside a folder of images."""

from pathlib import Path

import numpy as np

from compgs.cameras import Camera
from compgs.errors import SceneError, UnsupportedCamera
from compgs.numerics.rotations import rigid, rotation_from_quaternion
from compgs.scene.capture import Capture, PosedImage, check_camera, usable_positions
from compgs.scene.colmap import (
    UNDISTORT_COMMAND,
    ColmapCamera,
    ColmapImage,
    SparseModel,
    points_ply,
    read_sparse_model,
)
from compgs.scene.names import Names, as_name
from compgs.scene.ply_points import read_ply_points
from compgs.scene.points import MIN_POINTS
from compgs.scene.split_names import split_by_lists
from compgs.scene.text_files import read_lines
from compgs.scene.undistort import MODELS, Distortion
from compgs.scene.unused import larger_models
from compgs.scene.views import Points

# Models with one focal length for both axes
_ONE_FOCAL = ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE")


# Lists of names beside the model, one a line: hierarchical 3DGS and 3DGS hold out what the second has.
TRAIN_LIST, TEST_LIST = "train.txt", "test.txt"


def read_colmap(folder: Path, sparse: Path, images: Path) -> Capture:
    """The capture whose sparse model lies in `sparse` and whose images in `images`."""
    model = read_sparse_model(sparse)
    if not model.images:
        raise SceneError(
            f"{sparse}: the sparse model has no registered images; run `colmap mapper` on {folder}"
        )
    posed, names = [], Names()
    for image in model.images:
        place = f"{sparse}, image {image.name!r}"
        camera, lens = _pinhole_and_lens(model.cameras[image.camera_id], _pose(image, place), place)
        check_camera(camera, place)
        path = image_path(image.name, folder, images, names)
        posed.append(PosedImage(as_name(image.name), path, camera, lens))
    points, source, files, notes = _points(model, sparse)
    if len({file.suffix.lower() for file in model.files}) > 1:
        *most, last = (file.name for file in model.files)
        notes += (
            f"the sparse model is that of {', '.join(most)} and {last}: there is no whole one of one kind",
        )
    notes += larger_models(sparse, len(posed))
    lists = _lists(sparse)
    used, held_out, of_split = split_by_lists(posed, {file.name: lists[file] for file in lists}, TRAIN_LIST)
    if held_out in (frozenset(), frozenset(image.name for image in posed)):
        used, held_out = tuple(posed), None
        of_split = (f"{', '.join(file.name for file in lists)}: not used, as its names are those of no view",)
    else:
        files += tuple(lists)
    return Capture(
        used,
        held_out,
        points,
        source,
        (0.0, 0.0, 0.0),
        notes=notes + of_split,
        files=model.files + files,
        split=" and ".join(str(file.relative_to(folder)) for file in lists) if held_out else "",
        reprojection_error=_mean_error(model),
    )


def image_path(name: str, folder: Path, images: Path, names: Names) -> Path:
    """The file of a model's image: in the folder of the images or, as some models have it, relative to the scene's."""
    return names.find(images, name) or names.find(folder, name) or images / name


def _points(model: SparseModel, sparse: Path) -> tuple[Points, str, tuple[Path, ...], tuple[str, ...]]:
    """Points with a place, the file they are from, what else was read, and what is to be noted.

    Of a model with fewer points than it takes to start from, and a points3D.ply beside it, those of the latter.
    """
    finite = usable_positions(model.points.positions)
    points = Points(model.points.positions[finite], model.points.colors[finite])
    notes: tuple[str, ...] = ()
    if not finite.all():
        notes = (f"{(~finite).sum()} points without a finite position were left out",)
    ply = points_ply(sparse)
    if ply is None or ply in model.files or len(points) >= MIN_POINTS:
        return points, str(sparse), (), notes
    better = read_ply_points(ply)
    if len(better) <= len(points):
        return points, str(sparse), (), notes
    note = f"{len(better):,} points are those of {sparse.name}/{ply.name}; the model itself has {len(points)}"
    return better, str(ply), (ply,), (*notes, note)


def _mean_error(model: SparseModel) -> float | None:
    """Mean reprojection error of the points, pixels; None where none is known."""
    errors = model.points.errors
    known = errors[np.isfinite(errors) & (errors >= 0)]
    return float(known.mean()) if len(known) else None


def _lists(sparse: Path) -> dict[Path, frozenset[str]]:
    """Lists of views that lie beside a model, the one of training views first."""
    names, found = Names(), {}
    for name in (TRAIN_LIST, TEST_LIST):
        if (file := names.find(sparse, name, ())) is not None:
            try:
                found[file] = frozenset(line.strip() for line in read_lines(file) if line.strip())
            except OSError as error:
                raise SceneError(f"{file}: cannot be read ({error.strerror or error})") from error
    return found


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
