"""What a scene's folder says is done; what of it is not used is said."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from compgs.cameras import Camera
from compgs.errors import SceneError
from compgs.scene import load_scene
from compgs.scene.capture import PosedImage
from compgs.scene.colmap import count_images
from compgs.scene.split_names import split_by_names

Write = Callable[..., Path]
NAMES = [f"images/{i}.png" for i in range(6)]


def split(**lists: Any) -> tuple[list[str], set[str] | None, tuple[str, ...]]:
    camera = Camera(np.eye(4), 20.0, 20.0, 12.0, 8.0, 24, 16)
    used, held_out, notes = split_by_names([PosedImage(n, Path(n), camera) for n in NAMES], lists, "file")
    return [image.name for image in used], None if held_out is None else set(held_out), notes


def test_without_lists_the_file_says_nothing_of_the_split() -> None:
    assert split() == (NAMES, None, ())


def test_lists_of_training_and_test_frames_are_the_split() -> None:
    assert split(train_filenames=NAMES[:4], test_filenames=NAMES[4:]) == (NAMES, set(NAMES[4:]), ())
    same = [f"./{name}".replace("/", "\\") for name in NAMES[4:]]
    assert split(train_filenames=NAMES[:4], test_filenames=same)[1] == set(NAMES[4:])


def test_validation_frames_are_held_out_too() -> None:
    lists = {"train_filenames": NAMES[:4], "val_filenames": NAMES[4:5], "test_filenames": NAMES[5:]}
    assert split(**lists)[1] == set(NAMES[4:])
    assert split(val_filenames=NAMES[:1])[1] == set(NAMES[:1])


def test_with_training_frames_alone_the_others_are_held_out() -> None:
    assert split(train_filenames=NAMES[2:]) == (NAMES, set(NAMES[:2]), ())


def test_frames_in_no_list_are_left_out_and_counted() -> None:
    used, held_out, (note,) = split(train_filenames=NAMES[:3], test_filenames=NAMES[5:])
    assert used == [*NAMES[:3], NAMES[5]] and held_out == {NAMES[5]}
    assert note == "train_filenames, test_filenames: 2 frames are not named, and left out"


def test_what_is_trained_on_and_held_out_is_held_out_and_said() -> None:
    used, held_out, (note,) = split(train_filenames=NAMES, test_filenames=NAMES[:2])
    assert used == NAMES and held_out == set(NAMES[:2])
    assert "2 frames are named as trained on and as held out" in note


def test_names_of_no_frame_are_said() -> None:
    _, held_out, notes = split(test_filenames=[NAMES[0], "images/none.png"])
    assert held_out == {NAMES[0]}
    assert notes == ("test_filenames: of 1 names there is no frame, such as 'images/none.png'",)
    assert "no frame is held out" in split(test_filenames=[])[2][0]


@pytest.mark.parametrize("names", ["images/0.png", {"a": 1}, [1], 7])
def test_lists_that_are_none_are_refused(names: Any) -> None:
    with pytest.raises(SceneError, match="file: test_filenames is"):
        split(test_filenames=names)


def as_nerfstudio(folder: Path, **values: Any) -> Path:
    """The capture with its poses in transforms.json."""
    scene = load_scene(folder)
    frames = []
    for view in sorted(scene.train_views + scene.test_views, key=lambda view: view.name):
        matrix = np.linalg.inv(view.camera.world_to_camera) @ np.diag([1.0, -1, -1, 1])
        frames.append({"file_path": f"images/{view.name}", "transform_matrix": matrix.tolist()})
    shared = {"w": 24, "h": 16, "fl_x": 20.0, "fl_y": 21.0, "cx": 12.5, "cy": 8.25}
    (folder / "transforms.json").write_text(json.dumps({**shared, **values, "frames": frames}))
    shutil.rmtree(folder / "sparse")
    return folder


def test_a_scene_is_split_as_its_file_says(write_capture: Write) -> None:
    held_out = ["images/03.png", "images/05.png"]
    folder = as_nerfstudio(write_capture(), test_filenames=held_out)
    scene = load_scene(folder)
    assert [view.name for view in scene.test_views] == held_out and len(scene.train_views) == 8
    assert len(load_scene(folder, holdout=False).train_views) == 10


def test_points_that_are_named_and_not_there_are_said(write_capture: Write) -> None:
    folder = as_nerfstudio(write_capture(), ply_file_path="sparse.ply")
    assert any("sparse.ply does not exist" in note for note in load_scene(folder).notes)
    (folder / "transforms.json").write_text(
        (folder / "transforms.json").read_text().replace('"sparse.ply"', "7")
    )
    with pytest.raises(SceneError, match="ply_file_path is 7"):
        load_scene(folder)


def test_photographs_that_were_not_registered_are_counted(write_capture: Write) -> None:
    folder = write_capture()
    shutil.copy(folder / "images" / "00.png", folder / "images" / "late.JPG")
    (folder / "images" / "readme.txt").touch()
    assert load_scene(folder).notes == (
        "images/: 1 photograph has no pose and will not be used, such as late.JPG",
    )
    (folder / "images" / "more").mkdir()
    (folder / "images" / "more" / "a.HEIC").touch()
    assert "2 photographs have no pose" in load_scene(folder).notes[0]


@pytest.mark.parametrize("text", [False, True])
def test_a_larger_model_beside_the_one_that_is_read_is_said(write_capture: Write, text: bool) -> None:
    names = [f"{i:02d}.png" for i in range(10)]
    write_capture(names, sparse="sparse/1", text=text)
    folder = write_capture(names[:7], text=text)
    assert (count_images(folder / "sparse" / "0"), count_images(folder / "sparse" / "1")) == (7, 10)
    assert (
        "sparse/0 is read, with 7 images; sparse/1 has 10: to use that one, swap the two folders' names"
        in load_scene(folder).notes
    )
    shutil.rmtree(folder / "sparse" / "1")
    write_capture(names[:3], sparse="sparse/1", text=text)
    assert not any("swap" in note for note in load_scene(folder).notes)
    (folder / "sparse" / "2").mkdir()
    assert "not used: sparse/1/, sparse/2/" in load_scene(folder).notes
