"""Cameras without photographs: read from a file or a capture, or on a circle around the scene.

A camera file is a list of objects with `world_to_camera` (4 rows of 4 numbers, rigid; OpenCV axes), `fx`,
`fy`, `cx`, `cy`, `width`, `height` (pixels) and, for people, `name`. `compgs train` and `compgs evaluate`
leave one of the held-out views. The `cameras.json` of 3DGS is a camera file, too: it has `position`, and `rotation`
from camera to world, and its principal point is the middle.
"""

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from compgs.cameras import Camera
from compgs.errors import SceneError, UnsupportedCamera
from compgs.evaluation.capture_cameras import EXPECTED, cameras_of_capture, is_capture
from compgs.numerics.rotations import quaternion_from_rotation, rigid, rotation_from_quaternion
from compgs.scene.text_files import decoded

MAX_SIDE = 16_384  # pixels

FIELDS = ("world_to_camera", "fx", "fy", "cx", "cy", "width", "height")
# By which an entry of the cameras.json of 3DGS is known, and what it has beside that.
OF_3DGS = ("position", "rotation", "fx", "fy", "width", "height")


USUAL_DISTANCE = 2.2  # of a circle from the middle of a scene, in radii of the scene
NEARLY_ALL, MOST = 0.999, 0.95  # of the positions
# To see nearly all of an object one need not stand much farther away than to see most of it. Measured: objects 1.1 to
# 1.3 times, captures with their surroundings 2 times and more.
OF_OBJECT = 1.6
AS_GOOD = 0.8  # of the positions that the camera with most has in its picture: such others are as good
EDGE = 0.02  # of the sides of a picture: what is nearer to its edge does not count
LOOKS = 8  # cameras of a circle that are asked how much they show
MOST_LOOKED_AT = 20_000  # positions


def camera_entry(camera: Camera, name: str) -> dict[str, Any]:
    """One entry of a camera file."""
    return {
        "name": name,
        "world_to_camera": np.asarray(camera.world_to_camera, dtype=np.float64).tolist(),
        "fx": float(camera.fx),
        "fy": float(camera.fy),
        "cx": float(camera.cx),
        "cy": float(camera.cy),
        "width": int(camera.width),
        "height": int(camera.height),
    }


def camera_from_entry(entry: Any, place: str) -> tuple[str, Camera]:
    """Inverse of `camera_entry`. Raises UnsupportedCamera with `place` in front."""
    if not isinstance(entry, dict):
        raise UnsupportedCamera(
            f"{place}: expected an object with {', '.join(FIELDS)}, found {type(entry).__name__}"
        )
    if OF_3DGS[0] in entry and FIELDS[0] not in entry:
        entry = _from_3dgs(entry, place)
    missing = [field for field in FIELDS if field not in entry]
    if missing:
        raise UnsupportedCamera(f"{place}: {missing[0]!r} is missing; a camera has {', '.join(FIELDS)}")
    try:
        pose = np.array(entry["world_to_camera"], dtype=np.float64)
        fx, fy, cx, cy = (float(entry[field]) for field in ("fx", "fy", "cx", "cy"))
        width, height = int(entry["width"]), int(entry["height"])
    except (TypeError, ValueError, OverflowError) as error:
        raise UnsupportedCamera(f"{place}: not a number where one is expected ({error})") from error
    if pose.shape != (4, 4) or not np.isfinite(pose).all():
        raise UnsupportedCamera(f"{place}: world_to_camera must be 4 rows of 4 finite numbers")
    rotation = pose[:3, :3]
    if not (
        np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-4)
        and np.linalg.det(rotation) > 0
        and np.allclose(pose[3], [0, 0, 0, 1])
    ):
        raise UnsupportedCamera(f"{place}: world_to_camera is not a rotation and a translation")
    if not (np.isfinite([fx, fy, cx, cy]).all() and fx > 0 and fy > 0):
        raise UnsupportedCamera(
            f"{place}: focal lengths must be positive, centres finite; found {fx, fy, cx, cy}"
        )
    if not (1 <= width <= MAX_SIDE and 1 <= height <= MAX_SIDE):
        raise UnsupportedCamera(
            f"{place}: image size {width} x {height}; expected 1 to {MAX_SIDE} pixels a side"
        )
    return str(entry.get("name", place)), Camera(pose, fx, fy, cx, cy, width, height)


def _from_3dgs(entry: dict[str, Any], place: str) -> dict[str, Any]:
    """The fields of a camera as 3DGS writes it, as those of a camera file. Raises UnsupportedCamera."""
    try:
        position = np.array(entry["position"], dtype=np.float64).reshape(3)
        rotation = np.array(entry["rotation"], dtype=np.float64).reshape(3, 3).T
        fx, fy, width, height = (float(entry[key]) for key in OF_3DGS[2:])
    except (KeyError, TypeError, ValueError) as error:
        raise UnsupportedCamera(f"{place}: expected {', '.join(OF_3DGS)} ({error})") from error
    return {
        "name": str(entry.get("img_name", place)),
        "world_to_camera": rigid(rotation, -rotation @ position).tolist(),
        **{"fx": fx, "fy": fy, "width": width, "height": height},
        **{"cx": entry.get("cx", width / 2), "cy": entry.get("cy", height / 2)},
    }


def read_cameras(path: Path) -> list[tuple[str, Camera]]:
    """Names and cameras of a camera file, or of a capture: a folder, or the JSON file of its poses.

    Raises SceneError.
    """

    if is_capture(path):
        return cameras_of_capture(path)
    try:
        content = path.read_bytes()
    except OSError as error:
        raise SceneError(f"{path}: cannot be read ({error.strerror}); {EXPECTED}") from error
    return parse_cameras(content, str(path))


def parse_cameras(content: bytes, place: str) -> list[tuple[str, Camera]]:
    """Names and cameras of a camera file's content. Raises SceneError with `place` in front."""
    try:
        entries = json.loads(decoded(content))
    except (ValueError, RecursionError) as error:
        raise SceneError(f"{place}: not a camera file ({error}); {EXPECTED}") from error
    if not isinstance(entries, list) or not entries:
        found = type(entries).__name__ if entries else "none"
        raise SceneError(f"{place}: not a list of cameras, found {found}; {EXPECTED}")
    return [camera_from_entry(entry, f"{place}: camera {i}") for i, entry in enumerate(entries)]


def look_at(eye: np.ndarray, target: np.ndarray, up: np.ndarray) -> np.ndarray:
    """[4, 4] world to camera of a camera at `eye` that has `target` in its middle and `up` upwards."""
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    down = np.cross(forward, right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, down, forward])
    pose[:3, 3] = -pose[:3, :3] @ eye
    return pose


def orbit(
    positions: np.ndarray,  # [N, 3] world units, of the scene
    *,
    frames: int,
    width: int,
    height: int,
    up: tuple[float, float, float] = (0.0, -1.0, 0.0),
    elevation: float = 25.0,  # degrees above the horizon
    distance: float = USUAL_DISTANCE,  # in radii of the scene
    field_of_view: float = 50.0,  # degrees, of the image's longer side
) -> list[tuple[str, Camera]]:
    """Cameras on a circle around the middle of a scene, looking at it.

    The middle is the median position, the radius what three quarters of the positions lie in: the far
    background of a capture does not count. Captures do not say where up is; -y is what COLMAP's usually comes
    out as.
    """
    axis = np.asarray(up, dtype=np.float64)
    length = np.linalg.norm(axis)
    if not (np.isfinite(axis).all() and length > 0):
        raise UnsupportedCamera(f"up: expected a direction, found {up}")
    axis /= length
    middle, radius = _middle_and_radius(positions)
    side = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    side /= np.linalg.norm(side)
    front = np.cross(axis, side)
    tilt = np.deg2rad(elevation)
    focal = max(width, height) / (2 * np.tan(np.deg2rad(field_of_view) / 2))
    result = []
    for i in range(frames):
        angle = 2 * np.pi * i / frames
        around = np.cos(angle) * front + np.sin(angle) * side
        eye = middle + distance * radius * (np.cos(tilt) * around + np.sin(tilt) * axis)
        pose = look_at(eye, middle, axis)
        result.append((f"orbit {i}", Camera(pose, focal, focal, width / 2, height / 2, width, height)))
    return result


def distance_of_all(
    positions: np.ndarray,  # [N, 3] world units, of the scene
    *,
    width: int,
    height: int,
    up: tuple[float, float, float] = (0.0, -1.0, 0.0),
    elevation: float = 25.0,  # degrees above the horizon
) -> float:
    """Distance, in radii of the scene, of the smallest circle (`orbit`) that has an object whole in its pictures.

    That of `orbit` by default, or more. A scene with a far background, which no such circle shows whole, has the
    default.
    """
    middle, radius = _middle_and_radius(positions)
    usual = USUAL_DISTANCE
    cameras = [
        camera
        for _, camera in orbit(
            positions, frames=LOOKS, width=width, height=height, up=up, elevation=elevation, distance=usual
        )
    ]
    step = max(1, len(positions) // MOST_LOOKED_AT)
    seen = np.asarray(positions[::step], dtype=np.float64) - middle
    needed = np.full(2, usual)
    for camera in cameras:
        across, down, ahead = camera.rotation @ seen.T  # from the middle
        sideways = np.maximum(
            np.abs(across) * 2 * camera.fx / width,
            np.abs(down) * 2 * camera.fy / height,
        )
        needed = np.maximum(needed, np.quantile(sideways - ahead, (MOST, NEARLY_ALL)) / radius)
    return float(needed[1]) if needed[1] <= OF_OBJECT * needed[0] else usual


def whole(positions: np.ndarray, *, frames: int, width: int, height: int) -> list[tuple[str, Camera]]:
    """Cameras on a circle (`orbit`) that have an object whole in their pictures."""
    distance = distance_of_all(positions, width=width, height=height)
    return orbit(positions, frames=frames, width=width, height=height, distance=distance)


def first_view(positions: np.ndarray, cameras: Sequence[Camera]) -> int:
    """Number of the camera that a scene is shown from first, as in the web page.

    Of the cameras with many of the positions [N, 3] in their pictures it is the one that looks most as all do: people
    take most photographs of what they care for from its front.
    """
    step = max(1, len(positions) // MOST_LOOKED_AT)
    seen = np.asarray(positions[::step], dtype=np.float64)
    counts = []
    for camera in cameras:
        across, down, ahead = camera.rotation @ (seen - camera.center).T
        before = ahead > 0
        x, y = across[before] / ahead[before] * camera.fx, down[before] / ahead[before] * camera.fy
        counts.append(int((np.maximum(abs(x) / camera.width, abs(y) / camera.height) < 0.5 - EDGE).sum()))
    directions = np.stack([camera.rotation[2] for camera in cameras])
    agreement = directions @ directions.mean(axis=0)
    return int(np.argmax(np.where(np.array(counts) >= AS_GOOD * max(counts), agreement, -np.inf)))


def _middle_and_radius(positions: np.ndarray) -> tuple[np.ndarray, float]:
    """The median position, and the radius within which three quarters of the positions lie."""
    middle = np.median(positions, axis=0).astype(np.float64)
    return middle, max(float(np.quantile(np.linalg.norm(positions - middle, axis=1), 0.75)), 1e-6)


def surround(positions: np.ndarray, *, width: int = 320, height: int = 240) -> list[tuple[str, Camera]]:
    """72 cameras that see a scene as visitors would: three heights, near and far, all around; positions as in `orbit`.

    Used to judge what matters in a scene when there are no photographs, only the file.
    """
    return [
        (f"{name}, {elevation:.0f} degrees high, {distance} radii away", camera)
        for elevation in (0.0, 25.0, 50.0)
        for distance in (1.2, 2.2)
        for name, camera in orbit(
            positions, frames=12, width=width, height=height, elevation=elevation, distance=distance
        )
    ]


NEIGHBOURS = 3  # of a camera: nearer ones are between which others are placed
ASIDE = 0.15  # of the distance to the nearest camera, by which those between two stand beside the line, about


def between(cameras: Sequence[Camera], count: int, *, seed: int = 0) -> list[Camera]:
    """`count` more cameras between neighbours of some and a little aside, looking as they do; always the same ones.

    Where a few cameras stand for a capture, these stand for what lies between the few.
    """
    chance = np.random.default_rng(seed)
    centers = np.stack([camera.center for camera in cameras])
    turns = np.stack([quaternion_from_rotation(camera.rotation) for camera in cameras])
    distances = np.linalg.norm(centers[:, None] - centers, axis=2) + np.diag(np.full(len(cameras), np.inf))
    result = []
    for i in range(count):
        one = i % len(cameras)
        near = np.argsort(distances[one], kind="stable")[: min(NEIGHBOURS, len(cameras) - 1)]
        other = int(chance.choice(near)) if len(near) else one
        way = chance.uniform(0.1, 0.9)
        turn = turns[other] if turns[one] @ turns[other] >= 0 else -turns[other]
        rotation = rotation_from_quaternion((1 - way) * turns[one] + way * turn)
        step = distances[one].min() if len(near) else 0.0
        center = (1 - way) * centers[one] + way * centers[other] + ASIDE * step * chance.normal(size=3)
        result.append(replace(cameras[one], world_to_camera=rigid(rotation, -rotation @ center)))
    return result
