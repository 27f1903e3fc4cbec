"""Damaged poses and points, byte by byte: a SceneError that names the file, or a scene; never another exception."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from compgs.errors import SceneError
from compgs.scene import load_scene
from compgs.scene.ply_points import read_ply_points

Write = Callable[..., Path]


def damaged(content: bytes, rng: np.random.Generator) -> bytes:
    """A few bytes changed, left out or put in, or the end cut off."""
    data = bytearray(content)
    for _ in range(int(rng.integers(1, 4))):
        place, kind = int(rng.integers(len(data))), rng.integers(4)
        if kind == 0:
            data[place] ^= 1 << int(rng.integers(8))
        elif kind == 1:
            data[place : place + int(rng.integers(1, 9))] = b""
        elif kind == 2:
            data[place:place] = rng.bytes(int(rng.integers(1, 9)))
        else:
            data = data[: max(1, place)]
    return bytes(data)


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize("part", ["cameras", "images", "points3D"])
def test_damaged_sparse_models_are_named(write_capture: Write, part: str, text: bool) -> None:
    folder = write_capture([f"{i}.png" for i in range(3)], text=text)
    file = folder / "sparse" / "0" / f"{part}.{'txt' if text else 'bin'}"
    whole, rng = file.read_bytes(), np.random.default_rng(1)
    for _ in range(40):
        file.write_bytes(damaged(whole, rng))
        try:
            load_scene(folder)
        except SceneError as error:
            assert str(folder) in str(error)


def test_damaged_transforms_are_named(write_capture: Write) -> None:
    folder = write_capture([f"{i}.png" for i in range(3)])
    scene = load_scene(folder)
    frames = []
    for view in scene.train_views + scene.test_views:
        matrix = np.linalg.inv(view.camera.world_to_camera) @ np.diag([1.0, -1, -1, 1])
        frames.append({"file_path": f"images/{view.name}", "transform_matrix": matrix.round(6).tolist()})
    shared = {"w": 24, "h": 16, "fl_x": 20.0, "cx": 12.5, "cy": 8.25, "test_filenames": ["images/1.png"]}
    whole = json.dumps({**shared, "frames": frames}).encode()
    shutil.rmtree(folder / "sparse")
    rng = np.random.default_rng(2)
    for _ in range(60):
        (folder / "transforms.json").write_bytes(damaged(whole, rng))
        try:
            load_scene(folder)
        except SceneError as error:
            assert str(folder) in str(error)


@pytest.mark.parametrize("layout", ["ascii", "binary_little_endian"])
def test_damaged_points_are_named(tmp_path: Path, layout: str) -> None:
    rng = np.random.default_rng(3)
    header = f"ply\nformat {layout} 1.0\nelement vertex 9\n"
    header += "".join(f"property float {axis}\n" for axis in "xyz") + "end_header\n"
    points = rng.normal(size=(9, 3)).astype("<f4")
    lines = "\n".join(" ".join(map(str, point)) for point in points.tolist())
    whole = header.encode() + (lines.encode() if layout == "ascii" else points.tobytes())
    file = tmp_path / "points.ply"
    for _ in range(300):
        file.write_bytes(damaged(whole, rng))
        try:
            points_read = read_ply_points(file)
            assert np.isfinite(points_read.positions).all()
        except SceneError as error:
            assert str(file) in str(error)


@pytest.mark.parametrize(
    "header",
    [b"format\n", b"element\n", b"element vertex\n", b"property\n", b"property float\n", b"element vertex 1e9\n"],
)  # fmt: skip
def test_headers_of_points_that_stop_in_a_line_are_named(tmp_path: Path, header: bytes) -> None:
    file = tmp_path / "points.ply"
    file.write_bytes(b"ply\nformat ascii 1.0\n" + header + b"end_header\n")
    with pytest.raises(SceneError, match=r"points\.ply"):
        read_ply_points(file)
