"""Writes COLMAP sparse models, binary and text: the mirror image of `colmap.py`."""

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from compgs.outputs import replacing
from compgs.scene.colmap import MODEL_IDS, ColmapCamera, ColmapImage, ColmapPoints


def write_sparse_model(
    folder: Path,
    cameras: Iterable[ColmapCamera],
    images: Sequence[ColmapImage],
    points: ColmapPoints,
    *,
    text: bool = False,
) -> None:
    """cameras, images and points3D as .bin or .txt; the points' tracks follow from the images' point ids."""
    folder.mkdir(parents=True, exist_ok=True)
    tracks = point_tracks(images)
    kind = "txt" if text else "bin"
    contents = {
        "cameras": _cameras_text(cameras) if text else _cameras_binary(list(cameras)),
        "images": _images_text(images) if text else _images_binary(images),
        "points3D": _points_text(points, tracks) if text else _points_binary(points, tracks),
    }
    for part, content in contents.items():
        with replacing(folder / f"{part}.{kind}") as unfinished:
            unfinished.write_bytes(content)


def point_tracks(images: Iterable[ColmapImage]) -> dict[int, list[tuple[int, int]]]:
    """Point id -> the (image id, index of the observation) that see it."""
    tracks: dict[int, list[tuple[int, int]]] = {}
    for image in images:
        for index, point_id in enumerate(image.point_ids.tolist()):
            if point_id >= 0:
                tracks.setdefault(point_id, []).append((image.image_id, index))
    return tracks


# Binary files: little endian, without padding


def _u64(value: int) -> bytes:
    return value.to_bytes(8, "little")


def _u32(value: int) -> bytes:
    return value.to_bytes(4, "little")


def _f64(values: Iterable[float]) -> bytes:
    return np.asarray(tuple(values), dtype="<f8").tobytes()


def _cameras_binary(cameras: Sequence[ColmapCamera]) -> bytes:
    parts = [_u64(len(cameras))]
    for camera in cameras:
        parts += [
            _u32(camera.camera_id),
            _u32(MODEL_IDS[camera.model]),
            _u64(camera.width),
            _u64(camera.height),
        ]
        parts.append(_f64(camera.params))
    return b"".join(parts)


def _images_binary(images: Sequence[ColmapImage]) -> bytes:
    parts = [_u64(len(images))]
    for image in images:
        parts += [
            _u32(image.image_id),
            _f64(image.quaternion),
            _f64(image.translation),
            _u32(image.camera_id),
        ]
        parts += [image.name.encode("utf-8", errors="surrogateescape") + b"\0", _u64(len(image.point_ids))]
        seen = np.empty(len(image.point_ids), dtype=[("xy", "<f8", 2), ("point", "<i8")])
        seen["xy"], seen["point"] = image.observations, image.point_ids
        parts.append(seen.tobytes())
    return b"".join(parts)


def _points_binary(points: ColmapPoints, tracks: dict[int, list[tuple[int, int]]]) -> bytes:
    parts = [_u64(len(points.point_ids))]
    rows = zip(points.point_ids.tolist(), points.positions, points.colors, points.errors, strict=True)
    for point_id, position, color, error in rows:
        track = tracks.get(point_id, [])
        parts += [_u64(point_id), _f64(position), color.tobytes(), _f64([error]), _u64(len(track))]
        parts.append(np.array(track, dtype="<u4").tobytes())
    return b"".join(parts)


# Text files


def _cameras_text(cameras: Iterable[ColmapCamera]) -> bytes:
    lines = ["# CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]"]
    for camera in cameras:
        lines.append(_row([camera.camera_id, camera.model, camera.width, camera.height, *camera.params]))
    return _encoded(lines)


def _images_text(images: Iterable[ColmapImage]) -> bytes:
    lines = ["# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME", "# X Y POINT3D_ID, repeated"]
    for image in images:
        pose = [*image.quaternion.tolist(), *image.translation.tolist()]
        lines.append(_row([image.image_id, *pose, image.camera_id, image.name]))
        seen = zip(image.observations.tolist(), image.point_ids.tolist(), strict=True)
        lines.append(_row([value for (x, y), point_id in seen for value in (x, y, point_id)]))
    return _encoded(lines)


def _points_text(points: ColmapPoints, tracks: dict[int, list[tuple[int, int]]]) -> bytes:
    lines = ["# POINT3D_ID X Y Z R G B ERROR TRACK[] as (IMAGE_ID POINT2D_IDX)"]
    columns = (points.point_ids, points.positions, points.colors, points.errors)
    for point_id, position, color, error in zip(*(column.tolist() for column in columns), strict=True):
        track = [number for pair in tracks.get(point_id, []) for number in pair]
        lines.append(_row([point_id, *position, *color, error, *track]))
    return _encoded(lines)


def _row(values: Sequence[int | float | str]) -> str:
    return " ".join(repr(v) if isinstance(v, float) else str(v) for v in values)  # repr: every digit


def _encoded(lines: list[str]) -> bytes:
    return ("\n".join(lines) + "\n").encode("utf-8", errors="surrogateescape")
