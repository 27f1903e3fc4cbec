"""Each kind of bad input is refused with an error that names the file."""

import shutil
import struct
import zlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from compgs.errors import MissingSparseModel, SceneError, UnreadableImage, UnsupportedCamera
from compgs.scene import load_scene
from compgs.scene.colmap import CAMERA_MODELS, ColmapCamera, ColmapImage, read_sparse_model
from compgs.scene.colmap_writer import write_sparse_model
from compgs.scene.images import image_size, read_image

Write = Callable[..., Path]


def rewrite_images(folder: Path, change: Callable[[ColmapImage], ColmapImage]) -> None:
    model = read_sparse_model(folder / "sparse" / "0")
    images = [change(image) if index == 4 else image for index, image in enumerate(model.images)]
    write_sparse_model(folder / "sparse" / "0", model.cameras.values(), images, model.points)


def test_a_missing_folder_is_named(tmp_path: Path) -> None:
    with pytest.raises(SceneError, match=r"nowhere.*does not exist"):
        load_scene(tmp_path / "nowhere")


def test_a_file_in_place_of_a_folder_is_refused(tmp_path: Path) -> None:
    (tmp_path / "scene.txt").write_text("hello")
    with pytest.raises(SceneError, match="is a file"):
        load_scene(tmp_path / "scene.txt")


def test_an_empty_folder_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SceneError, match="is empty"):
        load_scene(tmp_path)


def test_photographs_without_poses_are_refused_with_the_command_that_helps(tmp_path: Path) -> None:
    (tmp_path / "images").mkdir()
    with pytest.raises(MissingSparseModel, match=r"no camera poses.*compgs reconstruct"):
        load_scene(tmp_path)


def test_the_command_that_helps_quotes_folders_with_spaces(tmp_path: Path) -> None:
    folder = tmp_path / "my garden"
    (folder / "images").mkdir(parents=True)
    with pytest.raises(MissingSparseModel, match=r"compgs reconstruct '.*my garden' -o SCENE"):
        load_scene(folder)


def test_a_missing_points_file_is_refused(write_capture: Write) -> None:
    folder = write_capture()
    (folder / "sparse" / "0" / "points3D.bin").unlink()
    with pytest.raises(MissingSparseModel, match="points3D"):
        load_scene(folder)


def test_missing_images_are_named_and_counted(write_capture: Write) -> None:
    folder = write_capture()
    for name in ("02.png", "05.png", "07.png"):
        (folder / "images" / name).unlink()
    with pytest.raises(UnreadableImage, match=r"02\.png.*2 more are missing"):
        load_scene(folder)


@pytest.mark.parametrize("content", [b"", b"not an image", b"\x89PNG\r\n\x1a\n"])
def test_unreadable_images_are_named(write_capture: Write, content: bytes) -> None:
    folder = write_capture()
    (folder / "images" / "03.png").write_bytes(content)
    with pytest.raises(UnreadableImage, match=r"03\.png"):
        load_scene(folder)


@pytest.mark.parametrize("suffix", ["png", "jpg"])
def test_truncated_images_are_named_and_counted(write_capture: Write, suffix: str) -> None:
    folder = write_capture([f"{i}.{suffix}" for i in range(6)])
    for index in (2, 4):
        path = folder / "images" / f"{index}.{suffix}"
        noise = np.random.default_rng(0).integers(0, 256, size=(16, 24, 3), dtype=np.uint8)
        Image.fromarray(noise).save(path)
        path.write_bytes(path.read_bytes()[:-300])
    with pytest.raises(UnreadableImage, match=rf"2\.{suffix}.*1 more is affected"):
        load_scene(folder)


def test_an_image_that_contradicts_its_camera_is_refused_with_both_sizes(write_capture: Write) -> None:
    folder = write_capture()
    Image.new("RGB", (16, 24)).save(folder / "images" / "06.png")
    with pytest.raises(UnreadableImage, match=r"06\.png.*16x24.*24x16"):
        load_scene(folder)


@pytest.mark.parametrize(
    "quaternion", [(0.0, 0.0, 0.0, 0.0), (np.nan, 0.0, 0.0, 1.0), (np.inf, 0.0, 0.0, 1.0)]
)
def test_impossible_rotations_are_named(write_capture: Write, quaternion: tuple[float, ...]) -> None:
    folder = write_capture()
    rewrite_images(folder, lambda image: replace(image, quaternion=np.array(quaternion)))
    with pytest.raises(UnsupportedCamera, match=r"04\.png.*quaternion"):
        load_scene(folder)


def test_a_position_that_is_not_finite_is_named(write_capture: Write) -> None:
    folder = write_capture()
    rewrite_images(folder, lambda image: replace(image, translation=np.array([0.0, np.nan, 0.0])))
    with pytest.raises(UnsupportedCamera, match=r"04\.png.*translation"):
        load_scene(folder)


def test_a_position_beyond_single_precision_is_named(write_capture: Write) -> None:
    folder = write_capture()
    rewrite_images(folder, lambda image: replace(image, translation=np.array([0.0, 1e200, 0.0])))
    with pytest.raises(UnsupportedCamera, match=r"04\.png.*world units from the origin"):
        load_scene(folder)


def test_two_poses_of_one_view_are_refused(write_capture: Write) -> None:
    folder = write_capture()
    rewrite_images(folder, lambda image: replace(image, name="03.png"))
    with pytest.raises(SceneError, match=r"03\.png.*more than one"):
        load_scene(folder)


@pytest.mark.parametrize("views", [0, 1])
def test_fewer_than_two_views_are_refused(write_capture: Write, views: int) -> None:
    with pytest.raises(SceneError, match=r"no registered images|1 view"):
        load_scene(write_capture(["only.png"][:views]))


def test_two_views_are_a_scene(write_capture: Write) -> None:
    scene = load_scene(write_capture(["a.png", "b.png"]))
    assert (len(scene.train_views), len(scene.test_views)) == (1, 1)


@pytest.mark.parametrize(
    "params", [(0.0, 21.0, 12.0, 8.0), (np.nan, 21.0, 12.0, 8.0), (20.0, -1.0, 12.0, 8.0)]
)
def test_impossible_focal_lengths_are_refused(write_capture: Write, params: tuple[float, ...]) -> None:
    with pytest.raises(UnsupportedCamera, match="focal"):
        load_scene(write_capture(cameras=(ColmapCamera(1, "PINHOLE", 24, 16, params),)))


@pytest.mark.parametrize("model", ["THIN_PRISM_FISHEYE", "RAD_TAN_THIN_PRISM_FISHEYE"])
def test_lenses_that_cannot_be_undistorted_name_the_command_that_can(
    write_capture: Write, model: str
) -> None:
    parameters = dict(CAMERA_MODELS.values())[model]
    camera = ColmapCamera(1, model, 24, 16, (20.0, 20.0, 12.0, 8.0, *[0.1] * (parameters - 4)))
    with pytest.raises(UnsupportedCamera, match=rf"{model}.*colmap image_undistorter --image_path"):
        load_scene(write_capture(cameras=(camera,)))


def test_absurd_distortion_is_refused_with_the_name_of_the_image(write_capture: Write) -> None:
    camera = ColmapCamera(1, "SIMPLE_RADIAL", 24, 16, (20.0, 12.0, 8.0, -500.0))
    with pytest.raises(UnsupportedCamera, match=r"00\.png.*SIMPLE_RADIAL"):
        load_scene(write_capture(cameras=(camera,)))


def test_points_that_are_not_finite_are_left_out_with_a_note(write_capture: Write) -> None:
    folder = write_capture()
    model = read_sparse_model(folder / "sparse" / "0")
    positions = model.points.positions.copy()
    positions[3], positions[7] = np.nan, np.inf
    points = replace(model.points, positions=positions)
    write_sparse_model(folder / "sparse" / "0", model.cameras.values(), model.images, points)
    scene = load_scene(folder)
    assert len(scene.points) == 148
    assert "2 points" in scene.notes[0]


@pytest.mark.parametrize("name", ["../../elsewhere/00.png", "a/../../../elsewhere/00.png", "ABSOLUTE"])
def test_images_outside_of_the_scene_are_refused(write_capture: Write, tmp_path: Path, name: str) -> None:
    folder, elsewhere = write_capture(), tmp_path / "elsewhere"
    (folder / "images").joinpath("a").mkdir()
    shutil.copytree(folder / "images", elsewhere)
    name = str(elsewhere / "00.png") if name == "ABSOLUTE" else name
    rewrite_images(folder, lambda image: replace(image, name=name))
    with pytest.raises(
        SceneError, match=r"capture: the image of the view .* lies outside of the scene's folder"
    ):
        load_scene(folder)


def test_an_images_folder_that_somebody_names_or_links_to_may_lie_anywhere(
    write_capture: Write, tmp_path: Path
) -> None:
    folder = write_capture()
    shutil.move(folder / "images", tmp_path / "photographs")
    assert len(load_scene(folder, images="../photographs").train_views) == 8
    assert len(load_scene(folder, images=str(tmp_path / "photographs")).train_views) == 8
    (folder / "images").symlink_to(tmp_path / "photographs")
    assert len(load_scene(folder).train_views) == 8


def test_an_image_that_would_fill_the_memory_is_refused(write_capture: Write) -> None:
    """A few bytes that say they are 900 million pixels."""
    folder = write_capture()
    header = b"IHDR" + struct.pack(">IIBBBBB", 30_000, 30_000, 8, 2, 0, 0, 0)
    data = (
        struct.pack(">I", 13)
        + header
        + struct.pack(">I", zlib.crc32(header))
        + struct.pack(">I", 9)
        + b"IDAT"
    )
    (folder / "images" / "03.png").write_bytes(b"\x89PNG\r\n\x1a\n" + data + bytes(13))
    with pytest.raises(UnreadableImage, match=r"03\.png.*exceeds limit.*smaller copies"):
        load_scene(folder)


@pytest.mark.parametrize("reading", [image_size, lambda file: read_image(file, (0.0, 0.0, 0.0))])
def test_a_program_that_is_called_an_image_is_not_run(
    tmp_path: Path, reading: Callable[[Path], object]
) -> None:
    """PostScript, which Pillow hands to Ghostscript."""
    Image.new("RGB", (24, 16)).save(tmp_path / "a.eps")
    (tmp_path / "a.eps").rename(tmp_path / "a.png")
    with pytest.raises(UnreadableImage, match=r"a\.png.*cannot identify"):
        reading(tmp_path / "a.png")


@pytest.mark.parametrize("suffix", ["png", "jpg", "webp", "tif", "bmp", "ppm", "tga", "mpo"])
def test_usual_formats_are_read(tmp_path: Path, suffix: str) -> None:
    file = tmp_path / f"a.{suffix}"
    Image.new("RGB", (24, 16), (200, 100, 50)).save(file)
    assert image_size(file) == (24, 16)
    assert np.abs(read_image(file, None)[0].mean((0, 1)) - (200, 100, 50)).max() < 4


@pytest.mark.parametrize("name", ["a.heic", "a.jpg"])
def test_heic_is_named_with_its_remedy(tmp_path: Path, name: str) -> None:
    file = tmp_path / name
    file.write_bytes(b"\x00\x00\x00\x24ftypheic" + bytes(40))
    for reading in (image_size, lambda file: read_image(file, None)):
        with pytest.raises(
            UnreadableImage, match=rf"{name}: HEIC images are not read; convert all of them to JPEG"
        ):
            reading(file)
