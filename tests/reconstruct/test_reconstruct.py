"""From photographs to poses: compared with the poses the photographs were computed from."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from compgs.cli.main import main
from compgs.errors import ConfigError, MissingDependency, OutputError, SceneError
from compgs.reconstruct import Reconstruction, ReconstructOptions, reconstruct
from compgs.scene import load_scene

from .conftest import FOCAL, Walls  # type: ignore[import-not-found]

pytest.importorskip("pycolmap", reason="the extra `reconstruct` is not installed")


@pytest.fixture(scope="module")
def found(walls: Walls, tmp_path_factory: pytest.TempPathFactory) -> Reconstruction:
    stages = []
    folder = tmp_path_factory.mktemp("found") / "scene"
    result = reconstruct(walls.folder, folder, progress=lambda stage, done, total: stages.append(stage))
    assert list(dict.fromkeys(stages)) == ["features", "matching", "mapping"]
    return result


def aligned(found: np.ndarray, given: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Centers [V, 3] brought onto the given ones by the best similarity (Umeyama 1991), and its rotation."""
    a, b = found - found.mean(0), given - given.mean(0)
    u, s, vt = np.linalg.svd(b.T @ a)
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    rotation = (u * sign) @ vt
    scale = (s * sign).sum() / (a**2).sum()
    return scale * a @ rotation.T + given.mean(0), rotation


def test_poses_and_focal_length_are_those_the_photographs_were_computed_from(
    walls: Walls, found: Reconstruction
) -> None:
    scene = load_scene(found.scene, holdout=False)
    assert found.registered == found.photographs == len(walls.centers) == len(scene.train_views)
    given = np.stack([walls.centers[view.name] for view in scene.train_views])
    centers, turn = aligned(np.stack([view.camera.center for view in scene.train_views]), given)
    # Two percent of the distance to the scene, a degree, three percent of the focal length
    assert np.linalg.norm(centers - given, axis=1).max() < 0.02 * 4.5
    for view in scene.train_views:
        between = view.camera.world_to_camera[:3, :3] @ turn.T @ walls.rotations[view.name].T
        assert np.degrees(np.arccos(np.clip((np.trace(between) - 1) / 2, -1, 1))) < 1.0
        assert view.camera.fx == pytest.approx(FOCAL, rel=0.03)


def test_the_report_says_what_the_model_holds(found: Reconstruction) -> None:
    told = json.loads((found.scene / "reconstruction.json").read_text())
    scene = load_scene(found.scene, holdout=False)
    assert told["points"] == found.points == len(scene.points.positions)
    assert told["registered"] == len(scene.train_views) and told["missing"] == []
    assert 0 < found.reprojection_error < 2
    assert found.observations > 20
    assert Image.open(found.scene / "reconstruction.png").size == (960, 480)


def test_an_existing_scene_is_not_replaced_unasked(walls: Walls, found: Reconstruction) -> None:
    with pytest.raises(OutputError, match="exists already"):
        reconstruct(walls.folder, found.scene)


def test_photographs_that_cannot_be_joined_leave_nothing_behind(tmp_path: Path) -> None:
    photos = tmp_path / "photos"
    photos.mkdir()
    for index in range(3):
        noise = np.random.default_rng(index).integers(0, 256, (60, 80, 3), dtype=np.uint8)
        Image.fromarray(noise).resize((160, 120)).save(photos / f"{index}.png")
    with pytest.raises(SceneError, match="no two of its 3 photographs could be joined"):
        reconstruct(photos, tmp_path / "scene")
    assert [path.name for path in tmp_path.iterdir()] == ["photos"]


@pytest.mark.slow
@pytest.mark.parametrize("others", [0, 3])
def test_few_photographs_that_are_joined_are_warned_of(
    walls: Walls, tmp_path: Path, capsys: pytest.CaptureFixture[str], others: int
) -> None:
    photos = tmp_path / "photos"
    shutil.copytree(walls.folder, photos)
    for index in range(others):
        noise = np.random.default_rng(index).integers(0, 256, (60, 80, 3), dtype=np.uint8)
        Image.fromarray(noise).resize((400, 300)).save(photos / f"zz_{index}.png")
    words = ["reconstruct", str(photos), "-o", str(tmp_path / "scene"), "--features", "600"]
    assert main(words) == 0
    captured = capsys.readouterr()
    told = " ".join((captured.out + captured.err).split())
    count = len(walls.centers)
    assert f"{count} of {count + others} photographs have a pose" in told
    assert ("warning: only 7 of 10 photographs have a pose" in told) == (others == 3)
    assert ("--features 8192 may join more" in told) == (others == 3)


@pytest.mark.slow
def test_pinhole_images_come_out_where_they_are_asked_for(walls: Walls, tmp_path: Path) -> None:
    result = reconstruct(walls.folder, tmp_path / "scene", ReconstructOptions(undistort=True, features=800))
    told = json.loads((result.scene / "reconstruction.json").read_text())
    assert {camera["model"] for camera in told["cameras"]} == {"PINHOLE"}
    scene = load_scene(result.scene, holdout=False)
    assert len(scene.train_views) == result.registered
    assert scene.train_views[0].image.shape[:2] == (told["cameras"][0]["height"], told["cameras"][0]["width"])


def test_without_pycolmap_the_remedy_is_said_before_anything_is_done(
    walls: Walls, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(MissingDependency, match=r"pip install '.\[reconstruct\]'"):
        reconstruct(walls.folder, tmp_path / "scene")
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize("options", [{"lens": "FISHEYE"}, {"overlap": 0}, {"frames": 2}, {"features": 1}])
def test_options_out_of_range_are_refused(options: dict[str, object], walls: Walls, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=f"{next(iter(options))} .*expected"):
        reconstruct(walls.folder, tmp_path / "scene", ReconstructOptions(**options))  # type: ignore[arg-type]


@pytest.mark.slow
def test_photographs_that_look_alike_are_joined_as_if_all_had_been_compared(
    walls: Walls, found: Reconstruction, tmp_path: Path
) -> None:
    """Names with spaces, which lists of pairs cannot hold, stay as they are."""
    photographs = tmp_path / "photographs"
    photographs.mkdir()
    for path in walls.folder.iterdir():
        (photographs / path.name.replace("_", " ")).write_bytes(path.read_bytes())
    result = reconstruct(photographs, tmp_path / "scene", ReconstructOptions(matching="retrieval"))
    assert result.matching == "retrieval" and result.registered == found.registered == 7
    assert result.points > 0.8 * found.points
    names = {view.name for view in load_scene(tmp_path / "scene", holdout=False).train_views}
    assert names == {path.name for path in photographs.iterdir()}
