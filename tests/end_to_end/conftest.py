"""A generated scene that every run here is trained on."""

from pathlib import Path

import pytest

from compgs.cli.main import main


@pytest.fixture(scope="module")
def scene_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("data") / "scene"
    assert main(["demo-scene", str(folder), "--views", "40", "--width", "64", "--height", "48"]) == 0
    return folder
