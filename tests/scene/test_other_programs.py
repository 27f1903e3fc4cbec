"""Captures as other programs write them: read as they are meant, or refused with what is to be done."""

import json
import shutil
import unicodedata
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from compgs.errors import MissingSparseModel, SceneError, UnreadableImage, UnsupportedCamera
from compgs.scene import Scene, View, load_scene
from compgs.scene.colmap import ColmapCamera, read_sparse_model
from compgs.scene.colmap_writer import write_sparse_model

Write = Callable[..., Path]
WIDTH, HEIGHT = 64, 48


def names(views: tuple[View, ...]) -> list[str]:
    return [view.name for view in views]


def all_views(scene: Scene) -> tuple[View, ...]:
    return tuple(sorted(scene.train_views + scene.test_views, key=lambda view: view.name))


# COLMAP


def test_each_part_of_a_model_may_be_text_or_binary(write_capture: Write) -> None:
    whole = load_scene(write_capture(folder="whole"))
    folder, other = write_capture(), write_capture(folder="text", text=True)
    for part in ("cameras", "images"):
        (folder / "sparse" / "0" / f"{part}.bin").unlink()
        shutil.copy(other / "sparse" / "0" / f"{part}.txt", folder / "sparse" / "0")
    scene = load_scene(folder)
    np.testing.assert_array_equal(scene.points.positions, whole.points.positions)
    for one, same in zip(all_views(scene), all_views(whole), strict=True):
        np.testing.assert_array_equal(one.camera.world_to_camera, same.camera.world_to_camera)
    assert scene.notes == (
        "the sparse model is that of cameras.txt, images.txt and points3D.bin: there is no whole one of one kind",
    )


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16", "utf-8"])
@pytest.mark.parametrize("newline", ["\n", "\r\n"])
def test_text_models_are_read_in_the_encodings_of_windows(
    write_capture: Write, encoding: str, newline: str
) -> None:
    folder = write_capture([f"é {i}.png" for i in range(5)], text=True)
    for file in (folder / "sparse" / "0").iterdir():
        text = file.read_text(encoding="utf-8").replace("\n", newline)
        file.write_bytes(text.encode(encoding))
    scene = load_scene(folder)
    assert names(all_views(scene)) == [f"é {i}.png" for i in range(5)] and len(scene.points) == 150


def test_poses_of_which_somebody_took_out_the_empty_lines_are_all_read(write_capture: Write) -> None:
    folder = write_capture([f"a {i}.png" for i in range(5)], text=True)
    file = folder / "sparse" / "0" / "images.txt"
    rows = [line for line in file.read_text().splitlines() if line.endswith(".png") or line.startswith("#")]
    file.write_text("\n".join(rows) + "\n")
    assert names(all_views(load_scene(folder))) == [f"a {i}.png" for i in range(5)]


def as_ply(folder: Path, name: str, points: int) -> np.ndarray:
    """Points as 3DGS writes them beside a model."""
    positions = np.random.default_rng(1).normal(size=(points, 3)).astype(np.float32)
    header = f"ply\nformat ascii 1.0\nelement vertex {points}\n"
    header += "".join(f"property float {axis}\n" for axis in "xyz")
    header += "".join(f"property uchar {color}\n" for color in ("red", "green", "blue")) + "end_header\n"
    rows = "\n".join(" ".join(map(str, [*map(float, row), 1, 2, 3])) for row in positions)
    (folder / name).write_text(header + rows + "\n")
    return positions


@pytest.mark.parametrize("name", ["points3D.ply", "points3d.ply"])
@pytest.mark.parametrize("model", ["without a file of points", "with no points", "with few points"])
def test_points_of_a_ply_take_the_place_of_those_that_a_model_lacks(
    write_capture: Write, name: str, model: str
) -> None:
    folder = write_capture(points={"with no points": 0, "with few points": 20}.get(model, 150))
    sparse = folder / "sparse" / "0"
    if model == "without a file of points":
        (sparse / "points3D.bin").unlink()
    positions = as_ply(sparse, name, 120)
    scene = load_scene(folder)
    np.testing.assert_array_equal(scene.points.positions, positions)
    assert name in scene.notes[0] and not any("random" in note for note in scene.notes)


def test_a_ply_beside_a_model_with_points_is_said_to_be_unused(write_capture: Write) -> None:
    folder = write_capture()
    as_ply(folder / "sparse" / "0", "points3D.ply", 120)
    as_ply(folder, "dense.ply", 120)
    assert load_scene(folder).notes == ("not used: dense.ply, sparse/0/points3D.ply",)


def test_a_model_without_points_names_what_is_there(write_capture: Write) -> None:
    folder = write_capture()
    (folder / "sparse" / "0" / "points3D.bin").unlink()
    with pytest.raises(
        MissingSparseModel, match=r"points3D\.bin .* is missing.*found: cameras\.bin, images\.bin"
    ):
        load_scene(folder)


@pytest.mark.parametrize("line", ["03.png", "03", "./03.png", "03.PNG"])
def test_a_list_of_test_views_beside_a_model_is_the_split(write_capture: Write, line: str) -> None:
    folder = write_capture()
    (folder / "sparse" / "0" / "test.txt").write_text(f"{line}\r\n05.png\n\n")
    scene = load_scene(folder)
    assert names(scene.test_views) == ["03.png", "05.png"] and len(scene.train_views) == 8
    assert scene.split == "by sparse/0/test.txt" and scene.notes == ()
    other = load_scene(folder, split="every")
    assert names(other.test_views) == ["00.png", "08.png"]
    assert other.notes == ("sparse/0/test.txt: not followed, as split=every is asked for",)


def test_lists_of_training_and_test_views_leave_out_the_others(write_capture: Write) -> None:
    folder = write_capture()
    (folder / "sparse" / "0" / "train.txt").write_text("01.png\n02.png\n04.png\n")
    (folder / "sparse" / "0" / "test.txt").write_text("03.png\nnone.png\n")
    scene = load_scene(folder)
    assert names(scene.test_views) == ["03.png"] and names(scene.train_views) == [
        "01.png",
        "02.png",
        "04.png",
    ]
    assert scene.notes[0] == "train.txt, test.txt: of 1 names there is no frame, such as 'none.png'"


def test_a_text_that_names_no_view_is_no_split_and_said(write_capture: Write) -> None:
    folder = write_capture()
    (folder / "sparse" / "0" / "test.txt").write_text("tests of the camera went well\n")
    scene = load_scene(folder)
    assert names(scene.test_views) == ["00.png", "08.png"]
    assert scene.notes[0] == "test.txt: not used, as its names are those of no view"


@pytest.mark.parametrize("text", [False, True])
def test_names_of_windows_and_of_macos_find_their_photographs(write_capture: Write, text: bool) -> None:
    stored = [f"cam{i % 2}/é {i}.png" for i in range(6)]
    folder = write_capture(stored, text=text)
    for path in sorted((folder / "images").glob("*/*")):
        path.rename(path.with_name(unicodedata.normalize("NFD", path.name)))
    model = read_sparse_model(folder / "sparse" / "0")
    images = [replace(image, name=image.name.replace("/", "\\")) for image in model.images]
    write_sparse_model(folder / "sparse" / "0", model.cameras.values(), images, model.points, text=text)
    scene = load_scene(folder)
    assert names(all_views(scene)) == sorted(stored) and scene.notes == ()


def test_names_may_be_relative_to_the_folder_of_the_scene(write_capture: Write) -> None:
    folder = write_capture([f"images/{i}.png" for i in range(4)])
    for path in (folder / "images" / "images").iterdir():
        path.rename(folder / "images" / path.name)
    (folder / "images" / "images").rmdir()
    assert len(all_views(load_scene(folder))) == 4


# orientation tags


def turned(folder: Path, name: str, tag: int) -> None:
    exif = Image.Exif()
    exif[0x0112] = tag
    path = folder / "images" / name
    Image.open(path).save(path, exif=exif, quality=100, subsampling=0)


def test_a_photograph_is_turned_where_only_then_it_is_of_its_cameras_size(write_capture: Write) -> None:
    upright = ColmapCamera(1, "PINHOLE", 16, 24, (20.0, 21.0, 8.25, 12.5))
    names_ = [f"{i}.png" for i in range(4)]
    expected = load_scene(write_capture(names_, cameras=(upright,), folder="upright"))
    folder = write_capture(names_, cameras=(upright,))
    for path in (folder / "images").iterdir():  # stored lying, as phones do, with the tag that turns it back
        lying = Image.open(path).transpose(Image.Transpose.ROTATE_90)
        exif = Image.Exif()
        exif[0x0112] = 6
        lying.save(path, exif=exif)
    (folder / "masks").mkdir()
    mask = np.zeros((24, 16), dtype=np.uint8)
    mask[:5] = 255
    Image.fromarray(mask).save(folder / "masks" / "1.png")
    scene = load_scene(folder)
    assert "4 of 4 photographs are turned by their orientation tag: so their cameras are" in scene.notes
    for one, other in zip(all_views(scene), all_views(expected), strict=True):
        np.testing.assert_array_equal(one.image, other.image)
    (masked,) = (view for view in all_views(scene) if view.name == "1.png")
    np.testing.assert_array_equal(masked.mask, mask > 0)


def test_a_photograph_of_the_wrong_size_either_way_is_refused(write_capture: Write) -> None:
    folder = write_capture(["a.jpg", "b.jpg", "c.jpg"])
    Image.new("RGB", (24, 20)).save(folder / "images" / "b.jpg")
    turned(folder, "b.jpg", 6)
    with pytest.raises(UnreadableImage, match=r"b\.jpg.*24x20.*24x16"):
        load_scene(folder)


# JSON


def frame(index: int, name: str) -> dict[str, Any]:
    angle = 2 * np.pi * index / 8
    back = np.array([np.cos(angle), np.sin(angle), 0.3])
    back /= np.linalg.norm(back)
    right = np.cross([0.0, 0.0, 1.0], back)
    right /= np.linalg.norm(right)
    matrix = np.eye(4)
    matrix[:3] = np.stack([right, np.cross(back, right), back, 4 * back], axis=1)
    return {"file_path": name, "transform_matrix": matrix.tolist()}


@pytest.fixture
def write_frames(tmp_path: Path) -> Callable[..., Path]:
    """Writes `file` with eight frames; each photograph says its pixel coordinates: red for u, green for v."""

    def write(
        shared: dict[str, Any],
        file: str = "transforms.json",
        *,
        suffix: str = ".png",
        which: range = range(8),
        folder: str = "images",
        encoding: str = "utf-8",
        **own: Any,
    ) -> Path:
        (tmp_path / folder).mkdir(exist_ok=True)
        u, v = np.meshgrid((np.arange(WIDTH) + 0.5) / WIDTH, (np.arange(HEIGHT) + 0.5) / HEIGHT)
        pixels = np.round(np.stack([255 * u, 255 * v, 0 * u], axis=-1)).astype(np.uint8)
        for i in which:
            Image.fromarray(pixels).save(tmp_path / folder / f"img_{i}.png")
        frames = [{**frame(i, f"{folder}/img_{i}{suffix}"), **own} for i in which]
        (tmp_path / file).write_bytes(json.dumps({**shared, "frames": frames}).encode(encoding))
        return tmp_path

    return write


SIZE = {"w": WIDTH, "h": HEIGHT}
FOCAL = {"fl_x": 50.0, "fl_y": 51.0, "cx": 30.0, "cy": 25.0}


def error_of_undistortion(scene: Scene, distorted: Callable[[np.ndarray, np.ndarray], tuple]) -> float:
    """Largest distance in pixels, away from the edges, from where the lens has put a point to where it was read."""
    view = scene.train_views[0]
    camera = view.camera
    columns, rows = np.meshgrid(np.arange(2, camera.width - 2), np.arange(2, camera.height - 2))
    x, y = (columns + 0.5 - camera.cx) / camera.fx, (rows + 0.5 - camera.cy) / camera.fy
    bent_x, bent_y = distorted(x, y)
    u, v = 50 * bent_x + 30, 51 * bent_y + 25
    inside = (u > 2) & (u < WIDTH - 2) & (v > 2) & (v < HEIGHT - 2)
    assert inside.mean() > 0.5
    red, green, _ = np.moveaxis(view.image[rows, columns].astype(float), -1, 0)
    return float(
        max(np.abs(red * WIDTH / 255 - u)[inside].max(), np.abs(green * HEIGHT / 255 - v)[inside].max())
    )


def brown(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    r = x * x + y * y
    d = 1 + r * (-0.15 + r * (0.03 + r * (0.02 + r * -0.6)))
    return x * d, y * d


@pytest.mark.parametrize("file", ["transforms.json", "transforms_train.json"])
@pytest.mark.parametrize("place", ["file", "frame"])
def test_k4_belongs_to_the_eighth_power_of_the_radius(write_frames: Callable, file: str, place: str) -> None:
    lens = {"camera_model": "OPENCV", "k1": -0.15, "k2": 0.03, "k3": 0.02, "k4": -0.6}
    values = {**SIZE, **FOCAL, **lens}
    folder = write_frames(values, file) if place == "file" else write_frames({}, file, **values)
    assert error_of_undistortion(load_scene(folder), brown) < 0.7


def test_k4_to_k6_of_full_opencv_are_a_denominator(write_frames: Callable) -> None:
    lens = {"camera_model": "FULL_OPENCV", "k1": 0.1, "k4": 0.2, "k5": -0.1, "k6": 0.05}

    def rational(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        r = x * x + y * y
        d = (1 + 0.1 * r) / (1 + r * (0.2 + r * (-0.1 + r * 0.05)))
        return x * d, y * d

    assert error_of_undistortion(load_scene(write_frames({**SIZE, **FOCAL, **lens})), rational) < 0.7


@pytest.mark.parametrize("file", ["transforms.json", "transforms_train.json"])
@pytest.mark.parametrize(
    ("values", "fx", "fy"),
    [
        ({"camera_angle_x": 2 * np.arctan(32 / 50)}, 50, 50),
        ({"camera_angle_x": 2 * np.arctan(32 / 50), "camera_angle_y": 2 * np.arctan(24 / 75)}, 50, 75),
        ({"camera_angle_y": 2 * np.arctan(24 / 75)}, 75, 75),
        ({"fl_x": 50, "camera_angle_y": 2 * np.arctan(24 / 75)}, 50, 75),
        ({"fl_y": 60}, 60, 60),
        ({"x_fov": 2 * np.degrees(np.arctan(32 / 50)), "y_fov": 2 * np.degrees(np.arctan(24 / 75))}, 50, 75),
    ],
)
@pytest.mark.parametrize("size", [SIZE, {}])
def test_every_way_to_say_a_focal_length_is_used(
    write_frames: Callable, file: str, values: dict[str, float], fx: float, fy: float, size: dict[str, int]
) -> None:
    camera = load_scene(write_frames({**values, **size}, file)).train_views[0].camera
    assert (camera.fx, camera.fy) == pytest.approx((fx, fy))
    assert (camera.cx, camera.cy) == (32, 24)


def test_a_frames_own_focal_length_goes_before_the_files_in_whatever_way_it_is_said(
    write_frames: Callable,
) -> None:
    folder = write_frames({**SIZE, **FOCAL}, camera_angle_x=2 * np.arctan(32 / 80))
    camera = load_scene(folder).train_views[0].camera
    assert (camera.fx, camera.fy) == pytest.approx((80, 51))


def test_focal_lengths_that_contradict_each_other_are_said(write_frames: Callable) -> None:
    agreeing = {**SIZE, **FOCAL, "camera_angle_x": 2 * np.arctan(32 / 50)}
    assert not any("contradict" in note for note in load_scene(write_frames(agreeing)).notes)
    scene = load_scene(write_frames({**agreeing, "camera_angle_x": 0.7}))
    assert scene.train_views[0].camera.fx == 50
    assert (
        "transforms.json: fl_x and camera_angle_x contradict each other (50 and 87.664 pixels): fl_x is used"
        in (scene.notes)
    )


@pytest.mark.parametrize("file", ["transforms.json", "transforms_train.json"])
@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"w": "64", "h": HEIGHT}, "w is '64'; expected a finite number"),
        ({"camera_angle_y": 3.5}, "camera_angle_y is 3.5; expected radians"),
        ({"x_fov": 200}, "x_fov is 200.0; expected degrees"),
        ({"k5": 0.1}, "k5 and k6 are coefficients of FULL_OPENCV, but the camera model is OPENCV"),
        ({"is_fisheye": True, "camera_model": "OPENCV"}, "contradict each other"),
        ({"camera_model": "EQUIRECTANGULAR"}, "not supported"),
        ({"equirectangular": True}, "equirectangular is True"),
        ({"distortion_params": [0.1, 0, 0, 0]}, "distortion_params is"),
        ({"b1": 0.2}, "b1 is 0.2"),
        ({"s1": 0.2}, "s1 is 0.2"),
        ({"ftheta_p1": 0.2}, "ftheta_p1"),
        ({"from_mitsuba": True}, "from_mitsuba"),
    ],
)
def test_fields_that_would_make_the_pictures_wrong_are_refused(
    write_frames: Callable, file: str, values: dict[str, Any], message: str
) -> None:
    shared = {key: value for key, value in FOCAL.items() if not (set(values) & {"x_fov", "camera_angle_y"})}
    for folder in (write_frames({**shared, **values}, file), write_frames(shared, file, **values)):
        with pytest.raises((SceneError, UnsupportedCamera), match=rf"{file}, frame 0: .*{message}"):
            load_scene(folder)


def test_half_of_a_size_is_said_to_be_unused(write_frames: Callable) -> None:
    scene = load_scene(write_frames({**FOCAL, "w": 2 * WIDTH}))
    assert scene.train_views[0].camera.width == WIDTH
    assert "transforms.json: w is not used: of w and h the other is missing" in scene.notes


def test_zeros_of_such_fields_say_nothing(write_frames: Callable) -> None:
    zeros = {"k5": 0, "b1": 0.0, "distortion_params": [0, 0], "equirectangular": False, "is_fisheye": False}
    scene = load_scene(write_frames({**SIZE, **FOCAL, **zeros}))
    assert not any("fields that" in note for note in scene.notes)


def test_fields_that_are_not_used_are_said_in_one_line(write_frames: Callable) -> None:
    folder = write_frames(
        {**SIZE, **FOCAL, "aabb_scale": 4}, depth_file_path="d.png", time=0.5, sharpness=None
    )
    (note,) = (note for note in load_scene(folder).notes if "fields that" in note)
    assert note == "transforms.json: fields that are not used: aabb_scale, depth_file_path, time"


@pytest.mark.parametrize("file", ["transforms.json", "transforms_train.json"])
def test_names_without_suffix_and_marks_of_encodings_are_read(write_frames: Callable, file: str) -> None:
    for encoding in ("utf-8-sig", "utf-16"):
        scene = load_scene(write_frames({**SIZE, **FOCAL}, file, suffix="", encoding=encoding))
        assert names(all_views(scene)) == [f"images/img_{i}" for i in range(8)]


def test_two_names_of_one_photograph_are_refused(write_frames: Callable) -> None:
    folder = write_frames({**SIZE, **FOCAL})
    content = json.loads((folder / "transforms.json").read_text())
    content["frames"].append(frame(3, "images/img_3"))
    (folder / "transforms.json").write_text(json.dumps(content))
    with pytest.raises(SceneError, match=r"images/img_3' and 'images/img_3\.png' are one photograph"):
        load_scene(folder)


@pytest.mark.parametrize("held_out", ["val", "test"])
@pytest.mark.parametrize("own", [True, False])
def test_a_capture_with_a_file_for_each_split_is_read_with_its_intrinsics(
    write_frames: Callable, held_out: str, own: bool
) -> None:
    shared = {**SIZE, **FOCAL, "camera_model": "OPENCV", "k1": 0.04, "k2": -0.06}
    folder = write_frames({**shared, "ply_file_path": "points.ply"})
    write_frames(shared if own else {}, "transforms_train.json", which=range(6))
    write_frames(shared if own else {}, f"transforms_{held_out}.json", which=range(6, 8))
    positions = as_ply(folder, "points.ply", 120)
    scene = load_scene(folder)
    assert names(scene.test_views) == ["images/img_6.png", "images/img_7.png"]
    assert names(scene.train_views) == [f"images/img_{i}.png" for i in range(6)]
    camera = scene.train_views[0].camera
    assert (camera.fx, camera.fy) == (50, 51) and camera.cx != 32 and camera.width < WIDTH  # undistorted
    assert scene.background == (0, 0, 0)
    np.testing.assert_array_equal(scene.points.positions, positions)
    assert scene.split == f"by transforms_{held_out}.json" and scene.notes == ()


def test_of_test_and_validation_files_the_latter_is_said_to_be_unused(write_frames: Callable) -> None:
    folder = write_frames({"camera_angle_x": 1.0}, "transforms_train.json", folder="train", which=range(5))
    write_frames({"camera_angle_x": 1.0}, "transforms_test.json", folder="test", which=range(3))
    write_frames({"camera_angle_x": 1.0}, "transforms_val.json", folder="val", which=range(3))
    scene = load_scene(folder)
    assert len(scene.test_views) == 3
    assert scene.notes[-1] == "not used: transforms_val.json, val/"


def test_frames_of_both_files_are_held_out_and_said(write_frames: Callable) -> None:
    folder = write_frames({"camera_angle_x": 1.0}, "transforms_train.json")
    write_frames({"camera_angle_x": 1.0}, "transforms_test.json", which=range(2))
    scene = load_scene(folder)
    assert (len(scene.train_views), len(scene.test_views)) == (6, 2)
    assert any("2 frames are in transforms_train.json and" in note for note in scene.notes)


def test_a_folder_of_images_that_a_layout_does_not_ask_for_is_said(write_frames: Callable) -> None:
    scene = load_scene(write_frames({**SIZE, **FOCAL}), images="images_2")
    assert "images=images_2 is not used: transforms.json says where the images are" in scene.notes


# what is not used


def test_everything_in_the_folder_that_is_not_used_is_said_in_one_line(write_capture: Write) -> None:
    folder = write_capture()
    for name in (
        "database.db",
        "transforms.json",
        "LICENSE",
        "README.md",
        ".hidden",
        "input/1.png",
        "images/a.txt",
    ):
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_text("")
    (folder / "sparse" / "0" / "rigs.bin").touch()  # of COLMAP 4: nothing is missed without it
    for i in range(5):
        (folder / "sparse" / f"extra_{i}.txt").touch()
    (folder / "sparse" / "0" / "points3D.txt").touch()
    assert load_scene(folder).notes == (
        "not used: database.db, transforms.json, input/, images/a.txt, 5 files in sparse/, such as extra_0.txt, "
        "sparse/0/points3D.txt",
    )


def test_poses_that_lie_deeper_are_found_for_the_message(write_capture: Write) -> None:
    folder = write_capture(sparse="colmap/sparse/0")
    with pytest.raises(MissingSparseModel, match=r"no camera poses found.*some in colmap/"):
        load_scene(folder)
    deep = write_capture(folder="deep/inside")
    with pytest.raises(MissingSparseModel, match=r"some in inside/"):
        load_scene(deep.parent)


@pytest.mark.parametrize(
    ("name", "program"),
    [
        ("poses_bounds.npy", "LLFF"),
        ("garden.nvm", "VisualSFM"),
        ("cameras.xml", "Metashape"),
        ("images/00.xmp", "RealityScan"),
        ("cameras.sfm", "Meshroom"),
        ("bundle.out", "Bundler"),
    ],
)
def test_poses_that_are_not_read_are_named_with_their_program(
    tmp_path: Path, name: str, program: str
) -> None:
    (tmp_path / "images").mkdir()
    (tmp_path / name).touch()
    with pytest.raises(
        MissingSparseModel, match=rf"{name} is not read: poses of {program}.*transforms\.json"
    ):
        load_scene(tmp_path)


def test_features_without_poses_are_named_with_the_program_that_finds_them(tmp_path: Path) -> None:
    (tmp_path / "database.db").touch()
    with pytest.raises(
        MissingSparseModel, match=r"database\.db has COLMAP's features.*colmap mapper.*reconstruct"
    ):
        load_scene(tmp_path)


def test_photographs_that_were_converted_are_found_and_said(write_capture: Write) -> None:
    folder = write_capture([f"{i}.jpg" for i in range(5)])
    for path in sorted((folder / "images").iterdir()):
        Image.open(path).save(path.with_suffix(".png"))
        path.unlink()
    scene = load_scene(folder)
    assert names(all_views(scene)) == [f"{i}.jpg" for i in range(5)]
    assert scene.notes == ("5 photographs have another suffix than in the poses, such as 0.png for 0.jpg",)


def test_photographs_in_another_folder_are_named_with_the_option(write_capture: Write) -> None:
    folder = write_capture()
    (folder / "images").rename(folder / "photos")
    with pytest.raises(UnreadableImage, match=r"00\.png: .*photos/ has one of that name: .*images=\.\.\."):
        load_scene(folder)


@pytest.mark.parametrize("upright", [True, False])
def test_without_a_size_the_principal_point_tells_how_a_photograph_is_turned(
    write_frames: Callable, upright: bool
) -> None:
    folder = write_frames({"fl_x": 50, "cx": 24, "cy": 32} if upright else {"fl_x": 50, "cx": 32, "cy": 24})
    exif = Image.Exif()
    exif[0x0112] = 6
    for path in (folder / "images").iterdir():
        Image.open(path).save(path, exif=exif)
    view = load_scene(folder).train_views[0]
    assert view.image.shape == ((WIDTH, HEIGHT, 3) if upright else (HEIGHT, WIDTH, 3))
