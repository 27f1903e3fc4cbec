"""COLMAP sparse models, binary and text: cameras, images and points3D, as COLMAP's documentation has them.

A model is read as it stands: ids may have gaps, observations may lie outside their image or belong to no
point (id -1), names may hold folders and spaces. What makes it unusable is refused with the file's name.
"""

import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from compgs.errors import MissingSparseModel, SceneError, UnsupportedCamera
from compgs.scene.names import Names
from compgs.scene.ply_points import read_ply_points
from compgs.scene.text_files import read_lines

# model id -> (name, number of parameters); COLMAP's src/colmap/sensor/models.h fixes the numbers
CAMERA_MODELS = {
    0: ("SIMPLE_PINHOLE", 3),
    1: ("PINHOLE", 4),
    2: ("SIMPLE_RADIAL", 4),
    3: ("RADIAL", 5),
    4: ("OPENCV", 8),
    5: ("OPENCV_FISHEYE", 8),
    6: ("FULL_OPENCV", 12),
    7: ("FOV", 5),
    8: ("SIMPLE_RADIAL_FISHEYE", 4),
    9: ("RADIAL_FISHEYE", 5),
    10: ("THIN_PRISM_FISHEYE", 12),
    11: ("RAD_TAN_THIN_PRISM_FISHEYE", 16),
}
MODEL_IDS = {name: model_id for model_id, (name, _) in CAMERA_MODELS.items()}

UNDISTORT_COMMAND = (
    "colmap image_undistorter --image_path IMAGES --input_path SPARSE/0 --output_path UNDISTORTED "
    "--output_type COLMAP"
)


@dataclass(frozen=True)
class ColmapCamera:
    """Intrinsics shared by the images of one camera."""

    camera_id: int
    model: str  # one of CAMERA_MODELS
    width: int  # pixels
    height: int  # pixels
    params: tuple[float, ...]  # focal lengths, principal point, distortion: as the model orders them


@dataclass(frozen=True, eq=False)
class ColmapImage:
    """Pose and observations of one registered image."""

    image_id: int
    quaternion: np.ndarray  # [4] w-x-y-z, world to camera
    translation: np.ndarray  # [3] world units, world to camera
    camera_id: int
    name: str
    observations: np.ndarray  # [M, 2] float64, pixels
    point_ids: np.ndarray  # [M] int64, -1: not triangulated


@dataclass(frozen=True, eq=False)
class ColmapPoints:
    """Triangulated points, without their tracks (which the images' point ids repeat)."""

    point_ids: np.ndarray  # [P] uint64
    positions: np.ndarray  # [P, 3] float64, world units
    colors: np.ndarray  # [P, 3] uint8
    errors: np.ndarray  # [P] float64, pixels; -1: unknown


@dataclass(frozen=True, eq=False)
class SparseModel:
    """Everything that is read of a sparse model."""

    folder: Path
    cameras: dict[int, ColmapCamera]  # by camera id
    images: tuple[ColmapImage, ...]  # in the order of the file
    points: ColmapPoints
    files: tuple[Path, ...] = ()  # that were read


def find_sparse_model(folder: Path) -> Path | None:
    """The folder of the sparse model: `sparse/0`, `sparse` or the folder itself; None where there is none."""
    for candidate in (folder / "sparse" / "0", folder / "sparse", folder):
        if any(part_file(candidate, part) for part in ("cameras", "images")):
            return candidate
    return None


def part_file(folder: Path, part: str) -> Path | None:
    """`cameras`, `images` or `points3D` of a model, .bin before .txt, in any letter case."""
    names = Names()
    found = (names.find(folder, f"{part}.{kind}", ()) for kind in ("bin", "txt"))
    return next((file for file in found if file is not None), None)


def model_files(folder: Path) -> dict[str, Path]:
    """The file of each part that there is: of one kind where that has all three, binary before text."""
    names = Names()
    for kind in ("bin", "txt"):
        files = {part: names.find(folder, f"{part}.{kind}", ()) for part in _PARTS}
        whole = {part: file for part, file in files.items() if file is not None}
        if len(whole) == len(_PARTS):
            return whole
    return {part: file for part in _PARTS if (file := part_file(folder, part)) is not None}


def read_sparse_model(folder: Path) -> SparseModel:
    """Reads cameras, images and points3D; the binary files are preferred where all three exist.

    Without points3D, points are those of a points3D.ply, as 3DGS makes it. Raises MissingSparseModel, SceneError.
    """
    files = model_files(folder)
    if "points3D" not in files and (ply := points_ply(folder)) is not None:
        files["points3D"] = ply
    missing = [part for part in _PARTS if part not in files]
    if missing:
        there = ", ".join(file.name for file in files.values()) or "none of them"
        raise MissingSparseModel(
            f"{folder}: {missing[0]}.bin (or .txt) is missing; a sparse model is the three files cameras, "
            f"images and points3D, as `colmap mapper` writes them, found: {there}"
        )
    cameras = _guarded(_READERS["cameras", files["cameras"].suffix.lower()], files["cameras"])
    images = _guarded(_READERS["images", files["images"].suffix.lower()], files["images"])
    points = _guarded(_READERS["points3D", files["points3D"].suffix.lower()], files["points3D"])
    for image in images:
        if image.camera_id not in cameras:
            raise SceneError(
                f"{files['images']}: image {image.name!r} was taken by camera {image.camera_id}, but "
                f"{files['cameras'].name} only knows {', '.join(map(str, sorted(cameras))) or 'none'}; "
                f"export the model again"
            )
    return SparseModel(folder, cameras, images, points, tuple(files.values()))


def points_ply(folder: Path) -> Path | None:
    """Points as 3DGS keeps them beside a model, which COLMAP does not know."""
    return Names().find(folder, "points3D.ply", ())


def count_images(folder: Path) -> int:
    """Registered images of a sparse model, from as little of it as possible; 0 where there is none to be read."""
    file = part_file(folder, "images")
    try:
        if file is None:
            return 0
        if file.suffix.lower() == ".bin":
            with file.open("rb") as content:
                promised = int.from_bytes(content.read(_COUNT.size), "little")
            return min(promised, file.stat().st_size // _POSE.size)
        return sum(len(line.split()) == 10 for _, line in _content_lines(file))
    except OSError:
        return 0


_PARTS = ("cameras", "images", "points3D")
_Result = TypeVar("_Result")


def _guarded(read: Callable[[Path], _Result], file: Path) -> _Result:
    try:
        return read(file)
    except OSError as error:
        raise SceneError(f"{file}: cannot be read ({error.strerror or error})") from error


# Binary files: little endian, without padding


class _Bytes:
    """A binary file that is read from front to back; running out of bytes is an error that says where."""

    def __init__(self, file: Path) -> None:
        self.file = file
        self.data = file.read_bytes()
        self.position = 0

    def take(self, layout: struct.Struct, what: str) -> tuple:
        self.need(layout.size, what)
        values = layout.unpack_from(self.data, self.position)
        self.position += layout.size
        return values

    def need(self, size: int, what: str) -> None:
        if self.position + size > len(self.data):
            raise SceneError(
                f"{self.file}: {what} needs {size} bytes at byte {self.position}, but the file ends after "
                f"{len(self.data)}: it is truncated; copy or export it again"
            )

    def count(self, what: str, smallest: int) -> int:
        """A leading count, which the rest of the file must be able to hold at `smallest` bytes each."""
        (count,) = self.take(_COUNT, f"the number of {what}")
        self.need(count * smallest, f"a list of {count} {what}")
        return count


_COUNT = struct.Struct("<Q")
_CAMERA = struct.Struct("<IiQQ")  # camera id, model id, width, height
_POSE = struct.Struct("<I7dI")  # image id, quaternion, translation, camera id
_OBSERVATION = np.dtype([("x", "<f8"), ("y", "<f8"), ("point", "<i8")])
_POINT = np.dtype([("id", "<u8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8"), ("track", "<u8")])


def read_cameras_binary(file: Path) -> dict[int, ColmapCamera]:
    data = _Bytes(file)
    cameras = {}
    for index in range(data.count("cameras", _CAMERA.size)):
        camera_id, model_id, width, height = data.take(_CAMERA, f"camera {index}")
        if model_id not in CAMERA_MODELS:
            raise _unknown_model(file, camera_id, model_id)
        model, parameters = CAMERA_MODELS[model_id]
        params = data.take(struct.Struct(f"<{parameters}d"), f"the parameters of camera {camera_id}")
        cameras[camera_id] = ColmapCamera(camera_id, model, width, height, params)
    return cameras


def read_images_binary(file: Path) -> tuple[ColmapImage, ...]:
    data = _Bytes(file)
    images = []
    for index in range(data.count("images", _POSE.size + 1 + _COUNT.size)):
        image_id, qw, qx, qy, qz, tx, ty, tz, camera_id = data.take(_POSE, f"the pose of image {index}")
        end = data.data.find(b"\0", data.position)
        if end < 0:
            raise SceneError(f"{file}: the name of image {image_id} has no end: the file is truncated")
        name = data.data[data.position : end].decode("utf-8", errors="surrogateescape")
        data.position = end + 1
        count = data.count(f"observations of image {name!r}", _OBSERVATION.itemsize)
        seen = np.frombuffer(data.data, _OBSERVATION, count, data.position)
        data.position += seen.nbytes
        images.append(
            ColmapImage(
                image_id,
                np.array([qw, qx, qy, qz]),
                np.array([tx, ty, tz]),
                camera_id,
                name,
                np.stack([seen["x"], seen["y"]], axis=1),
                seen["point"].copy(),
            )
        )
    return tuple(images)


def read_points_binary(file: Path) -> ColmapPoints:
    data = _Bytes(file)
    count = data.count("points", _POINT.itemsize)
    # Tracks make the records ragged: one pass finds where each begins, numpy then gathers them all at once.
    starts = np.empty(count, dtype=np.int64)
    track_length, head, size = _COUNT.unpack_from, _POINT.itemsize, len(data.data)
    position = data.position
    for index in range(count):
        if position + head > size:
            raise SceneError(
                f"{file}: the file promises {count} points, but it ends inside point {index}: it is "
                f"truncated; copy or export it again"
            )
        starts[index] = position
        position += head
        position += 8 * track_length(data.data, position - 8)[0]
    data.need(position - data.position, "the track of the last point")
    octets = np.frombuffer(data.data, dtype=np.uint8)
    records = octets[starts[:, None] + np.arange(head)].view(_POINT).reshape(count)
    return ColmapPoints(records["id"], records["xyz"], records["rgb"], records["error"])


# Text files


def read_cameras_text(file: Path) -> dict[int, ColmapCamera]:
    cameras = {}
    for number, line in _content_lines(file):
        with _Line(file, number, "CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]"):
            first, model, width, height, *params = line.split()
            camera_id = int(first)
            if model not in MODEL_IDS:
                raise _unknown_model(file, camera_id, model)
            if len(params) != CAMERA_MODELS[MODEL_IDS[model]][1]:
                raise ValueError(
                    f"{model} has {CAMERA_MODELS[MODEL_IDS[model]][1]} parameters, not {len(params)}"
                )
            values = tuple(float(p) for p in params)
            cameras[camera_id] = ColmapCamera(camera_id, model, int(width), int(height), values)
    return cameras


def read_images_text(file: Path) -> tuple[ColmapImage, ...]:
    images = []
    lines = read_lines(file)
    index = 0
    while index < len(lines):
        line, number = lines[index], index + 1
        index += 1
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        with _Line(file, number, "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"):
            fields = line.strip().split(maxsplit=9)  # at most: the name may hold spaces
            pose = np.array([float(v) for v in fields[1:8]])
            image_id, camera_id, name = int(fields[0]), int(fields[8]), fields[9]
        # The line after a pose holds its observations, even when it is empty. Where somebody took out the empty
        # lines, it is the next pose.
        following = lines[index] if index < len(lines) else ""
        if _is_pose(following):
            following = ""
        else:
            index += 1
        with _Line(file, number + 1, "X Y POINT3D_ID, repeated"):
            seen = np.array(following.split()).reshape(-1, 3)
            observations = seen[:, :2].astype(np.float64)
            point_ids = seen[:, 2].astype(np.int64)
        images.append(ColmapImage(image_id, pose[:4], pose[4:], camera_id, name, observations, point_ids))
    return tuple(images)


def read_points_text(file: Path) -> ColmapPoints:
    ids, positions, colors, errors = [], [], [], []
    for number, line in _content_lines(file):
        fields = line.split(maxsplit=8)
        with _Line(file, number, "POINT3D_ID X Y Z R G B ERROR TRACK[]"):
            ids.append(int(fields[0]))
            positions.append((float(fields[1]), float(fields[2]), float(fields[3])))
            colors.append((int(fields[4]), int(fields[5]), int(fields[6])))
            errors.append(float(fields[7]))
            if not 0 <= ids[-1] < 1 << 64:
                raise ValueError(f"the id {ids[-1]} is outside 0 to 2^64")
            if not 0 <= min(colors[-1]) <= max(colors[-1]) <= 255:
                raise ValueError(f"a color of {colors[-1]} is outside 0 to 255")
    return ColmapPoints(
        np.array(ids, dtype=np.uint64),
        np.array(positions, dtype=np.float64).reshape(-1, 3),
        np.array(colors, dtype=np.uint8).reshape(-1, 3),
        np.array(errors, dtype=np.float64),
    )


def _is_pose(line: str) -> bool:
    """Whether a line of images.txt has a name at its end, which observations, triples of numbers, have not."""
    fields = line.split(maxsplit=9)
    if len(fields) < 10 or line.lstrip().startswith("#"):
        return False
    try:
        [float(field) for field in fields[:9]]
        [float(field) for field in fields[9].split()]
    except ValueError:
        return all(field.lstrip("-").isdigit() for field in (fields[0], fields[8]))
    return False


class _Line:
    """Turns whatever goes wrong while one line is parsed into an error that names the line."""

    def __init__(self, file: Path, number: int, expected: str) -> None:
        self.file, self.number, self.expected = file, number, expected

    def __enter__(self) -> None:
        pass

    def __exit__(self, kind: type | None, error: BaseException | None, trace: object) -> None:
        if isinstance(error, ValueError | IndexError | OverflowError):
            raise SceneError(
                f"{self.file}, line {self.number}: expected {self.expected} ({error})"
            ) from error


def _content_lines(file: Path) -> Iterator[tuple[int, str]]:
    for number, line in enumerate(read_lines(file), start=1):
        if line.strip() and not line.lstrip().startswith("#"):
            yield number, line


# Points as 3DGS keeps them


def read_points_ply(file: Path) -> ColmapPoints:
    """Positions and colors; ids in the order of the file, errors unknown."""
    points = read_ply_points(file)
    count = len(points)
    return ColmapPoints(
        np.arange(1, count + 1, dtype=np.uint64), points.positions, points.colors, np.full(count, -1.0)
    )


_READERS: dict[tuple[str, str], Callable[[Path], Any]] = {
    ("cameras", ".bin"): read_cameras_binary,
    ("cameras", ".txt"): read_cameras_text,
    ("images", ".bin"): read_images_binary,
    ("images", ".txt"): read_images_text,
    ("points3D", ".bin"): read_points_binary,
    ("points3D", ".txt"): read_points_text,
    ("points3D", ".ply"): read_points_ply,
}


def _unknown_model(file: Path, camera_id: int, model: int | str) -> UnsupportedCamera:
    return UnsupportedCamera(
        f"{file}: camera {camera_id} has the unknown model {model!r}; known: {', '.join(MODEL_IDS)}. "
        f"Make a pinhole model of it: {UNDISTORT_COMMAND}"
    )
