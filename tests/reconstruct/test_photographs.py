"""Photographs as cameras and phones leave them."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from compgs.errors import SceneError, UnreadableImage
from compgs.reconstruct.cameras import lens_model, shared_camera
from compgs.reconstruct.photographs import (
    find_photographs,
    holds_photographs,
    store_masks,
    store_upright,
)

MAKE, MODEL, FOCAL_35 = 0x010F, 0x0110, 0xA405


def picture(width: int = 24, height: int = 16) -> Image.Image:
    """The upper left corner is white, all else a dark ramp."""
    pixels = np.zeros((height, width, 3), np.uint8)
    pixels[..., 1] = np.arange(width) * 3
    pixels[: height // 4, : width // 4] = 255
    return Image.fromarray(pixels)


def save(path: Path, image: Image.Image | None = None, **tags: int | str) -> Path:
    exif = Image.Exif()
    for name, value in tags.items():
        code = {"orientation": 0x0112, "make": MAKE, "model": MODEL}[name]
        exif[code] = value
    path.parent.mkdir(parents=True, exist_ok=True)
    (image or picture()).save(
        path, exif=exif, **({"quality": 95, "subsampling": 0} if path.suffix == ".jpg" else {})
    )
    return path


def three(folder: Path) -> Path:
    for index in range(3):
        save(folder / f"p{index}.jpg")
    return folder


def test_files_that_are_upright_are_stored_byte_for_byte(tmp_path: Path) -> None:
    source = three(tmp_path / "photos")
    store_upright(find_photographs(source), tmp_path / "images")
    for path in source.iterdir():
        assert (tmp_path / "images" / path.name).read_bytes() == path.read_bytes()


@pytest.mark.parametrize("suffix", [".jpg", ".png"])
@pytest.mark.parametrize("orientation", range(1, 9))
def test_every_orientation_is_stored_upright(orientation: int, suffix: str, tmp_path: Path) -> None:
    turns = {  # what a viewer does with each tag (Exif 2.3, table of orientations), undone
        1: (), 2: ("FLIP_LEFT_RIGHT",), 3: ("ROTATE_180",), 4: ("FLIP_TOP_BOTTOM",), 5: ("TRANSPOSE",),
        6: ("ROTATE_90",), 7: ("TRANSVERSE",), 8: ("ROTATE_270",),
    }  # fmt: skip
    stored = picture()
    for turn in turns[orientation]:
        stored = stored.transpose(getattr(Image.Transpose, turn))
    source = three(tmp_path / "photos")
    save(source / f"turned{suffix}", stored, orientation=orientation, make="maker")
    photographs = find_photographs(source)
    store_upright(photographs, tmp_path / "images")
    with Image.open(tmp_path / "images" / f"turned{suffix}") as upright:
        assert upright.size == (24, 16) == next(p.size for p in photographs if "turned" in p.name)
        assert upright.getexif().get(0x0112, 1) == 1
        assert upright.getexif().get(MAKE) == "maker"
        difference = np.abs(np.asarray(upright.convert("RGB"), int) - np.asarray(picture(), int))
    assert difference.mean() <= (3 if suffix == ".jpg" else 0)


def test_formats_that_scenes_do_not_keep_become_png_with_the_same_pixels(tmp_path: Path) -> None:
    source = three(tmp_path / "photos")
    picture().save(source / "odd.webp", lossless=True)
    store_upright(find_photographs(source), tmp_path / "images")
    with Image.open(tmp_path / "images" / "odd.png") as image:
        assert image.format == "PNG" and np.array_equal(np.asarray(image), np.asarray(picture()))


@pytest.mark.parametrize(
    ("pixels", "level"),
    [
        (np.full((16, 24), 0.5, np.float32), 128),
        (np.full((16, 24), 32896, np.uint16), 128),
        (np.full((16, 24, 4), 0, np.uint8), 255),  # as CMYK: no ink
    ],
)
def test_samples_that_png_does_not_have_become_8_bits(tmp_path: Path, pixels: np.ndarray, level: int) -> None:
    source = three(tmp_path / "photos")
    image = Image.fromarray(pixels, mode="CMYK") if pixels.ndim == 3 else Image.fromarray(pixels)
    image.save(source / "odd.tif")
    store_upright(find_photographs(source), tmp_path / "images")
    stored = np.asarray(Image.open(tmp_path / "images" / "odd.png"))
    assert stored.dtype == np.uint8 and stored.shape == (16, 24, 3) and (stored == level).all()


@pytest.mark.parametrize("suffix", ["tif", "png"])
def test_samples_of_which_white_is_not_known_are_refused_before_poses_are_sought(
    tmp_path: Path, suffix: str
) -> None:
    source = three(tmp_path / "photos")
    Image.fromarray(np.full((16, 24), 4095, np.uint16)).save(source / f"odd.{suffix}")
    with pytest.raises(UnreadableImage, match=rf"odd\.{suffix}: samples of 16 bits.*convert"):
        find_photographs(source)


@pytest.mark.parametrize("name", ["masks/p1.jpg.png", "masks/p1.png", "p1.jpg.mask.png", "p1_mask.png"])
@pytest.mark.parametrize(
    "drawn", ["on the picture as stored", "on the upright picture", "with a tag of its own"]
)
def test_masks_are_no_photographs_and_come_along_upright(tmp_path: Path, name: str, drawn: str) -> None:
    source = three(tmp_path / "photos")
    upright = np.zeros((24, 16), np.uint8)
    upright[:3, :5] = 255
    save(source / "p1.jpg", picture(), orientation=6)
    mask = Image.fromarray(upright)
    if drawn != "on the upright picture":
        mask = mask.transpose(Image.Transpose.ROTATE_90)  # undoes what the tag 6 asks for
    save(source / name, mask, **({"orientation": 6} if drawn == "with a tag of its own" else {}))
    photographs = find_photographs(source)
    assert [photograph.name for photograph in photographs] == ["p0.jpg", "p1.jpg", "p2.jpg"]
    assert store_masks(photographs, tmp_path / "masks") == 1
    (stored,) = (tmp_path / "masks").iterdir()
    assert stored.name == "p1.jpg.png"
    np.testing.assert_array_equal(np.asarray(Image.open(stored)), upright)


def test_folders_inside_count_and_hidden_files_do_not(tmp_path: Path) -> None:
    source = three(tmp_path / "photos")
    save(source / "left" / "p0.jpg")
    save(source / ".thumbnails" / "p0.jpg")
    save(source / ".hidden.jpg")
    assert [p.name for p in find_photographs(source)] == ["left/p0.jpg", "p0.jpg", "p1.jpg", "p2.jpg"]


def test_too_few_photographs_are_refused_and_heic_is_named_with_its_remedy(tmp_path: Path) -> None:
    (tmp_path / "a.HEIC").write_bytes(b"x")
    save(tmp_path / "b.jpg")
    assert holds_photographs(tmp_path)
    with pytest.raises(SceneError, match=r"1 photographs .*1 HEIC files are not read: convert them"):
        find_photographs(tmp_path)


def test_names_that_would_meet_in_the_scene_are_refused(tmp_path: Path) -> None:
    source = three(tmp_path / "photos")
    save(source / "same.png")
    picture().save(source / "same.webp")
    with pytest.raises(SceneError, match=r"same\.webp: would be stored as same\.png"):
        find_photographs(source)


def test_a_damaged_photograph_is_named(tmp_path: Path) -> None:
    source = three(tmp_path / "photos")
    (source / "p9.jpg").write_bytes(b"no image")
    with pytest.raises(UnreadableImage, match=r"p9\.jpg"):
        find_photographs(source)


def test_photographs_share_a_camera_if_sizes_and_headers_agree(tmp_path: Path) -> None:
    alike = find_photographs(three(tmp_path / "alike"))
    assert shared_camera(alike) == "one"
    save(tmp_path / "alike" / "other.jpg", model="another phone")
    assert shared_camera(find_photographs(tmp_path / "alike")) == "each"
    save(tmp_path / "sizes" / "p.jpg", picture(30, 16))
    assert shared_camera(find_photographs(three(tmp_path / "sizes"))) == "each"
    assert (
        lens_model("one", 40) == "OPENCV"
        and lens_model("each", 40) == lens_model("one", 5) == "SIMPLE_RADIAL"
    )
