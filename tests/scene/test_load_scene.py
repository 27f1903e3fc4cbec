import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from compgs.cameras import Camera
from compgs.errors import ConfigError
from compgs.numerics.rotations import rotation_from_quaternion
from compgs.scene import View, load_scene
from compgs.scene.colmap import ColmapCamera, read_sparse_model
from compgs.scene.colmap_writer import write_sparse_model

Write = Callable[..., Path]
PINHOLE = ColmapCamera(1, "PINHOLE", 24, 16, (20.0, 21.0, 12.5, 8.25))


def by_name(views: tuple[View, ...]) -> dict[str, View]:
    return {view.name: view for view in views}


def test_binary_and_text_give_the_same_scene(write_capture: Write) -> None:
    a = load_scene(write_capture(folder="a"))
    b = load_scene(write_capture(folder="b", text=True))
    assert [view.name for view in a.train_views] == [view.name for view in b.train_views]
    for one, other in zip(a.train_views + a.test_views, b.train_views + b.test_views, strict=True):
        np.testing.assert_array_equal(one.image, other.image)
        np.testing.assert_array_equal(one.camera.world_to_camera, other.camera.world_to_camera)
        assert (one.camera.fx, one.camera.cy) == (other.camera.fx, other.camera.cy)
    np.testing.assert_array_equal(a.points.positions, b.points.positions)
    np.testing.assert_array_equal(a.points.colors, b.points.colors)
    assert a.extent == b.extent


def test_views_carry_pixels_pose_and_intrinsics_as_they_stand(write_capture: Write) -> None:
    folder = write_capture()
    scene = load_scene(folder)
    views = by_name(scene.train_views + scene.test_views)
    for image in read_sparse_model(folder / "sparse" / "0").images:
        view = views[image.name]
        assert view.image.dtype == np.uint8
        np.testing.assert_array_equal(view.image, np.asarray(Image.open(folder / "images" / image.name)))
        camera = view.camera
        assert (camera.fx, camera.fy, camera.cx, camera.cy) == PINHOLE.params
        assert (camera.height, camera.width) == view.image.shape[:2]
        np.testing.assert_allclose(camera.rotation, rotation_from_quaternion(image.quaternion))
        np.testing.assert_array_equal(camera.translation, image.translation)
    assert scene.name == "capture"
    assert scene.source == folder
    assert scene.notes == ()
    assert scene.background == (0.0, 0.0, 0.0)


def test_every_eighth_of_the_name_sorted_views_is_held_out(write_capture: Write) -> None:
    names = [f"{i:02d}.png" for i in np.random.default_rng(3).permutation(18)]
    scene = load_scene(write_capture(names))
    assert [view.name for view in scene.test_views] == ["00.png", "08.png", "16.png"]
    expected = [f"{i:02d}.png" for i in range(18) if i % 8]
    assert [view.name for view in scene.train_views] == expected


def test_the_split_follows_the_settings(write_capture: Write) -> None:
    folder = write_capture()
    assert len(load_scene(folder, holdout=False).train_views) == 10
    assert load_scene(folder, holdout=False).test_views == ()
    assert [v.name for v in load_scene(folder, test_every=3).test_views] == [
        f"0{i}.png" for i in (0, 3, 6, 9)
    ]


def test_extent_is_the_reach_of_the_cameras(write_capture: Write) -> None:
    assert load_scene(write_capture()).extent == pytest.approx(1.1 * 3.0)  # a ring of radius 3


def test_images_are_averaged_when_scaled_down(write_capture: Write) -> None:
    folder = write_capture()
    full, half = load_scene(folder), load_scene(folder, downscale=2)
    for one, other in zip(full.train_views, half.train_views, strict=True):
        assert other.image.shape == (8, 12, 3)
        blocks = one.image.reshape(8, 2, 12, 2, 3).mean(axis=(1, 3))
        assert np.abs(other.image - blocks).max() <= 1.0
        assert (other.camera.fx, other.camera.fy) == (10.0, 10.5)
        assert (other.camera.cx, other.camera.cy) == (6.25, 4.125)


@given(
    st.integers(1, 2000), st.integers(1, 2000), st.integers(1, 16), st.floats(0.1, 3), st.floats(0.1, 3),
    st.tuples(st.floats(-2, 2), st.floats(-2, 2), st.floats(0.5, 5)),
)  # fmt: skip
def test_points_project_to_the_same_relative_place_after_scaling(
    width: int, height: int, factor: int, fx: float, fy: float, point: tuple[float, float, float]
) -> None:
    camera = Camera(np.eye(4), fx * width, fy * width, 0.4 * width, 0.6 * height, width, height)
    small = camera.resized(max(1, round(width / factor)), max(1, round(height / factor)))
    x, y, z = point
    for one, other, size, smaller in (
        (camera.fx * x / z + camera.cx, small.fx * x / z + small.cx, camera.width, small.width),
        (camera.fy * y / z + camera.cy, small.fy * y / z + small.cy, camera.height, small.height),
    ):
        assert one / size == pytest.approx(other / smaller, rel=1e-9, abs=1e-9)


def test_a_folder_of_smaller_images_is_used_where_it_agrees(write_capture: Write) -> None:
    folder = write_capture()
    (folder / "images_2").mkdir()
    for path in (folder / "images").iterdir():
        Image.new("RGB", (12, 8), (9, 8, 7)).save(folder / "images_2" / path.name)
    scene = load_scene(folder, downscale=2)
    assert scene.notes == ()
    assert (scene.train_views[0].image == (9, 8, 7)).all()
    assert scene.train_views[0].camera.cx == 6.25

    Image.new("RGB", (24, 16)).save(folder / "images_2" / "03.png")
    scene = load_scene(folder, downscale=2)
    assert "images_2" in scene.notes[0]
    assert not (scene.train_views[0].image == (9, 8, 7)).all()
    assert scene.train_views[0].image.shape == (8, 12, 3)


def test_uniformly_smaller_images_scale_the_intrinsics(write_capture: Write) -> None:
    camera = replace(PINHOLE, width=25, height=17)  # halves are not whole
    folder = write_capture(cameras=(camera,))
    for path in (folder / "images").iterdir():
        Image.open(path).resize((12, 8)).save(path)
    loaded = load_scene(folder).train_views[0].camera
    assert (loaded.width, loaded.height) == (12, 8)
    assert loaded.fx == pytest.approx(20 * 12 / 25)
    assert loaded.cy == pytest.approx(8.25 * 8 / 17)


def test_another_image_folder_can_be_named(write_capture: Write) -> None:
    folder = write_capture()
    shutil.move(folder / "images", folder / "photos")
    assert len(load_scene(folder, images="photos").train_views) == 8


def test_several_cameras_portrait_views_and_subfolders_work(write_capture: Write) -> None:
    portrait = ColmapCamera(4, "SIMPLE_PINHOLE", 10, 30, (25.0, 5.0, 15.0))
    names = [f"cam {i % 2}/{i}.png" for i in range(6)]
    scene = load_scene(write_capture(names, cameras=(PINHOLE, portrait)))
    views = by_name(scene.train_views + scene.test_views)
    assert views["cam 0/2.png"].image.shape == (16, 24, 3)
    assert views["cam 1/3.png"].image.shape == (30, 10, 3)
    assert (views["cam 1/3.png"].camera.fx, views["cam 1/3.png"].camera.fy) == (25.0, 25.0)


def test_images_without_a_pose_are_ignored(write_capture: Write) -> None:
    folder = write_capture()
    (folder / "images" / "unregistered.png").write_bytes(b"not an image")
    assert len(load_scene(folder, holdout=False).train_views) == 10


def test_distorted_views_become_pinhole_views(write_capture: Write) -> None:
    camera = ColmapCamera(1, "OPENCV", 48, 32, (40.0, 41.0, 24.0, 16.0, -0.1, 0.01, 0.001, 0.0))
    scene = load_scene(write_capture(cameras=(camera,)))
    for view in scene.train_views:
        assert view.image.shape == (view.camera.height, view.camera.width, 3)
        assert view.camera.width > 48  # barrel distortion had squeezed it
        assert (view.camera.fx, view.camera.fy) == (40.0, 41.0)


def test_zero_distortion_leaves_pixels_untouched(write_capture: Write) -> None:
    plain = load_scene(write_capture(folder="plain"))
    camera = ColmapCamera(1, "OPENCV", 24, 16, (*PINHOLE.params, 0.0, 0.0, 0.0, 0.0))
    lens = load_scene(write_capture(folder="lens", cameras=(camera,)))
    for one, other in zip(plain.train_views, lens.train_views, strict=True):
        np.testing.assert_array_equal(one.image, other.image)
        assert one.camera.cx == other.camera.cx


def test_transparent_images_stand_on_a_background_that_is_given(write_capture: Write) -> None:
    folder = write_capture()
    rgba = np.zeros((16, 24, 4), dtype=np.uint8)
    rgba[..., 0], rgba[..., 3] = 200, np.arange(24) * 11
    Image.fromarray(rgba).save(folder / "images" / "01.png")
    alpha = np.arange(24) * 11 / 255
    for background in ((0.0, 0.0, 0.0), (0.0, 0.5, 1.0)):
        view = by_name(load_scene(folder, background=background).train_views)["01.png"]
        assert view.mask is None
        behind = np.array(background) * 255
        expected = alpha[:, None] * (200, 0, 0) + (1 - alpha[:, None]) * behind
        assert np.abs(view.image - expected[None]).max() <= 0.5001


@pytest.mark.parametrize("mode", ["L", "P", "1", "CMYK", "I;16"])
def test_other_kinds_of_images_become_rgb(write_capture: Write, mode: str) -> None:
    folder = write_capture()
    gray = Image.fromarray(np.full((16, 24), 200, dtype=np.uint8))
    path = folder / "images" / "02.png"
    if mode == "I;16":
        Image.fromarray(np.full((16, 24), 200 * 257, dtype=np.uint16)).save(path)
    else:
        gray.convert(mode).save(path, format="TIFF" if mode == "CMYK" else None)
    view = by_name(load_scene(folder).train_views)["02.png"]
    expected = np.asarray(gray.convert(mode).convert("RGB")) if mode != "I;16" else np.full((16, 24, 3), 200)
    np.testing.assert_array_equal(view.image, expected)


def test_the_orientation_tag_is_ignored(write_capture: Write) -> None:
    folder = write_capture(["a.jpg", "b.jpg", "c.jpg"])
    exif = Image.Exif()
    exif[0x0112] = 6  # shown turned by 90 degrees
    Image.open(folder / "images" / "b.jpg").save(folder / "images" / "b.jpg", exif=exif)
    assert by_name(load_scene(folder).train_views)["b.jpg"].image.shape == (16, 24, 3)


def test_progress_reaches_the_number_of_views(write_capture: Write) -> None:
    seen: list[tuple[int, int]] = []
    load_scene(write_capture(), progress=lambda done, total: seen.append((done, total)))
    assert seen == [(i, 10) for i in range(1, 11)]


@pytest.mark.parametrize("points", [0, 99])
def test_too_few_points_are_completed_by_random_ones_and_said_so(write_capture: Write, points: int) -> None:
    folder = write_capture(points=points)
    scene = load_scene(folder)
    assert f"has {points} points" in scene.notes[0]
    assert len(scene.points) > 1000
    assert np.isfinite(scene.points.positions).all()
    np.testing.assert_array_equal(load_scene(folder).points.positions, scene.points.positions)


def test_copies_of_a_point_are_one_point(write_capture: Write) -> None:
    folder = write_capture(points=150)
    sparse = folder / "sparse" / "0"
    model = read_sparse_model(sparse)
    copies = replace(model.points, positions=np.tile(model.points.positions[:3], (50, 1)))
    write_sparse_model(sparse, model.cameras.values(), model.images, copies)
    scene = load_scene(folder)
    assert "has 3 points in different places, too few" in scene.notes[0] and scene.guessed
    assert len(np.unique(scene.points.positions, axis=0)) > 1000


def test_a_hundred_points_are_enough(write_capture: Write) -> None:
    scene = load_scene(write_capture(points=100))
    assert not scene.guessed
    assert len(scene.points) == 100
    assert scene.notes == ()


@pytest.mark.parametrize(
    "settings",
    [
        {"downscale": 0},
        {"downscale": 1.5},
        {"downscale": 8},  # 24 x 16 pixels become 3 x 2
        {"downscale": 1600},  # 3DGS takes it for a width
        {"test_every": 1},
        {"background": (0.0, 2.0, 0.0)},
    ],
)
def test_settings_out_of_range_are_refused(write_capture: Write, settings: dict) -> None:
    with pytest.raises(ConfigError, match=next(iter(settings))):
        load_scene(write_capture(), **settings)


def test_photographs_are_read_at_once_or_when_somebody_looks(
    write_capture: Write, monkeypatch: pytest.MonkeyPatch
) -> None:
    from compgs.scene import images

    folder, read, asked = write_capture(), images.read_photograph, []
    monkeypatch.setattr(
        images, "read_photograph", lambda posed, behind: asked.append(posed.name) or read(posed, behind)
    )
    scene = load_scene(folder, at_once=False)
    assert asked == []
    first = scene.train_views[0]
    assert first.image.shape == (first.camera.height, first.camera.width, 3)
    assert asked == [first.name]
    load_scene(folder)
    assert len(asked) == 1 + len(scene.train_views) + len(scene.test_views)
