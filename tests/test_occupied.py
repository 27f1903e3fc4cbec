"""A folder that is written for minutes belongs to one process; a killed one is in nobody's way."""

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from compgs import occupied as room
from compgs.errors import OutputError
from compgs.occupied import occupied
from compgs.outputs import LOCK_NAME, check_output_folder

pytestmark = pytest.mark.skipif(room.fcntl is None, reason="this system has no such locks")

HOLD = """
import sys
from compgs.occupied import occupied
with occupied(sys.argv[1]):
    print("here", flush=True)
    sys.stdin.readline()
"""


@pytest.fixture(autouse=True)
def no_patience(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(room, "PATIENCE", 0.1)


@contextmanager
def somebody(folder: Path) -> Iterator["subprocess.Popen[str]"]:
    """Another process that has the folder until it is told to go on, or killed."""
    process = subprocess.Popen(
        [sys.executable, "-c", HOLD, str(folder)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None and process.stdin is not None
    assert process.stdout.readline() == "here\n"
    try:
        yield process
    finally:
        process.communicate("\n" if process.poll() is None else None)


def test_the_second_process_is_refused_and_told_which_the_first_is(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    with somebody(folder) as first, pytest.raises(OutputError) as refused, occupied(folder):
        pass
    assert str(refused.value).startswith(f"{folder}: another process is writing there: ")
    assert f"process {first.pid} on " in str(refused.value)
    with occupied(folder):
        pass


def test_a_killed_process_is_no_obstacle(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    with somebody(folder) as first:
        os.kill(first.pid, signal.SIGKILL)
        first.wait()
    assert [path.name for path in folder.iterdir()] == [LOCK_NAME]
    check_output_folder(folder)  # what it left does not count as content
    with occupied(folder):
        pass
    assert list(folder.iterdir()) == []


def test_another_name_for_the_folder_is_the_same_folder(tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    (tmp_path / "link").symlink_to("run")
    with somebody(tmp_path / "run"), pytest.raises(OutputError), occupied(tmp_path / "link"):
        pass


def test_other_folders_inside_and_beside_are_free(tmp_path: Path) -> None:
    with somebody(tmp_path / "run"), occupied(tmp_path / "run" / "blocks"), occupied(tmp_path / "other"):
        pass


def test_one_process_may_ask_again(tmp_path: Path) -> None:
    with occupied(tmp_path / "run"):
        with occupied(tmp_path / "run"):
            pass
        assert (tmp_path / "run" / LOCK_NAME).exists()  # the inner one has not let go of it


def test_folders_that_stay_empty_go_again_and_others_stay(tmp_path: Path) -> None:
    with occupied(tmp_path / "runs" / "one"):
        pass
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(ValueError, match="stop"), occupied(tmp_path / "runs" / "one"):
        (tmp_path / "runs" / "one" / "file").write_text("")
        raise ValueError("stop")
    assert [path.name for path in (tmp_path / "runs" / "one").iterdir()] == ["file"]


def test_a_folder_that_cannot_be_made_is_said(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with (
        pytest.raises(OutputError, match="file/run: cannot be written to"),
        occupied(tmp_path / "file" / "run"),
    ):
        pass


@pytest.mark.parametrize(
    "words",
    [
        ["train", "nowhere", "-o", "FOLDER", "--overwrite"],
        ["train", "-o", "FOLDER", "--resume"],
        ["tiles", "nowhere", "-o", "FOLDER", "--grid", "2x1"],
        ["reconstruct", "PHOTOS", "-o", "FOLDER"],
        ["demo-scene", "FOLDER"],
        ["compress", "GOLDEN", "-o", "FOLDER.cgs"],
        ["evaluate", "GOLDEN", "SCENE", "-o", "FOLDER"],
        ["compare", "GOLDEN", "GOLDEN", "-o", "FOLDER"],
        ["benchmark", "SUITE", "--data", "DATA", "-o", "FOLDER"],
    ],
    ids=" ".join,
)
def test_every_command_that_writes_a_folder_for_minutes_refuses_one_that_is_in_use(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    scene_folder: Path,
    words: list[str],
) -> None:
    from compgs.cli.main import main

    folder = tmp_path / ("out.run" if "compress" in words else "out")
    places = {
        "FOLDER": folder,
        "FOLDER.cgs": tmp_path / "out.cgs",
        "GOLDEN": Path(__file__).parent / "golden" / "tiny.cgs",
        "PHOTOS": scene_folder / "images",
        "SCENE": scene_folder,
        "SUITE": suite_of(scene_folder, tmp_path),
        "DATA": scene_folder.parent,
    }
    with somebody(folder) as first:
        assert main([str(places.get(word, word)) for word in words]) == 1
        assert f"process {first.pid} on " in capsys.readouterr().err
    assert not folder.exists()  # nothing was written


def suite_of(scene: Path, folder: Path) -> Path:
    """A suite of one short run."""
    path = folder / "suite.toml"
    scenes = f'[scenes.made]\npath = "{scene.name}"\n'
    path.write_text(f'title = "Short"\n[train]\nsteps = 1\n{scenes}[methods.short]\nmethod = "compgs"\n')
    return path


@pytest.fixture(scope="module")
def scene_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    from compgs.scene.generated import generate_scene

    folder = tmp_path_factory.mktemp("captures") / "scene"
    generate_scene(folder, views=3, width=32, height=24)
    return folder
