"""The layouts with JSON poses: Blender and nerfstudio."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from compgs.errors import CompGSError, SceneError, UnreadableImage, UnsupportedCamera
from compgs.scene import images, load_scene
from compgs.scene.nerfstudio import read_nerfstudio
from compgs.scene.ply_points import read_ply_points
from compgs.scene.undistort import distort

WIDTH, HEIGHT = 20, 12


def looking_at_origin(center: np.ndarray) -> np.ndarray:
    """[4, 4] camera to world in the axes of OpenGL: x right, y up, z backward."""
    back = center / np.linalg.norm(center)
    right = np.cross([0.0, 0.0, 1.0], back)
    right /= np.linalg.norm(right)
    matrix = np.eye(4)
    matrix[:3] = np.stack([right, np.cross(back, right), back, center], axis=1)
    return matrix


def frames(folder: Path, split: str, count: int, suffix: str = "") -> list[dict[str, Any]]:
    (folder / split).mkdir(parents=True, exist_ok=True)
    result = []
    for index in range(count):
        angle = 2 * np.pi * index / count + 0.1
        rgba = np.full((HEIGHT, WIDTH, 4), 100, dtype=np.uint8)
        rgba[:, : WIDTH // 2, 3] = 0
        rgba[:, WIDTH // 2 :, 3] = 255
        Image.fromarray(rgba).save(folder / split / f"r_{index}.png")
        center = np.array([4 * np.cos(angle), 4 * np.sin(angle), 2.0])
        matrix = looking_at_origin(center).tolist()
        result.append({"file_path": f"./{split}/r_{index}{suffix}", "transform_matrix": matrix})
    return result


@pytest.fixture
def blender(tmp_path: Path) -> Path:
    for split, count in (("train", 5), ("test", 3)):
        content = {"camera_angle_x": 0.7, "frames": frames(tmp_path, split, count)}
        (tmp_path / f"transforms_{split}.json").write_text(json.dumps(content))
    return tmp_path


@pytest.fixture
def nerfstudio(tmp_path: Path) -> Callable[..., Path]:
    def write(**values: Any) -> Path:
        shared = {"w": WIDTH, "h": HEIGHT, "fl_x": 22.0, "fl_y": 23.0, "cx": 10.5, "cy": 6.25}
        content = {**shared, "frames": frames(tmp_path, "images", 9, ".png"), **values}
        (tmp_path / "transforms.json").write_text(json.dumps(content))
        return tmp_path

    return write


def assert_looks_at_origin(views: tuple) -> None:
    for view in views:
        camera = view.camera
        assert np.linalg.norm(camera.center) == pytest.approx(np.sqrt(20))
        np.testing.assert_allclose(
            camera.rotation @ np.zeros(3) + camera.translation, [0, 0, np.sqrt(20)], atol=1e-9
        )
        # what is above in the world is above in the image: y points down
        above = camera.rotation @ np.array([0.0, 0.0, 0.5]) + camera.translation
        assert above[1] < -0.1
        assert np.linalg.det(camera.rotation) == pytest.approx(1.0)


def test_blender_scenes_keep_their_split_and_stand_on_white(blender: Path) -> None:
    scene = load_scene(blender)
    assert [view.name for view in scene.train_views] == [f"train/r_{i}" for i in range(5)]
    assert [view.name for view in scene.test_views] == [f"test/r_{i}" for i in range(3)]
    assert scene.background == (1.0, 1.0, 1.0)
    image = scene.train_views[0].image
    assert (image[:, : WIDTH // 2] == 255).all()
    assert (image[:, WIDTH // 2 :] == 100).all()


def test_blender_poses_become_opencv_poses(blender: Path) -> None:
    scene = load_scene(blender)
    assert_looks_at_origin(scene.train_views + scene.test_views)
    camera = scene.train_views[0].camera
    # the angle spans the width
    assert 2 * np.arctan(WIDTH / 2 / camera.fx) == pytest.approx(0.7)
    assert (camera.fy, camera.cx, camera.cy) == (camera.fx, WIDTH / 2, HEIGHT / 2)


def test_blender_scenes_start_from_random_points_and_say_so(blender: Path) -> None:
    scene = load_scene(blender)
    assert "random" in scene.notes[0]
    assert np.linalg.norm(np.median(scene.points.positions, axis=0)) < 1.0


def test_blender_without_holdout_trains_on_all_views(blender: Path) -> None:
    assert len(load_scene(blender, holdout=False).train_views) == 8


def test_blender_without_test_views_holds_out_every_eighth(blender: Path) -> None:
    (blender / "transforms_test.json").unlink()
    assert [view.name for view in load_scene(blender).test_views] == ["train/r_0"]


def test_blender_scenes_scale_down(blender: Path) -> None:
    full, half = load_scene(blender), load_scene(blender, downscale=2)
    assert half.train_views[0].image.shape == (HEIGHT // 2, WIDTH // 2, 3)
    assert half.train_views[0].camera.fx == pytest.approx(full.train_views[0].camera.fx / 2)


def test_nerfstudio_poses_become_opencv_poses(nerfstudio: Callable[..., Path]) -> None:
    scene = load_scene(nerfstudio())
    assert_looks_at_origin(scene.train_views + scene.test_views)
    assert [view.name for view in scene.test_views] == ["images/r_0.png", "images/r_8.png"]
    camera = scene.train_views[0].camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (22.0, 23.0, 10.5, 6.25)


def test_nerfstudio_frames_may_have_their_own_intrinsics(nerfstudio: Callable[..., Path]) -> None:
    folder = nerfstudio()
    content = json.loads((folder / "transforms.json").read_text())
    content["frames"][3]["fl_x"] = 44.0
    (folder / "transforms.json").write_text(json.dumps(content))
    views = {view.name: view for view in load_scene(folder).train_views}
    assert views["images/r_3.png"].camera.fx == 44.0
    assert views["images/r_4.png"].camera.fx == 22.0


def test_nerfstudio_lenses_are_undistorted(nerfstudio: Callable[..., Path]) -> None:
    view = load_scene(nerfstudio(k1=-0.4, camera_model="OPENCV")).train_views[0]
    assert view.camera.width > WIDTH
    assert view.image.shape == (view.camera.height, view.camera.width, 3)
    fisheye = load_scene(nerfstudio(camera_model="OPENCV_FISHEYE")).train_views[0]
    assert fisheye.camera.width > WIDTH


LENS = {"k1": 0.1, "k2": -0.02, "p1": 0.003, "p2": -0.005, "k3": 0.04, "k4": 0.007}


def test_nerfstudios_radial_coefficients_are_those_of_one_polynomial(nerfstudio: Callable[..., Path]) -> None:
    """Where a lens puts a point: k1 to k4 belong to powers of the squared radius, or of a fisheye's squared angle."""
    x, y = 0.5, -0.3
    k1, k2, p1, p2, k3, k4 = LENS.values()
    r2 = x**2 + y**2
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3 + k4 * r2**4
    expected = (
        x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x**2),
        y * radial + p1 * (r2 + 2 * y**2) + 2 * p2 * x * y,
    )
    lens = read_nerfstudio(nerfstudio(camera_model="OPENCV", **LENS)).images[0].distortion
    assert lens is not None
    np.testing.assert_allclose(distort(np.array(x), np.array(y), lens), expected, rtol=1e-12)
    theta = np.arctan(np.sqrt(r2))
    bent = theta * (1 + k1 * theta**2 + k2 * theta**4 + k3 * theta**6 + k4 * theta**8) / np.sqrt(r2)
    for model in ("OPENCV_FISHEYE", "EQUIDISTANT"):
        fisheye = read_nerfstudio(nerfstudio(camera_model=model, **LENS)).images[0].distortion
        assert fisheye is not None
        np.testing.assert_allclose(distort(np.array(x), np.array(y), fisheye), (x * bent, y * bent))


@pytest.mark.parametrize("layout", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_nerfstudio_points_are_read(nerfstudio: Callable[..., Path], layout: str) -> None:
    rng = np.random.default_rng(0)
    positions = rng.normal(size=(120, 3)).astype(np.float32)
    colors = rng.integers(0, 256, size=(120, 3), dtype=np.uint8)
    folder = nerfstudio(ply_file_path="sparse_pc.ply")
    header = f"ply\nformat {layout} 1.0\ncomment points\nelement vertex 120\n"
    header += "".join(f"property float {axis}\n" for axis in "xyz")
    header += "".join(f"property uint8 {name}\n" for name in ("red", "green", "blue")) + "end_header\n"
    order = ">" if "big" in layout else "<"
    rows = np.empty(120, dtype=[("p", order + "f4", 3), ("c", "u1", 3)])
    rows["p"], rows["c"] = positions, colors
    lines = (" ".join(map(str, [*map(float, p), *c])) for p, c in zip(positions, colors, strict=True))
    body = "\n".join(lines).encode() if layout == "ascii" else rows.tobytes()
    (folder / "sparse_pc.ply").write_bytes(header.encode() + body)
    scene = load_scene(folder)
    np.testing.assert_array_equal(scene.points.positions, positions)
    np.testing.assert_array_equal(scene.points.colors, colors)
    assert scene.notes == ()


@pytest.mark.parametrize(
    ("kind", "names", "white"),
    [
        ("uchar", ("red", "green", "blue"), 255),
        ("ushort", ("red", "green", "blue"), 65535),
        ("float", ("red", "green", "blue"), 1.0),
        ("float", ("red", "green", "blue"), 255.0),
        ("uchar", ("diffuse_red", "diffuse_green", "diffuse_blue"), 255),
        ("float", ("r", "g", "b"), 1.0),
    ],
)
def test_colors_of_points_are_read_by_their_range(
    tmp_path: Path, kind: str, names: tuple[str, ...], white: float
) -> None:
    header = "ply\nformat ascii 1.0\nelement vertex 3\n"
    header += "".join(f"property float {axis}\n" for axis in "xyz")
    header += "".join(f"property {kind} {name}\n" for name in names) + "end_header\n"
    shares = np.array([[0, 0, 0], [1, 1, 1], [0.2, 0.4, 0.6]])
    rows = [
        " ".join(map(str, [0, 0, i, *(white * share).astype(type(white))])) for i, share in enumerate(shares)
    ]
    (tmp_path / "points.ply").write_text(header + "\n".join(rows))
    np.testing.assert_array_equal(read_ply_points(tmp_path / "points.ply").colors, (255 * shares).astype(int))


def test_splats_as_points_have_the_colors_of_their_harmonics(tmp_path: Path) -> None:
    header = "ply\nformat ascii 1.0\nelement vertex 1\n"
    header += "".join(f"property float {name}\n" for name in ("x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2"))
    (tmp_path / "points.ply").write_text(header + "end_header\n0 0 0 1.7724539 -1.7724539 0\n")
    assert read_ply_points(tmp_path / "points.ply").colors.tolist() == [[255, 0, 128]]  # 1.77 is sqrt(pi)


@pytest.mark.parametrize(
    "content",
    [
        b"", b"something else", b"ply\nend_header\n",
        b"ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nend_header\n1\n2\n",
        b"ply\nformat binary_little_endian 1.0\nelement vertex 9\nproperty float x\nproperty float y\n"
        b"property float z\nend_header\n123",
        b"ply\nformat morse 1.0\nelement vertex 0\nend_header\n",
    ],
)  # fmt: skip
def test_damaged_point_files_are_named(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "points.ply").write_bytes(content)
    with pytest.raises(SceneError, match=r"points\.ply"):
        read_ply_points(tmp_path / "points.ply")


@pytest.mark.parametrize("content", ["", "{", "[]", '{"frames": 3}', '{"frames": [1]}', '"\\ud800"'])
def test_damaged_json_is_named(tmp_path: Path, content: str) -> None:
    (tmp_path / "transforms.json").write_text(content)
    with pytest.raises(SceneError, match=r"transforms\.json"):
        load_scene(tmp_path)


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"transform_matrix": None}, UnsupportedCamera, "transform_matrix"),
        ({"transform_matrix": [[1, 0], [0, 1]]}, UnsupportedCamera, "transform_matrix"),
        ({"transform_matrix": np.full((4, 4), np.nan).tolist()}, UnsupportedCamera, "finite"),
        ({"transform_matrix": np.diag([1, 1, -1, 1]).tolist()}, UnsupportedCamera, "mirrors"),
        ({"transform_matrix": np.diag([1, 2, 1, 1]).tolist()}, UnsupportedCamera, "stretches"),
        ({"transform_matrix": np.zeros((4, 4)).tolist()}, UnsupportedCamera, "not a rotation"),
        ({"file_path": 7}, SceneError, "file_path"),
        ({"file_path": "images/none.png"}, UnreadableImage, r"none\.png"),
        ({"fl_x": "wide"}, SceneError, "fl_x"),
        ({"fl_x": -2.0}, UnsupportedCamera, "focal"),
        ({"camera_model": "EQUIRECTANGULAR"}, UnsupportedCamera, "EQUIRECTANGULAR"),
        ({"w": 40}, UnreadableImage, "40x12"),
    ],
)
def test_frames_that_cannot_be_used_are_named(
    nerfstudio: Callable[..., Path], change: dict[str, Any], error: type[CompGSError], message: str
) -> None:
    folder = nerfstudio()
    content = json.loads((folder / "transforms.json").read_text())
    content["frames"][3].update(change)
    (folder / "transforms.json").write_text(json.dumps(content))
    with pytest.raises(error, match=message):
        load_scene(folder)


def test_scaled_poses_keep_their_position(nerfstudio: Callable[..., Path]) -> None:
    folder = nerfstudio()
    content = json.loads((folder / "transforms.json").read_text())
    for frame in content["frames"]:
        matrix = np.array(frame["transform_matrix"])
        matrix[:3, :3] *= 0.25
        frame["transform_matrix"] = matrix.tolist()
    (folder / "transforms.json").write_text(json.dumps(content))
    assert_looks_at_origin(load_scene(folder).train_views)


@pytest.mark.parametrize("layout", ["blender", "nerfstudio"])
@pytest.mark.parametrize(
    "name", ["../elsewhere.png", "/elsewhere.png", "images/../../elsewhere.png", "C:\\elsewhere.png"]
)
def test_images_outside_of_the_scene_are_refused_before_they_are_opened(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, layout: str, name: str
) -> None:
    folder = tmp_path / "scene"
    entries = frames(folder, "images", 3, ".png")
    entries[1]["file_path"] = name
    Image.new("RGB", (WIDTH, HEIGHT)).save(tmp_path / "elsewhere.png")
    file = {"blender": "transforms_train.json", "nerfstudio": "transforms.json"}[layout]
    (folder / file).write_text(json.dumps({"camera_angle_x": 0.7, "frames": entries}))
    opened: list[str] = []
    monkeypatch.setattr(
        images, "stored_size", lambda path: opened.append(str(path)) or ((WIDTH, HEIGHT), False)
    )
    monkeypatch.setattr("compgs.scene.frames.stored_size", images.stored_size)
    with pytest.raises(
        SceneError, match=r"scene: the image of frame 1 in .* lies outside of the scene's folder"
    ):
        load_scene(folder)
    assert not [path for path in opened if "elsewhere" in path]
