"""Outputs are checked before work is done, and appear whole or not at all."""

import json
import os
import shutil
from collections import namedtuple
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from compgs.cli.main import main
from compgs.cli.usage import in_words_of_options
from compgs.errors import OutputError
from compgs.outputs import check_output_file, check_output_folder, filling, write_bytes, write_json

Usage = namedtuple("Usage", "total used free")


def test_an_existing_file_is_refused_and_kept(tmp_path: Path) -> None:
    file = tmp_path / "a.cgs"
    file.write_bytes(b"precious")
    with pytest.raises(OutputError, match="overwrite"):
        check_output_file(file)
    check_output_file(file, overwrite=True)
    assert file.read_bytes() == b"precious"


def test_a_folder_is_no_place_for_a_file(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="folder"):
        check_output_file(tmp_path, overwrite=True)


def test_a_folder_that_holds_something_is_refused(tmp_path: Path) -> None:
    (tmp_path / "x").touch()
    with pytest.raises(OutputError, match="not empty"):
        check_output_folder(tmp_path)
    check_output_folder(tmp_path, overwrite=True)


def test_checking_leaves_nothing_behind(tmp_path: Path) -> None:
    check_output_folder(tmp_path / "new" / "run")
    check_output_file(tmp_path / "new" / "a.cgs")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("check", [check_output_file, check_output_folder])
def test_a_file_in_the_way_is_named(tmp_path: Path, check) -> None:  # type: ignore[no-untyped-def]
    (tmp_path / "file").touch()
    with pytest.raises(OutputError, match=r"file"):
        check(tmp_path / "file" / "inside")


@pytest.mark.parametrize("check", [check_output_file, check_output_folder])
def test_a_full_disk_is_found_before_any_work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, check) -> None:  # type: ignore[no-untyped-def]
    monkeypatch.setattr(shutil, "disk_usage", lambda _: Usage(10**9, 10**9, 1000))
    with pytest.raises(OutputError, match="full"):
        check(tmp_path / "new")


def test_a_folder_that_cannot_be_written_to_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr("tempfile.TemporaryFile", refuse)
    with pytest.raises(OutputError, match="Permission denied"):
        check_output_folder(tmp_path / "run")


def test_a_failed_write_keeps_the_old_file_and_no_remains(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "results.json"
    write_json(file, {"psnr": 1.5})

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", full)
    with pytest.raises(OutputError, match=r"results\.json.*No space left"):
        write_bytes(file, b"half of it")
    assert json.loads(file.read_text()) == {"psnr": 1.5}
    assert [p.name for p in tmp_path.iterdir()] == ["results.json"]


@pytest.fixture(params=["bytes", "checkpoint"])
def write(request: pytest.FixtureRequest) -> Callable[[Path], None]:
    """Both ways of writing a file."""
    if request.param == "bytes":
        return lambda path: write_bytes(path, b"new")
    from compgs.training.run.checkpoint import write_checkpoint_file

    return lambda path: write_checkpoint_file(
        path, "compgs", {"a": torch.zeros(3)}, {}, device=torch.device("cpu")
    )


def test_temporary_names_cannot_be_foreseen_and_no_link_is_followed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, write: Callable[[Path], None]
) -> None:
    names: list[str] = []
    real = os.replace
    monkeypatch.setattr(os, "replace", lambda a, b: (names.append(Path(a).name), real(a, b)))
    file, victim = tmp_path / "a.cgs", tmp_path / "victim"
    victim.write_bytes(b"precious")
    for planted in ("a.cgs.partial", ".a.cgs.partial"):
        (tmp_path / planted).symlink_to(victim)
    write(file)
    write(file)
    assert len(set(names)) == 2 and all(name.startswith(".a.cgs.") for name in names)
    assert victim.read_bytes() == b"precious"


def test_even_a_foreseen_link_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, write: Callable[[Path], None]
) -> None:
    victim = tmp_path / "victim"
    victim.write_bytes(b"precious")
    monkeypatch.setattr("secrets.token_hex", lambda _: "0" * 16)
    (tmp_path / f".a.cgs.{'0' * 16}.partial").symlink_to(victim)
    with pytest.raises(OutputError, match=r"a\.cgs"):
        write(tmp_path / "a.cgs")
    assert victim.read_bytes() == b"precious"
    assert not (tmp_path / "a.cgs").exists()


@pytest.mark.parametrize(("umask", "mode"), [(0o022, 0o644), (0o007, 0o660)])
def test_written_files_are_readable_for_whom_the_umask_says(
    tmp_path: Path, write: Callable[[Path], None], umask: int, mode: int
) -> None:
    before = os.umask(umask)
    try:
        write(tmp_path / "a.cgs")
    finally:
        os.umask(before)
    assert (tmp_path / "a.cgs").stat().st_mode & 0o777 == mode


def test_an_interrupted_write_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, write: Callable[[Path], None]
) -> None:
    def stopped(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "replace", stopped)
    with pytest.raises(KeyboardInterrupt):
        write(tmp_path / "a.cgs")
    assert list(tmp_path.iterdir()) == []


def test_names_that_are_not_text_survive_json(tmp_path: Path) -> None:
    name = os.fsdecode(b"caf\xe9 \xc3\xbc.jpg")
    write_json(tmp_path / "a.json", {"name": name})
    assert json.loads((tmp_path / "a.json").read_text(encoding="utf-8")) == {"name": name}


def test_python_is_told_which_argument_to_give_and_a_terminal_which_option(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "x").touch()
    for check, place in ((check_output_file, tmp_path / "x"), (check_output_folder, tmp_path)):
        with pytest.raises(OutputError, match=r"or give overwrite=True$"):
            check(place)
    assert in_words_of_options("training.target_bytes = 1: too few") == "--target-size 1: too few"
    assert main(["demo-scene", str(tmp_path)]) == 1
    assert capsys.readouterr().err.endswith("choose another folder or give --overwrite\n")


def test_a_folder_is_filled_when_everything_is_there_and_not_before(tmp_path: Path) -> None:
    folder = tmp_path / "new" / "folder"
    with filling(folder) as place:
        write_bytes(place / "a" / "00000.png", b"1")
        write_bytes(place / "b.json", b"2")
        assert not folder.exists()
    found = {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    assert found == {"a/00000.png": b"1", "b.json": b"2"}
    assert [path.name for path in folder.parent.iterdir()] == ["folder"]


def test_what_is_filled_anew_keeps_other_files_but_no_pictures_of_before(tmp_path: Path) -> None:
    names = ("a/00000.png", "a/00007.png", "a/notes.png", "other/00003.png", "b.json")
    for name in names:
        write_bytes(tmp_path / "out" / name, b"old")
    with filling(tmp_path / "out") as place:
        write_bytes(place / "a" / "00000.png", b"new")
        write_bytes(place / "b.json", b"new")
    found = {
        name: (tmp_path / "out" / name).read_bytes() for name in names if (tmp_path / "out" / name).exists()
    }
    assert found == {
        "a/00000.png": b"new",
        "a/notes.png": b"old",
        "other/00003.png": b"old",
        "b.json": b"new",
    }


def test_a_block_that_fails_leaves_a_folder_as_it_was_with_its_own_error(tmp_path: Path) -> None:
    write_bytes(tmp_path / "out" / "b.json", b"old")
    with pytest.raises(FileNotFoundError), filling(tmp_path / "out") as place:
        write_bytes(place / "b.json", b"new")
        (tmp_path / "nowhere").read_bytes()
    assert (tmp_path / "out" / "b.json").read_bytes() == b"old"
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_a_folder_that_cannot_be_filled_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(OutputError, match=r"file/out: cannot be written"), filling(tmp_path / "file" / "out"):
        pass
    (tmp_path / "out" / "a.json").mkdir(parents=True)
    with pytest.raises(OutputError, match=r"out: cannot be written"), filling(tmp_path / "out") as place:
        write_bytes(place / "a.json", b"new")
