"""Outputs are checked before work is done, and appear whole or not at all."""

import json
import os
import shutil
from collections import namedtuple
from pathlib import Path

import pytest

from compgs.errors import OutputError
from compgs.outputs import check_output_file, check_output_folder, write_bytes, write_json

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
