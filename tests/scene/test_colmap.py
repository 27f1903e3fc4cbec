import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from compgs.errors import CompGSError, MissingSparseModel, SceneError, UnsupportedCamera
from compgs.scene.colmap import (
    CAMERA_MODELS,
    ColmapCamera,
    ColmapImage,
    ColmapPoints,
    SparseModel,
    find_sparse_model,
    read_sparse_model,
)
from compgs.scene.colmap_writer import point_tracks, write_sparse_model


def assert_same_model(a: SparseModel, b: SparseModel) -> None:
    assert a.cameras == b.cameras
    assert len(a.images) == len(b.images)
    for one, other in zip(a.images, b.images, strict=True):
        assert (one.image_id, one.camera_id, one.name) == (other.image_id, other.camera_id, other.name)
        np.testing.assert_array_equal(one.quaternion, other.quaternion)
        np.testing.assert_array_equal(one.translation, other.translation)
        np.testing.assert_array_equal(one.observations, other.observations)
        np.testing.assert_array_equal(one.point_ids, other.point_ids)
    for field in ("point_ids", "positions", "colors", "errors"):
        np.testing.assert_array_equal(getattr(a.points, field), getattr(b.points, field))


@pytest.fixture
def odd_model() -> tuple[list[ColmapCamera], list[ColmapImage], ColmapPoints]:
    """All camera models, ids with gaps, names with folders, spaces and accents, no observations."""
    rng = np.random.default_rng(1)
    cameras = [
        ColmapCamera(
            3 * model_id + 1, name, 640 + model_id, 480, tuple(rng.uniform(1, 500, size=parameters).tolist())
        )
        for model_id, (name, parameters) in CAMERA_MODELS.items()
    ]
    names = ["a.jpg", "sub folder/été 1.jpg", "b c.png", "z.jpg"]
    counts = [4, 0, 3, 0]
    images = [
        ColmapImage(
            100 - index,
            rng.normal(size=4),
            rng.normal(size=3),
            cameras[index].camera_id,
            name,
            rng.uniform(-50, 900, size=(count, 2)),
            rng.choice([-1, 12, 2**40], size=count),
        )
        for index, (name, count) in enumerate(zip(names, counts, strict=True))
    ]
    points = ColmapPoints(
        np.array([12, 2**40, 77], dtype=np.uint64),
        rng.normal(size=(3, 3)),
        rng.integers(0, 256, size=(3, 3), dtype=np.uint8),
        np.array([0.5, -1.0, 1e-9]),
    )
    return cameras, images, points


@pytest.mark.parametrize("text", [False, True])
def test_what_is_written_is_read_again(tmp_path: Path, odd_model: tuple, text: bool) -> None:
    cameras, images, points = odd_model
    write_sparse_model(tmp_path, cameras, images, points, text=text)
    expected = SparseModel(tmp_path, {c.camera_id: c for c in cameras}, tuple(images), points)
    assert_same_model(read_sparse_model(tmp_path), expected)


def test_binary_layout_is_the_documented_one(tmp_path: Path) -> None:
    (tmp_path / "cameras.bin").write_bytes(struct.pack("<QIiQQ3d", 1, 9, 0, 640, 480, 500.0, 320.0, 240.0))
    pose = struct.pack("<QI7dI", 1, 4, 1.0, 0.0, 0.0, 0.0, 1.0, 2.0, 3.0, 9)
    (tmp_path / "images.bin").write_bytes(pose + b"x y.jpg\0" + struct.pack("<Qddq", 1, 5.5, -6.5, -1))
    first = struct.pack("<Q3d3BdQ4I", 8, 1.0, 2.0, 3.0, 10, 20, 30, 0.25, 2, 4, 0, 4, 1)
    second = struct.pack("<Q3d3BdQ", 11, 4.0, 5.0, 6.0, 40, 50, 60, 0.5, 0)
    (tmp_path / "points3D.bin").write_bytes(struct.pack("<Q", 2) + first + second)
    model = read_sparse_model(tmp_path)
    assert model.cameras == {9: ColmapCamera(9, "SIMPLE_PINHOLE", 640, 480, (500.0, 320.0, 240.0))}
    (image,) = model.images
    assert (image.image_id, image.camera_id, image.name) == (4, 9, "x y.jpg")
    assert image.translation.tolist() == [1.0, 2.0, 3.0]
    assert image.observations.tolist() == [[5.5, -6.5]]
    assert image.point_ids.tolist() == [-1]
    assert model.points.point_ids.tolist() == [8, 11]
    assert model.points.positions.tolist() == [[1, 2, 3], [4, 5, 6]]
    assert model.points.colors.tolist() == [[10, 20, 30], [40, 50, 60]]
    assert model.points.errors.tolist() == [0.25, 0.5]


def test_text_with_comments_and_empty_observations_is_read(tmp_path: Path) -> None:
    (tmp_path / "cameras.txt").write_text("# comment\n\n  7 PINHOLE 640 480 500 501 320 240\r\n")
    images = ["# comment", "", "1 1 0 0 0 0 0 0 7 a b.jpg", "", "2 1 0 0 0 0 0 1 7 c.jpg", "1.5 2 -1 3 4 9"]
    images += ["3 1 0 0 0 0 0 1 7 d.jpg"]
    (tmp_path / "images.txt").write_text("\n".join(images))
    (tmp_path / "points3D.txt").write_text("# comment\n9 1 2 3 4 5 6 0.5 2 1\n")
    model = read_sparse_model(tmp_path)
    assert model.cameras[7].params == (500.0, 501.0, 320.0, 240.0)
    assert [image.name for image in model.images] == ["a b.jpg", "c.jpg", "d.jpg"]
    assert [len(image.point_ids) for image in model.images] == [0, 2, 0]
    assert model.images[1].point_ids.tolist() == [-1, 9]
    assert model.points.positions.tolist() == [[1, 2, 3]]


def test_binary_is_preferred_to_text(tmp_path: Path, odd_model: tuple) -> None:
    cameras, images, points = odd_model
    write_sparse_model(tmp_path, cameras, images, points)
    write_sparse_model(tmp_path, cameras, images[:1], points, text=True)
    assert len(read_sparse_model(tmp_path).images) == len(images)


def test_tracks_mirror_the_observations(odd_model: tuple) -> None:
    _, images, _ = odd_model
    seen = {(p, i.image_id, k) for i in images for k, p in enumerate(i.point_ids.tolist()) if p != -1}
    assert {(p, i, k) for p, track in point_tracks(images).items() for i, k in track} == seen


@pytest.mark.parametrize("place", ["sparse/0", "sparse", "."])
def test_the_sparse_model_is_found(write_capture: Callable[..., Path], place: str) -> None:
    folder = write_capture(sparse=place)
    assert find_sparse_model(folder) == folder / place
    assert find_sparse_model(folder / "images") is None


@pytest.mark.parametrize("part", ["cameras", "images", "points3D"])
def test_a_missing_part_is_named(tmp_path: Path, odd_model: tuple, part: str) -> None:
    write_sparse_model(tmp_path, *odd_model)
    (tmp_path / f"{part}.bin").unlink()
    with pytest.raises(MissingSparseModel, match=part):
        read_sparse_model(tmp_path)


@pytest.mark.parametrize("part", ["cameras", "images", "points3D"])
def test_every_truncation_of_a_binary_file_is_refused(tmp_path: Path, odd_model: tuple, part: str) -> None:
    write_sparse_model(tmp_path, *odd_model)
    file = tmp_path / f"{part}.bin"
    whole = file.read_bytes()
    for length in range(len(whole)):
        file.write_bytes(whole[:length])
        with pytest.raises(SceneError, match=rf"{part}\.bin.*truncated"):
            read_sparse_model(tmp_path)


@pytest.mark.parametrize("part", ["cameras", "images", "points3D"])
def test_absurd_counts_are_refused_before_memory_is_taken(
    tmp_path: Path, odd_model: tuple, part: str
) -> None:
    write_sparse_model(tmp_path, *odd_model)
    file = tmp_path / f"{part}.bin"
    file.write_bytes(b"\xff" * 8 + file.read_bytes()[8:])
    with pytest.raises(SceneError, match=part):
        read_sparse_model(tmp_path)


@pytest.mark.parametrize("part", ["cameras", "images", "points3D"])
def test_random_bytes_raise_only_our_errors(tmp_path: Path, odd_model: tuple, part: str) -> None:
    write_sparse_model(tmp_path, *odd_model)
    file = tmp_path / f"{part}.bin"
    whole = file.read_bytes()
    rng = np.random.default_rng(2)
    refused = 0
    for _ in range(200):
        damaged = np.frombuffer(whole, dtype=np.uint8).copy()
        damaged[rng.integers(len(damaged), size=8)] = rng.integers(256, size=8)
        file.write_bytes(damaged.tobytes())
        try:
            read_sparse_model(tmp_path)
        except CompGSError as error:
            assert str(tmp_path) in str(error)
            refused += 1
    assert refused > 0


@pytest.mark.parametrize(
    ("part", "line"),
    [
        ("cameras", "1 PINHOLE 640 480 500 501 320"),
        ("cameras", "one PINHOLE 640 480 500 501 320 240"),
        ("cameras", "1"),
        ("images", "1 1 0 0 0 0 0 0 1"),
        ("images", "1 1 0 0 zero 0 0 0 1 a.jpg"),
        ("images", "1 1 0 0 0 0 0 0 1 a.jpg\n1 2"),
        ("images", "1 1 0 0 0 0 0 0 1 a.jpg\n1 2 3.5"),
        ("points3D", "9 1 2 3 4 5"),
        ("points3D", "9 1 2 3 4 5 600 0.5"),
        ("points3D", "-9 1 2 3 4 5 6 0.5"),
        ("points3D", "\udcff\udcfe garbage"),
    ],
)
def test_garbage_in_text_is_named_by_file_and_line(
    tmp_path: Path, odd_model: tuple, part: str, line: str
) -> None:
    write_sparse_model(tmp_path, *odd_model, text=True)
    content = ("# comment\n" + line + "\n").encode("utf-8", errors="surrogateescape")
    (tmp_path / f"{part}.txt").write_bytes(content)
    with pytest.raises(SceneError, match=rf"{part}\.txt, line [23]"):
        read_sparse_model(tmp_path)


def test_unknown_camera_models_are_refused_with_the_command_that_helps(
    tmp_path: Path, odd_model: tuple
) -> None:
    write_sparse_model(tmp_path, *odd_model)
    (tmp_path / "cameras.bin").write_bytes(struct.pack("<QIiQQ3d", 1, 9, 99, 640, 480, 500.0, 320.0, 240.0))
    with pytest.raises(UnsupportedCamera, match=r"99.*colmap image_undistorter"):
        read_sparse_model(tmp_path)


def test_an_image_of_an_unknown_camera_is_named(tmp_path: Path, odd_model: tuple) -> None:
    cameras, images, points = odd_model
    write_sparse_model(tmp_path, cameras[1:], images, points)
    with pytest.raises(SceneError, match=r"a\.jpg.*camera 1"):
        read_sparse_model(tmp_path)


def test_a_model_without_points_is_read(tmp_path: Path, odd_model: tuple) -> None:
    cameras, images, points = odd_model
    none = ColmapPoints(points.point_ids[:0], points.positions[:0], points.colors[:0], points.errors[:0])
    for text in (False, True):
        write_sparse_model(tmp_path / str(text), cameras, images, none, text=text)
        assert read_sparse_model(tmp_path / str(text)).points.positions.shape == (0, 3)
