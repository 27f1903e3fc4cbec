"""One way to read cameras, whoever wrote them, for every command that takes some."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from compgs.cameras import Camera
from compgs.cli.main import main
from compgs.compressing.given import given_cameras
from compgs.errors import UnsupportedCamera
from compgs.evaluation.camera_path import camera_entry, look_at, parse_cameras, read_cameras
from compgs.numerics.rotations import quaternion_from_rotation
from compgs.scene.colmap import ColmapCamera, ColmapImage, ColmapPoints
from compgs.scene.colmap_writer import write_sparse_model

EYES = [np.array([3.0, -1.0, 0.5]), np.array([-2.0, -0.5, 3.0]), np.array([0.1, -2.0, -4.0])]
CAMERAS = [
    Camera(look_at(eye, np.zeros(3), np.array([0.0, -1.0, 0.0])), 45.0, 46.0, 20.0, 15.0, 40, 30)
    for eye in EYES
]
LENS = {"fx": 45.0, "fy": 46.0, "width": 40, "height": 30}


def as_ours(folder: Path) -> Path:
    return written(folder, [camera_entry(camera, f"{i}.png") for i, camera in enumerate(CAMERAS)])


def as_3dgs(folder: Path) -> Path:
    return written(
        folder,
        [
            {
                "id": i,
                "img_name": f"{i}.png",
                "position": eye.tolist(),
                "rotation": camera.rotation.T.tolist(),  # its columns are the camera's axes in the world
                **LENS,
            }
            for i, (eye, camera) in enumerate(zip(EYES, CAMERAS, strict=True))
        ],
    )


def as_3dgs_of_windows(folder: Path) -> Path:
    file = as_3dgs(folder)
    file.write_bytes(file.read_text().encode("utf-8-sig"))
    return file


def as_transforms(folder: Path, name: str = "transforms.json") -> Path:
    flip = np.diag([1.0, -1.0, -1.0, 1.0])
    frames = [
        {"file_path": f"{i}.png", "transform_matrix": (np.linalg.inv(c.world_to_camera) @ flip).tolist()}
        for i, c in enumerate(CAMERAS)
    ]
    return written(folder, {"fl_x": 45.0, "fl_y": 46.0, "w": 40, "h": 30, "frames": frames}, name)


def as_test_transforms(folder: Path) -> Path:
    return as_transforms(folder, "transforms_test.json")


def as_folder_of_transforms(folder: Path) -> Path:
    return as_transforms(folder).parent


def as_colmap(folder: Path) -> Path:
    no_observations = np.zeros((0, 2)), np.zeros(0)
    images = [
        ColmapImage(
            i + 1, quaternion_from_rotation(c.rotation), c.translation, 1, f"{i}.png", *no_observations
        )
        for i, c in enumerate(CAMERAS)
    ]
    nothing = ColmapPoints(np.zeros(0), np.zeros((0, 3)), np.zeros((0, 3), np.uint8), np.zeros(0))
    lens = ColmapCamera(1, "PINHOLE", 40, 30, (45.0, 46.0, 20.0, 15.0))
    write_sparse_model(folder / "sparse" / "0", [lens], images, nothing)
    return folder


def written(folder: Path, content: object, name: str = "cameras.json") -> Path:
    (folder / name).write_text(json.dumps(content), encoding="utf-8")
    return folder / name


KINDS = [
    as_ours,
    as_3dgs,
    as_3dgs_of_windows,
    as_transforms,
    as_test_transforms,
    as_folder_of_transforms,
    as_colmap,
]


@pytest.mark.parametrize("write", KINDS)
def test_cameras_of_every_kind_are_the_same_cameras(tmp_path: Path, write: Callable[[Path], Path]) -> None:
    path = write(tmp_path)
    found = read_cameras(path)
    assert [name for name, _ in found] == ["0.png", "1.png", "2.png"]
    for cameras in ([camera for _, camera in found], given_cameras(path)):
        for one, other in zip(cameras, CAMERAS, strict=True):
            np.testing.assert_allclose(one.world_to_camera, other.world_to_camera, atol=1e-9)
            assert (one.fx, one.fy, one.cx, one.cy) == (other.fx, other.fy, other.cx, other.cy)
            assert (one.width, one.height) == (40, 30)


@pytest.mark.parametrize("write", [as_3dgs, as_colmap])
@pytest.mark.parametrize("option", ["--cameras", "--path"])
def test_render_takes_them(
    tiny_cgs: Path, tmp_path: Path, write: Callable[[Path], Path], option: str
) -> None:
    size = [] if option == "--cameras" else ["--frames", "3", "--width", "40", "--height", "30"]
    command = ["render", tiny_cgs, option, write(tmp_path), *size, "-o", tmp_path / "out"]
    assert main([str(word) for word in command]) == 0
    entries = json.loads((tmp_path / "out" / "cameras.json").read_text())
    np.testing.assert_allclose(entries[0]["world_to_camera"], CAMERAS[0].world_to_camera, atol=1e-6)
    assert len(entries) == 3


def test_the_live_viewer_takes_the_list_of_3dgs(tmp_path: Path) -> None:
    assert len(parse_cameras(as_3dgs(tmp_path).read_bytes(), "cameras.json")) == 3


def test_what_is_missing_of_an_entry_of_3dgs_is_said_in_its_words(tmp_path: Path) -> None:
    file = written(
        tmp_path, [{"position": [0, 0, 0], "rotation": np.eye(3).tolist(), "fx": 1, "fy": 1, "width": 4}]
    )
    with pytest.raises(UnsupportedCamera, match=r"camera 0: expected position, rotation, .*'height'"):
        read_cameras(file)
