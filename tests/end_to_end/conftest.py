"""A generated scene that every run here is trained on."""

from pathlib import Path

import pytest

from compgs.cli.main import main


@pytest.fixture(scope="module")
def scene_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    # Each pruning renders all training views: more of them would be most of a run's time.
    folder = tmp_path_factory.mktemp("data") / "scene"
    assert main(["demo-scene", str(folder), "--views", "16", "--width", "64", "--height", "48"]) == 0
    return folder
