"""Cameras of a capture that were put wrong, adjusted, beside those that its photographs were computed with."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from compgs.cli.main import main
from compgs.errors import MissingSparseModel, OutputError, SceneError
from compgs.reconstruct import Adjusted, adjust
from compgs.reconstruct.adjust import carried, pairs_in_view
from compgs.scene import load_scene
from compgs.scene.colmap import ColmapCamera, ColmapImage, ColmapPoints, read_sparse_model
from compgs.scene.colmap_writer import write_sparse_model

from .conftest import FOCAL, SIZE, Walls  # type: ignore[import-not-found]

pytest.importorskip("pycolmap", reason="the extra `reconstruct` is not installed")

TURN, SHIFT, MOVE = 0.004, 0.012, 3.0  # radians; world units; pixels of principal points


def capture_of(walls: Walls, folder: Path, *, wrong: float) -> Path:
    """A COLMAP capture of the walls, without points; each photograph's camera is off by `wrong` times the above."""
    (folder / "images").mkdir(parents=True)
    chance, cameras, images = np.random.default_rng(3), [], []
    for number, (name, center) in enumerate(walls.centers.items(), start=1):
        shutil.copyfile(walls.folder / name, folder / "images" / name)
        turn = Rotation.from_rotvec(chance.normal(0, TURN * wrong, 3)).as_matrix() @ walls.rotations[name]
        center = center + chance.normal(0, SHIFT * wrong, 3)
        x, y, z, w = Rotation.from_matrix(turn).as_quat()
        lens = np.array([FOCAL, FOCAL, *(np.array(SIZE) / 2 + chance.normal(0, MOVE * wrong, 2))])
        cameras.append(ColmapCamera(number, "PINHOLE", *SIZE, tuple(lens.tolist())))
        nothing = np.zeros((0, 2)), np.zeros(0, np.int64)
        images.append(ColmapImage(number, np.array([w, x, y, z]), -turn @ center, number, name, *nothing))
    none = ColmapPoints(np.zeros(0, np.uint64), np.zeros((0, 3)), np.zeros((0, 3), np.uint8), np.zeros(0))
    write_sparse_model(folder / "sparse" / "0", cameras, images, none)
    return folder


@pytest.fixture(scope="module")
def adjusted(walls: Walls, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Adjusted]:
    folder = tmp_path_factory.mktemp("adjusted")
    source = capture_of(walls, folder / "given", wrong=1.0)
    return source, adjust(source, folder / "scene")


def off(folder: Path, walls: Walls) -> float:
    """Pixels: how far world points are from where the true cameras see them, the mean over points and photographs. The
    world may be turned, shifted and scaled to make it least, as nothing in photographs says where it is.
    """
    views = load_scene(folder, holdout=False).train_views
    grid = np.linspace(0.3, 2.5, 8)
    a, b = (each.ravel() for each in np.meshgrid(grid, grid))
    points = np.concatenate([np.roll(np.stack([0 * a, a, b], 1), shift, 1) for shift in range(3)])

    def seen(points: np.ndarray, turn: np.ndarray, center: np.ndarray, lens: np.ndarray) -> np.ndarray:
        there = (points - center) @ turn.T
        return there[:, :2] / there[:, 2:] * lens[:2] + lens[2:]

    lens = np.array([FOCAL, FOCAL, SIZE[0] / 2, SIZE[1] / 2])
    true = [seen(points, walls.rotations[view.name], walls.centers[view.name], lens) for view in views]

    def distances(similarity: np.ndarray) -> np.ndarray:
        moved = np.exp(similarity[6]) * Rotation.from_rotvec(similarity[:3]).apply(points) + similarity[3:6]
        cameras = [view.camera for view in views]
        here = [
            seen(moved, c.world_to_camera[:3, :3], c.center, np.array([c.fx, c.fy, c.cx, c.cy]))
            for c in cameras
        ]
        return (np.concatenate(here) - np.concatenate(true)).ravel()

    least = least_squares(distances, np.zeros(7))
    return float(np.hypot(*least.fun.reshape(-1, 2).T).mean())


def test_cameras_see_points_where_the_true_ones_do(adjusted: tuple[Path, Adjusted], walls: Walls) -> None:
    source, result = adjusted
    before, after = off(source, walls), off(result.scene, walls)
    assert before > 2.0
    assert after < 0.1 * before
    assert result.shift_after < 0.2 * result.shift_before
    assert result.error_after < 0.5 * result.error_before


def test_the_capture_is_whole_and_says_what_was_done(adjusted: tuple[Path, Adjusted], walls: Walls) -> None:
    source, result = adjusted
    told = json.loads((result.scene / "adjustment.json").read_text())
    model = read_sparse_model(result.scene / "sparse" / "0")
    assert told["points"] == result.points == len(model.points.positions) > 100
    assert {image.name for image in model.images} == set(walls.centers)
    assert not any("adjustment.json" in note for note in load_scene(result.scene, holdout=False).notes)
    assert [camera.model for camera in model.cameras.values()] == ["PINHOLE"] * len(walls.centers)
    for name in walls.centers:
        assert (result.scene / "images" / name).read_bytes() == (source / "images" / name).read_bytes()


def test_given_points_go_along_with_the_features_around_them() -> None:
    chance = np.random.default_rng(0)
    there = chance.uniform(-1, 1, (400, 3))
    now = there + np.where(there[:, :1] > 0, [[0.0, 0.1, 0.0]], [[0.0, 0.0, 0.2]])
    now[::10] += 5.0  # some were wrong
    points = np.array([[0.9, 0.0, 0.0], [-0.9, 0.3, 0.0]])
    assert carried(points, there, now) == pytest.approx(points + np.array([[0, 0.1, 0], [0, 0, 0.2]]))
    assert carried(points, there[:0], now[:0]) is points


def test_without_a_model_or_a_photograph_it_says_what_is_missing(walls: Walls, tmp_path: Path) -> None:
    with pytest.raises(MissingSparseModel, match="compgs reconstruct"):
        adjust(walls.folder, tmp_path / "scene")
    source = capture_of(walls, tmp_path / "given", wrong=0.0)
    (source / "images" / "photo_3.png").unlink()
    with pytest.raises(SceneError, match=r"photo_3\.png.* is missing"):
        adjust(source, tmp_path / "scene")
    assert not (tmp_path / "scene").exists()


def test_photographs_of_another_size_than_their_cameras_are_refused(walls: Walls, tmp_path: Path) -> None:
    source = capture_of(walls, tmp_path / "given", wrong=0.0)
    photograph = source / "images" / "photo_2.png"
    Image.open(photograph).resize((200, 150)).save(photograph)
    with pytest.raises(SceneError, match=r"photo_2\.png: is of 200 x 150 pixels, its camera of 400 x 300"):
        adjust(source, tmp_path / "scene")


def test_an_existing_capture_is_not_replaced_unasked(adjusted: tuple[Path, Adjusted]) -> None:
    source, result = adjusted
    with pytest.raises(OutputError, match="exists already"):
        adjust(source, result.scene)


def test_photographs_are_compared_with_near_ones_that_look_the_same_way(
    adjusted: tuple[Path, Adjusted],
) -> None:
    source, _ = adjusted
    pairs = pairs_in_view(read_sparse_model(source / "sparse" / "0"))
    assert all(0 <= first < second < 7 for first, second in pairs) and len(set(pairs)) == len(pairs)
    assert {(0, 1), (3, 4), (5, 6)} <= set(pairs)


@pytest.mark.slow
def test_the_command_line_says_what_came_of_it(
    walls: Walls, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source = capture_of(walls, tmp_path / "given", wrong=0.5)
    assert main(["adjust", str(source), "-o", str(tmp_path / "scene")]) == 0
    assert "common to parts of a photograph" in capsys.readouterr().out
    assert main(["adjust", str(tmp_path / "nowhere"), "-o", str(tmp_path / "other")]) == 1
