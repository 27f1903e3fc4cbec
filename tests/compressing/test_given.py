"""Cameras that somebody has already: from COLMAP, from JSON, with or without photographs. One reader for all."""

import json
from pathlib import Path

import numpy as np
import pytest

from compgs.cameras import Camera
from compgs.compressing.given import given_cameras
from compgs.errors import SceneError, UnsupportedCamera
from compgs.evaluation.camera_path import camera_entry, look_at
from compgs.scene.generated import generate_scene

EYES = [np.array([3.0, -1.0, 0.5]), np.array([-2.0, -0.5, 3.0]), np.array([0.1, -2.0, -4.0])]
CAMERAS = [
    Camera(look_at(eye, np.zeros(3), np.array([0.0, -1.0, 0.0])), 90.0, 91.0, 40.0, 30.0, 80, 60)
    for eye in EYES
]


def written(path: Path, content: object) -> Path:
    path.write_text(json.dumps(content), encoding="utf-8")
    return path


def check_same(found: list[Camera]) -> None:
    assert len(found) == len(CAMERAS)
    for one, other in zip(found, CAMERAS, strict=True):
        np.testing.assert_allclose(one.world_to_camera, other.world_to_camera, atol=1e-9)
        assert (one.fx, one.fy, one.width, one.height) == (90.0, 91.0, 80, 60)


def test_the_list_that_3dgs_writes_has_positions_and_rotations_of_the_cameras(tmp_path: Path) -> None:
    entries = [
        {
            "id": i,
            "img_name": f"{i}.jpg",
            "position": eye.tolist(),
            "rotation": camera.rotation.T.tolist(),  # its columns are the camera's axes in the world
            **{"fx": 90.0, "fy": 91.0, "width": 80, "height": 60},
        }
        for i, (eye, camera) in enumerate(zip(EYES, CAMERAS, strict=True))
    ]
    check_same(given_cameras(written(tmp_path / "cameras.json", entries[::-1])))


def test_our_own_list_of_cameras(tmp_path: Path) -> None:
    entries = [camera_entry(camera, f"view {i}") for i, camera in enumerate(CAMERAS)]
    check_same(given_cameras(written(tmp_path / "views.json", entries)))


def test_nerfstudio_without_photographs(tmp_path: Path) -> None:
    flip = np.diag([1.0, -1.0, -1.0, 1.0])
    frames = [
        {
            "file_path": f"images/{i}.png",
            "transform_matrix": (np.linalg.inv(camera.world_to_camera) @ flip).tolist(),
        }
        for i, camera in enumerate(CAMERAS)
    ]
    values = {"fl_x": 90.0, "fl_y": 91.0, "w": 80, "h": 60, "frames": frames}
    file = written(tmp_path / "transforms.json", values)
    check_same(given_cameras(file))
    check_same(given_cameras(tmp_path))
    del values["w"]
    written(file, values)
    with pytest.raises(UnsupportedCamera, match="add w and h"):
        given_cameras(file)


def test_a_colmap_scene(tmp_path: Path) -> None:
    generate_scene(tmp_path / "scene", views=3, width=32, height=24)
    found = given_cameras(tmp_path / "scene")
    assert [(c.width, c.height) for c in found] == [(32, 24)] * 3


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ([], "not a list of cameras"),
        ({"cameras": []}, "not a list of cameras"),
        ([camera_entry(CAMERAS[0], "one")], "at least two"),
        ([{"position": [0, 0, 0]}] * 2, "expected position, rotation"),
        ([camera_entry(CAMERAS[0], "one"), 5], "camera 1"),
    ],
)
def test_what_holds_no_cameras_is_refused_in_one_line(tmp_path: Path, content: object, message: str) -> None:
    with pytest.raises((SceneError, UnsupportedCamera), match=message) as error:
        given_cameras(written(tmp_path / "c.json", content))
    assert "\n" not in str(error.value)


def test_a_folder_without_cameras_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SceneError, match="no cameras found"):
        given_cameras(tmp_path)
    with pytest.raises(SceneError, match="cannot be read"):
        given_cameras(tmp_path / "nothing.json")
