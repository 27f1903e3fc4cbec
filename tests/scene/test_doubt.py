"""A scene says whether its poses may be off by a pixel of the photographs as they are read."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from compgs.cli.cameras import say_cameras
from compgs.cli.ending import say_next
from compgs.scene import load_scene
from compgs.scene.colmap import read_sparse_model
from compgs.scene.colmap_writer import write_sparse_model


def with_error(folder: Path, pixels: float) -> Path:
    sparse = folder / "sparse" / "0"
    model = read_sparse_model(sparse)
    points = replace(model.points, errors=np.full(len(model.points.errors), pixels))
    write_sparse_model(sparse, model.cameras.values(), model.images, points)
    return folder


@pytest.mark.parametrize(
    ("pixels", "downscale", "doubt"), [(0.9, 1, ""), (1.4, 1, "1.4"), (1.4, 2, ""), (2.6, 2, "1.3")]
)
def test_the_mean_error_counts_in_pixels_of_the_photographs_as_they_are_read(
    write_capture: Callable[..., Path], pixels: float, downscale: int, doubt: str
) -> None:
    scene = load_scene(with_error(write_capture(), pixels), downscale=downscale)
    assert bool(scene.poses_in_doubt) == bool(doubt)
    assert doubt in scene.poses_in_doubt


def test_an_error_that_is_not_known_says_nothing(write_capture: Callable[..., Path]) -> None:
    assert load_scene(with_error(write_capture(), -1.0)).poses_in_doubt == ""


@pytest.mark.parametrize("content", ['{"video": false}', "[]", "no JSON", '{"photographs": 3}'])
def test_frames_of_a_video_are_in_doubt_and_nothing_else_that_a_report_says(
    write_capture: Callable[..., Path], content: str
) -> None:
    folder = write_capture()
    (folder / "reconstruction.json").write_text(content)
    assert load_scene(folder).poses_in_doubt == ""
    (folder / "reconstruction.json").write_text(json.dumps({"video": True}))
    assert "video" in load_scene(folder).poses_in_doubt


@pytest.mark.parametrize("report", ["reconstruction.json", "adjustment.json", "generated.json"])
def test_before_and_after_a_training_cameras_are_worth_adjusting_unless_they_are_this_programs(
    write_capture: Callable[..., Path], capsys: pytest.CaptureFixture[str], report: str
) -> None:
    folder = write_capture()
    say_cameras(folder)
    assert f"compgs adjust {folder} -o {folder}_adjusted" in capsys.readouterr().out
    say_next(folder / "scene.cgs", folder)
    assert f"next: compgs adjust {folder} -o {folder}_adjusted" in capsys.readouterr().out
    (folder / report).write_text("{}")
    say_cameras(folder)
    say_next(folder / "scene.cgs", folder)
    assert "adjust" not in capsys.readouterr().out
