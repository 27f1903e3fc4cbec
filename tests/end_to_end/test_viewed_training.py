"""`compgs train --viewer`: the same run with somebody to look at it."""

import re
from pathlib import Path

import pytest

from compgs.cli.main import main

pytest.importorskip("viser")
OPTIONS = ["--preset", "quick", "--steps", "30", "--no-eval", "--device", "cpu"]


@pytest.mark.slow
def test_a_viewed_training_writes_the_same_file_and_says_where_to_look(
    scene_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["train", str(scene_folder), "-o", str(tmp_path / "a"), *OPTIONS]) == 0
    capsys.readouterr()
    viewer = ["--viewer", "--viewer-port", "0"]
    assert main(["train", str(scene_folder), "-o", str(tmp_path / "b"), *OPTIONS, *viewer]) == 0
    assert re.search(r"the scene as it grows: http://127\.0\.0\.1:\d+/\n", capsys.readouterr().out)
    assert (tmp_path / "a" / "a.cgs").read_bytes() == (tmp_path / "b" / "b.cgs").read_bytes()


def test_an_address_that_cannot_be_had_is_named_before_the_run_begins(
    scene_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = ["train", str(scene_folder), "-o", str(tmp_path / "a"), *OPTIONS, "--viewer"]
    assert main([*run, "--viewer-port", "70000"]) == 2
    assert "--viewer-port 70000: expected 0 to 65535" in capsys.readouterr().err
    assert main([*run, "--viewer-host", "192.0.2.1"]) == 2
    assert "--viewer-host 192.0.2.1 --viewer-port 8080: cannot be listened at" in capsys.readouterr().err
    assert not (tmp_path / "a").exists()
