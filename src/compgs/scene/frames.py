"""Frames of `transforms.json` and its kin: where an image lies, how it was taken, which pixels count.

Every field of such a file is used, refused because pictures would come out wrong without it, or named in a note.
Programs write intrinsics for all frames (beside `frames`) or for each (inside it); a frame's own go before the file's.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from compgs.cameras import Camera
from compgs.errors import SceneError, UnsupportedCamera
from compgs.scene.capture import PosedImage, check_camera, check_inside
from compgs.scene.images import stored_size
from compgs.scene.lenses import COEFFICIENTS, lens_of
from compgs.scene.names import Names
from compgs.scene.split_names import LISTS
from compgs.scene.transforms import file_path, number, read_transforms, world_to_camera

# Ways to say a focal length along one side; the first that is there is used.
FOCAL = {"x": ("fl_x", "camera_angle_x", "x_fov"), "y": ("fl_y", "camera_angle_y", "y_fov")}
INTRINSICS = ("w", "h", "cx", "cy", *FOCAL["x"], *FOCAL["y"], "camera_model", "is_fisheye", *COEFFICIENTS)
PATHS = ("file_path", "mask_path", "ply_file_path", *LISTS)
USED = frozenset((*INTRINSICS, *PATHS, "frames", "transform_matrix"))
# Without these the pictures would be taken for what they are not.
REFUSED = {
    "distortion_params": "its coefficients have no names; write k1, k2, p1, p2, k3, k4",
    **dict.fromkeys(("b1", "b2", "skew"), "sheared pixels cannot be undone; export undistorted images"),
    **dict.fromkeys(("s1", "s2", "s3", "s4"), "thin prisms cannot be undone; export undistorted images"),
    **dict.fromkeys(("equirectangular", "latlong"), "expected perspective images; cut the panorama up"),
    **{f"ftheta_p{i}": "f-theta lenses cannot be undone; export undistorted images" for i in range(5)},
    **dict.fromkeys(("from_mitsuba", "from_na"), "poses have other axes; export them in those of OpenGL"),
    "transform_matrix_start": "expected transform_matrix, one pose for the whole image; export that",
}
MOST_FIELDS = 12  # named in a note
ALIKE = 0.01  # of a focal length: two ways to say it that differ by less agree


@dataclass(frozen=True, eq=False)
class Frames:
    """What a file of frames holds."""

    file: Path
    images: tuple[PosedImage, ...]
    values: Mapping[str, Any]  # everything beside `frames`
    notes: tuple[str, ...]


def read_frames(file: Path, otherwise: Mapping[str, Any] | None = None) -> Frames:
    """Frames of a file, with paths relative to its folder. `otherwise`: intrinsics where this file has none at all.

    Raises SceneError, UnsupportedCamera for what cannot be used, with the file and the frame.
    """
    content = read_transforms(file)
    frames = content["frames"]
    values = {key: value for key, value in content.items() if key != "frames"}
    shared = dict(values)
    if otherwise and not any(key in part for part in (values, *frames) for key in INTRINSICS):
        shared = {**{key: otherwise[key] for key in INTRINSICS if key in otherwise}, **values}
    names, posed, notes = Names(), [], list[str]()
    for index, frame in enumerate(frames):
        place = f"{file}, frame {index}"
        merged = _merged(shared, frame)
        _check_known(merged, place)
        posed.append(_posed_image(file, frame, merged, names, place, index, notes))
    notes = list(dict.fromkeys(notes))  # once each
    unused = list(dict.fromkeys(_unused(values, frames)))
    if unused:
        more = f" and {len(unused) - MOST_FIELDS} more" if len(unused) > MOST_FIELDS else ""
        notes.append(f"{file.name}: fields that are not used: {', '.join(unused[:MOST_FIELDS])}{more}")
    return Frames(file, tuple(posed), values, tuple(notes))


def _merged(shared: Mapping[str, Any], frame: Mapping[str, Any]) -> dict[str, Any]:
    """A frame's fields before the file's; its own focal length in any of the ways to say it."""
    own = {key: value for key, value in frame.items() if value is not None}
    overruled = {key for keys in FOCAL.values() if any(k in own for k in keys) for key in keys}
    kept = {key: value for key, value in shared.items() if value is not None and key not in overruled}
    return {**kept, **own}


def _check_known(values: Mapping[str, Any], place: str) -> None:
    for key, why in REFUSED.items():
        if key in values and np.any(_truth(values[key])):
            raise UnsupportedCamera(f"{place}: {key} is {values[key]!r:.60}: {why}")


def _truth(value: Any) -> Any:
    """Whether a field says something: of a list, whether one of its numbers does."""
    return [_truth(part) for part in value] if isinstance(value, list) else bool(value)


def _unused(values: Mapping[str, Any], frames: list[dict[str, Any]]) -> Iterator[str]:
    for part in (values, *frames):
        for key, value in part.items():
            if key not in USED and key not in REFUSED and value is not None and value is not False:
                yield f"{key:.40}"


def _posed_image(
    file: Path,
    frame: Mapping[str, Any],
    values: dict[str, Any],
    names: Names,
    place: str,
    index: int,
    notes: list[str],
) -> PosedImage:
    folder = file.parent
    relative = file_path(dict(frame), place)
    check_inside(folder / relative, (folder,), f"the image of frame {index} in {file.name}, {relative!r},")
    path = names.find(folder, relative) or folder / relative
    width, height = _size(values, path, place, file.name, notes)
    fx, fy = _focal_lengths(values, width, height, place, file.name, notes)
    cx = number(values, "cx", place) if "cx" in values else width / 2
    cy = number(values, "cy", place) if "cy" in values else height / 2
    camera = Camera(world_to_camera(values, place), fx, fy, cx, cy, width, height)
    check_camera(camera, place)
    lens = lens_of(values, place, file.name, notes)
    return PosedImage(relative, path, camera, lens, _mask(folder, frame, names, place))


def _size(values: dict[str, Any], path: Path, place: str, file: str, notes: list[str]) -> tuple[int, int]:
    given = [key for key in ("w", "h") if key in values]
    if len(given) == 1:
        notes.append(f"{file}: {given[0]} is not used: of w and h the other is missing")
    if len(given) == 2:
        return int(number(values, "w", place)), int(number(values, "h", place))
    if not path.is_file():
        return 1, 1  # reported with all others, later
    size, sideways = stored_size(path)
    if not (sideways and "cx" in values and "cy" in values):
        return size
    # Of a photograph that is stored on its side the principal point tells which way the camera has it.
    center = number(values, "cx", place), number(values, "cy", place)
    return min((size, size[::-1]), key=lambda s: abs(center[0] / s[0] - 0.5) + abs(center[1] / s[1] - 0.5))


def _focal_lengths(
    values: dict[str, Any], width: int, height: int, place: str, file: str, notes: list[str]
) -> tuple[float, float]:
    """Pixels, along x and y. Of a side that has none it is the other's: pixels are square."""
    along_x = _focal_length(values, FOCAL["x"], width, place, file, notes)
    along_y = _focal_length(values, FOCAL["y"], height, place, file, notes)
    fx, fy = along_x or along_y, along_y or along_x
    if fx is None or fy is None:
        raise SceneError(f"{place}: neither fl_x nor camera_angle_x is given; export the focal length too")
    return fx, fy


def _focal_length(
    values: dict[str, Any], keys: tuple[str, ...], side: int, place: str, file: str, notes: list[str]
) -> float | None:
    _, angle, degrees = keys
    found = {key: number(values, key, place) for key in keys if key in values}
    for key, top in ((angle, np.pi), (degrees, 180.0)):
        if key in found:
            if not 0 < found[key] < top:
                unit = "degrees above 0 and below 180" if key == degrees else "radians above 0 and below pi"
                raise SceneError(f"{place}: {key} is {found[key]}; expected {unit}")
            found[key] = 0.5 * side / float(np.tan(found[key] / top * np.pi / 2))
    if not found:
        return None
    first, *others = found
    for other in others:
        if side > 1 and abs(found[other] - found[first]) > ALIKE * abs(found[first]):
            notes.append(
                f"{file}: {first} and {other} contradict each other ({found[first]:.5g} and {found[other]:.5g} "
                f"pixels): {first} is used"
            )
    return found[first]


def _mask(folder: Path, frame: Mapping[str, Any], names: Names, place: str) -> Path | None:
    """The file that a frame names. Raises SceneError if it is not there."""
    if frame.get("mask_path") is None:
        return None
    relative = file_path(dict(frame), place, "mask_path")
    check_inside(folder / relative, (folder,), f"mask_path {relative!r}")
    found = names.find(folder, relative)
    if found is None:
        raise SceneError(
            f"{place}: mask_path: {folder / relative} does not exist; restore it, or leave mask_path out"
        )
    return found
