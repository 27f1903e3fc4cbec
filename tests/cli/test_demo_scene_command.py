"""`compgs demo-scene` replaces scenes, and nothing else."""

from pathlib import Path

import pytest

from compgs.cli.main import main
from compgs.scene import load_scene
from compgs.scene.doubt import cameras_from_elsewhere

SMALL = ["--views", "3", "--width", "32", "--height", "24"]


def test_the_scene_can_be_loaded_and_replaced_on_request(tmp_path: Path) -> None:
    folder = tmp_path / "scene"
    assert main(["demo-scene", str(folder), *SMALL]) == 0
    first = load_scene(folder)
    assert main(["demo-scene", str(folder), *SMALL, "--seed", "3"]) == 1
    assert main(["demo-scene", str(folder), *SMALL, "--seed", "3", "--overwrite"]) == 0
    second = load_scene(folder)
    assert first.train_views[0].image.shape == second.train_views[0].image.shape == (24, 32, 3)
    assert (first.train_views[0].image != second.train_views[0].image).any()
    assert [path.name for path in tmp_path.iterdir()] == ["scene"]
    assert not first.notes and not cameras_from_elsewhere(folder)  # its cameras are exact


def test_a_folder_that_holds_more_than_a_scene_is_never_removed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "thesis.txt").write_text("precious")
    assert main(["demo-scene", str(tmp_path), *SMALL, "--overwrite"]) == 1
    assert "thesis.txt" in capsys.readouterr().err
    assert (tmp_path / "thesis.txt").read_text() == "precious"


def test_photographs_of_somebody_are_never_removed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    photograph = tmp_path / "images" / "IMG_0001.JPG"
    photograph.parent.mkdir()
    (tmp_path / "sparse").mkdir()
    photograph.write_bytes(b"precious")
    assert main(["demo-scene", str(tmp_path), *SMALL, "--overwrite"]) == 1
    assert "IMG_0001.JPG" in capsys.readouterr().err
    assert photograph.read_bytes() == b"precious"
