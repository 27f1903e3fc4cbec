"""What masks or transparency leave out does not count, in every layout, and nothing of it gets into what does."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from PIL import Image

from compgs.errors import SceneError, UnreadableImage
from compgs.scene import View, load_scene
from compgs.scene.colmap import ColmapCamera
from compgs.scene.masks import mask_of_brightness, resized_mask, undistorted_mask
from compgs.scene.undistort import sample_bicubic

Write = Callable[..., Path]
HEIGHT, WIDTH = 16, 24
BOX = (slice(3, 9), slice(5, 12))  # what a moving object covers


def masked_box() -> np.ndarray:
    mask = np.ones((HEIGHT, WIDTH), dtype=bool)
    mask[BOX] = False
    return mask


def write_mask(path: Path, mask: np.ndarray, white: int = 255) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(mask.astype(np.uint8) * np.uint8(white)).save(path)


def views_of(folder: Path, **reading: Any) -> dict[str, View]:
    scene = load_scene(folder, **reading)
    return {view.name: view for view in scene.train_views + scene.test_views}


# where masks come from


@pytest.mark.parametrize(
    "name",
    [
        "masks/a/01.jpg.png",
        "masks/a/01.png",
        "masks/a/01.jpg.mask.png",
        "masks/a/01_mask.png",
        "Masks/a/01.PNG",
        "masks/a/01.tif",
        "images/a/01.jpg.mask.png",
        "images/a/01_mask.png",
    ],
)
def test_a_mask_has_the_name_that_some_program_gives_it(write_capture: Write, name: str) -> None:
    folder = write_capture([f"a/{i:02d}.jpg" for i in range(4)])
    write_mask(folder / name, masked_box())
    views = views_of(folder)
    np.testing.assert_array_equal(views["a/01.jpg"].mask, masked_box())
    assert [name for name, view in views.items() if view.mask is not None] == ["a/01.jpg"]
    (note,) = load_scene(folder).notes
    assert "masks: 1 of 4 views" in note


def as_alpha(mask: np.ndarray, color: np.ndarray) -> Image.Image:  # color: [H, W, 3] uint8
    return Image.fromarray(np.dstack([color, mask.astype(np.uint8) * 255]))


BLACK, WHITE = (np.full((HEIGHT, WIDTH, 3), value, np.uint8) for value in (0, 255))
PICTURE = np.random.default_rng(0).integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)


@pytest.mark.parametrize("color", [BLACK, WHITE, PICTURE], ids=["black", "white", "a picture"])
def test_a_mask_may_be_the_alpha_channel_of_its_file(write_capture: Write, color: np.ndarray) -> None:
    folder = write_capture()
    (folder / "masks").mkdir()
    as_alpha(masked_box(), color).save(folder / "masks" / "01.png")
    np.testing.assert_array_equal(views_of(folder)["01.png"].mask, masked_box())


def test_a_mask_in_black_and_white_with_an_alpha_channel_leaves_out_what_either_does(
    write_capture: Write,
) -> None:
    folder = write_capture()
    (folder / "masks").mkdir()
    left = np.zeros((HEIGHT, WIDTH), dtype=bool)
    left[:, :8] = True
    as_alpha(~left, masked_box()[..., None] * WHITE).save(folder / "masks" / "01.png")
    as_alpha(np.ones_like(left), masked_box()[..., None] * WHITE).save(folder / "masks" / "02.png")
    views = views_of(folder)
    np.testing.assert_array_equal(views["01.png"].mask, masked_box() & ~left)
    np.testing.assert_array_equal(views["02.png"].mask, masked_box())


def test_views_of_which_a_mask_leaves_nothing_are_left_out_and_said(write_capture: Write) -> None:
    folder = write_capture([f"{i:02d}.png" for i in range(17)])
    nothing = np.zeros((HEIGHT, WIDTH), dtype=bool)
    for name in ("03.png", "08.png"):
        write_mask(folder / "masks" / name, nothing)
    scene = load_scene(folder)
    assert [view.name for view in scene.test_views] == ["00.png", "16.png"]
    assert len(scene.train_views) == 13
    assert "2 views are left out, their masks leave no pixel, such as 03.png" in scene.notes
    rgba = np.zeros((HEIGHT, WIDTH, 4), dtype=np.uint8)
    Image.fromarray(rgba).save(folder / "images" / "05.png")
    assert len(load_scene(folder).train_views) == 12


def test_where_the_only_held_out_view_is_masked_away_another_is_held_out(write_capture: Write) -> None:
    folder = write_capture([f"{i:02d}.png" for i in range(6)])
    write_mask(folder / "masks" / "00.png", np.zeros((HEIGHT, WIDTH), dtype=bool))
    scene = load_scene(folder)
    assert [view.name for view in scene.test_views] == ["01.png"] and len(scene.train_views) == 4
    assert "1 view is left out, its mask leaves no pixel: 00.png" in scene.notes


def test_masks_that_leave_nothing_of_any_view_are_refused(write_capture: Write) -> None:
    folder = write_capture()
    for i in range(10):
        write_mask(folder / "masks" / f"{i:02d}.png", np.zeros((HEIGHT, WIDTH), dtype=bool))
    with pytest.raises(SceneError, match=r"masks of all 10 views leave no pixel.*invert"):
        load_scene(folder)


def test_masks_of_the_test_views_count_too(write_capture: Write) -> None:
    folder = write_capture()
    write_mask(folder / "masks" / "00.png", masked_box())
    assert load_scene(folder).test_views[0].mask is not None


def test_masks_that_fit_no_view_are_said_to_be_unused(write_capture: Write) -> None:
    folder = write_capture()
    write_mask(folder / "masks" / "elsewhere.png", masked_box())
    scene = load_scene(folder)
    assert "masks/ is not used" in scene.notes[0]
    assert all(view.mask is None for view in scene.train_views)


def test_a_mask_that_leaves_nothing_out_is_none(write_capture: Write) -> None:
    folder = write_capture()
    write_mask(folder / "masks" / "01.png", np.ones((HEIGHT, WIDTH), dtype=bool))
    assert views_of(folder)["01.png"].mask is None


@pytest.mark.parametrize("white", [1, 128, 255])
def test_white_counts_whatever_its_value_is(tmp_path: Path, white: int) -> None:
    assert (mask_of_brightness(masked_box() * np.uint8(white)) == masked_box()).all()


def test_what_is_darker_than_half_of_white_does_not_count() -> None:
    assert mask_of_brightness(np.array([[0, 127, 128, 255]], np.uint8)).tolist() == [
        [False, False, True, True]
    ]
    assert not mask_of_brightness(np.zeros((2, 2), np.uint8)).any()


def test_a_mask_of_another_size_is_brought_to_that_of_the_photograph(write_capture: Write) -> None:
    folder = write_capture()
    write_mask(folder / "masks" / "01.png", np.kron(masked_box(), np.ones((3, 3), dtype=bool)))
    write_mask(folder / "masks" / "02.png", masked_box()[::2, ::2])
    views = views_of(folder)
    np.testing.assert_array_equal(views["01.png"].mask, masked_box())
    np.testing.assert_array_equal(
        views["02.png"].mask, np.kron(masked_box()[::2, ::2], np.ones((2, 2), dtype=bool))
    )


def test_a_mask_of_other_proportions_is_refused_with_both_sizes(write_capture: Write) -> None:
    folder = write_capture()
    write_mask(folder / "masks" / "01.png", np.ones((WIDTH, HEIGHT), dtype=bool))
    with pytest.raises(UnreadableImage, match=r"masks/01\.png: the mask has 16x24 .* 01\.png 24x16"):
        load_scene(folder)


def test_a_damaged_mask_is_named(write_capture: Write) -> None:
    folder = write_capture()
    (folder / "masks").mkdir()
    (folder / "masks" / "01.png").write_bytes(b"not a mask")
    with pytest.raises(UnreadableImage, match=r"masks/01\.png"):
        load_scene(folder)


def test_transparent_pixels_of_a_capture_do_not_count_and_keep_their_color(write_capture: Write) -> None:
    folder = write_capture()
    rgba = np.full((HEIGHT, WIDTH, 4), 200, dtype=np.uint8)
    rgba[..., 3] = np.arange(WIDTH) * 11
    Image.fromarray(rgba).save(folder / "images" / "01.png")
    view = views_of(folder)["01.png"]
    np.testing.assert_array_equal(view.mask, np.tile(np.arange(WIDTH) * 11 > 127, (HEIGHT, 1)))
    assert (view.image == 200).all()


def test_transparency_and_a_mask_leave_out_what_either_does(write_capture: Write) -> None:
    folder = write_capture()
    rgba = np.full((HEIGHT, WIDTH, 4), 200, dtype=np.uint8)
    rgba[:, :8, 3] = 0
    Image.fromarray(rgba).save(folder / "images" / "01.png")
    write_mask(folder / "masks" / "01.png", masked_box())
    expected = masked_box()
    expected[:, :8] = False
    np.testing.assert_array_equal(views_of(folder)["01.png"].mask, expected)


# what becomes of them


def test_a_reduced_pixel_counts_if_all_that_it_covers_does(write_capture: Write) -> None:
    folder = write_capture()
    write_mask(folder / "masks" / "01.png", masked_box())
    for downscale in (2, 4):
        view = views_of(folder, downscale=downscale)["01.png"]
        blocks = masked_box().reshape(HEIGHT // downscale, downscale, WIDTH // downscale, downscale)
        np.testing.assert_array_equal(view.mask, blocks.all((1, 3)))
        assert view.mask.shape == view.image.shape[:2]


def test_a_folder_of_smaller_images_takes_the_same_masks(write_capture: Write) -> None:
    folder = write_capture()
    write_mask(folder / "masks" / "01.png", masked_box())
    expected = views_of(folder, downscale=2)["01.png"].mask
    (folder / "images_2").mkdir()
    for path in (folder / "images").iterdir():
        Image.open(path).resize((WIDTH // 2, HEIGHT // 2)).save(folder / "images_2" / path.name)
    np.testing.assert_array_equal(views_of(folder, downscale=2)["01.png"].mask, expected)


@given(arrays(bool, (7, 9)), st.tuples(st.integers(2, 9), st.integers(2, 7)))
def test_nothing_that_is_masked_gets_into_a_reduced_pixel_that_counts(
    mask: np.ndarray, size: tuple[int, int]
) -> None:
    kept = resized_mask(mask, size)
    image = np.where(mask, 100, 255).astype(np.uint8)
    reduced = np.asarray(Image.fromarray(image).resize(size, Image.Resampling.BOX))
    assert (reduced[kept] == 100).all()


@given(arrays(bool, (6, 8)), st.integers(0, 1000))
def test_nothing_that_is_masked_gets_into_an_undistorted_pixel_that_counts(
    mask: np.ndarray, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    positions = rng.uniform(-3, 11, size=(5, 7, 2)).astype(np.float32)
    kept = undistorted_mask(mask, positions)
    image = np.where(mask, 100, rng.integers(0, 256, mask.shape))[..., None].repeat(3, 2).astype(np.uint8)
    assert (sample_bicubic(image, positions)[kept] == 100).all()
    # And what is made of pixels that count alone does count.
    np.testing.assert_array_equal(kept, sixteen(mask, positions))


def sixteen(mask: np.ndarray, positions: np.ndarray) -> np.ndarray:
    """Whether the sixteen pixels around each position count, one by one."""
    height, width = mask.shape
    result = np.ones(positions.shape[:2], dtype=bool)
    for i, j in np.ndindex(result.shape):
        left, top = np.floor(positions[i, j] - np.float32(0.5)).astype(int)
        for a in range(-1, 3):
            for b in range(-1, 3):
                result[i, j] &= mask[np.clip(top + b, 0, height - 1), np.clip(left + a, 0, width - 1)]
    return result


def test_masks_are_undistorted_with_their_photographs(write_capture: Write) -> None:
    """The masked box is red, so that what red is left would be seen."""
    lens = ColmapCamera(1, "SIMPLE_RADIAL", WIDTH, HEIGHT, (20.0, 12.0, 8.0, -0.2))
    folder = write_capture(cameras=(lens,))
    pixels = np.full((HEIGHT, WIDTH, 3), 90, dtype=np.uint8)
    pixels[BOX] = (255, 0, 0)
    Image.fromarray(pixels).save(folder / "images" / "01.png")
    write_mask(folder / "masks" / "01.png", masked_box())
    for downscale in (1, 2):
        view = views_of(folder, downscale=downscale)["01.png"]
        assert view.mask.shape == view.image.shape[:2] == (view.camera.height, view.camera.width)
        assert 0.3 < view.mask.mean() < 1
        assert (view.image[view.mask] == 90).all()
        assert (view.image[~view.mask] != 90).any()


# the layouts with JSON poses


@pytest.fixture
def nerfstudio(write_capture: Write) -> Callable[..., Path]:
    """A capture whose poses stand in transforms.json; `frames` changes the list of frames."""

    def write(frames: Callable[[list[dict[str, Any]]], None] = lambda frames: None, **values: Any) -> Path:
        folder = write_capture()
        scene = load_scene(folder)
        entries = []
        for view in sorted(scene.train_views + scene.test_views, key=lambda view: view.name):
            matrix = np.linalg.inv(view.camera.world_to_camera) @ np.diag([1.0, -1, -1, 1])
            entries.append({"file_path": f"images/{view.name}", "transform_matrix": matrix.tolist()})
        frames(entries)
        shared = {"w": WIDTH, "h": HEIGHT, "fl_x": 20.0, "fl_y": 21.0, "cx": 12.5, "cy": 8.25}
        (folder / "transforms.json").write_text(json.dumps({**shared, **values, "frames": entries}))
        shutil.rmtree(folder / "sparse")
        return folder

    return write


def test_frames_of_nerfstudio_name_their_masks(nerfstudio: Callable[..., Path]) -> None:
    def name_one(frames: list[dict[str, Any]]) -> None:
        frames[3]["mask_path"] = "./own/m.png"

    folder = nerfstudio(name_one)
    write_mask(folder / "own" / "m.png", masked_box())
    write_mask(folder / "masks" / "04.png", ~masked_box())
    views = views_of(folder)
    np.testing.assert_array_equal(views["images/03.png"].mask, masked_box())
    np.testing.assert_array_equal(views["images/04.png"].mask, ~masked_box())
    assert views["images/05.png"].mask is None


@pytest.mark.parametrize(
    ("path", "message"),
    [
        ("own/none.png", r"frame 3: mask_path: .*none\.png does not exist"),
        ("../m.png", r"mask_path '../m\.png' lies outside of the scene's folder"),
        (7, r"frame 3: mask_path is 7"),
    ],
)
def test_masks_that_cannot_be_used_are_named(
    nerfstudio: Callable[..., Path], path: object, message: str
) -> None:
    def name_one(frames: list[dict[str, Any]]) -> None:
        frames[3]["mask_path"] = path

    folder = nerfstudio(name_one)
    write_mask(folder.parent / "m.png", masked_box())
    with pytest.raises(SceneError, match=message):
        load_scene(folder)


def test_blender_scenes_have_masks_and_their_transparency_is_the_background(tmp_path: Path) -> None:
    rgba = np.full((HEIGHT, WIDTH, 4), 100, dtype=np.uint8)
    rgba[:, :6, 3] = 0
    frames = []
    for i in range(3):
        matrix = np.eye(4)
        matrix[:3, 3] = i, 0, 4
        (tmp_path / "train").mkdir(exist_ok=True)
        Image.fromarray(rgba).save(tmp_path / "train" / f"r_{i}.png")
        frames.append({"file_path": f"./train/r_{i}", "transform_matrix": matrix.tolist()})
    (tmp_path / "transforms_train.json").write_text(json.dumps({"camera_angle_x": 0.7, "frames": frames}))
    write_mask(tmp_path / "masks" / "train" / "r_1.png", masked_box())
    views = views_of(tmp_path)
    assert (views["train/r_0"].image[:, :6] == 255).all() and views["train/r_0"].mask is None
    np.testing.assert_array_equal(views["train/r_1"].mask, masked_box())
