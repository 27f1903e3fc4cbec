"""Arguments in each other's place, and a command after what it is to be done with: the line that was meant is said."""

import shutil
from pathlib import Path

import pytest

from compgs.cli.arguments import usage_of
from compgs.cli.main import main, parse
from compgs.cli.options import options_of
from compgs.cli.train import Train

GOLDEN_FILE = Path(__file__).parent.parent / "golden" / "tiny.cgs"


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """With a file `a b.cgs`, a capture `scene`, and photographs `photos`."""
    monkeypatch.chdir(tmp_path)
    shutil.copy(GOLDEN_FILE, tmp_path / "a b.cgs")
    (tmp_path / "scene" / "sparse" / "0").mkdir(parents=True)
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "one.jpg").write_bytes(b"")
    return tmp_path


@pytest.mark.parametrize(
    ("typed", "meant"),
    [
        ("evaluate|scene|a b.cgs", "compgs evaluate 'a b.cgs' scene"),
        ("render|scene|a b.cgs|-o|out", "compgs render 'a b.cgs' scene -o out"),
        ("export|new.spz|a b.cgs", "compgs export 'a b.cgs' new.spz"),
        ("compress|new.cgs|-o|a b.cgs", "compgs compress 'a b.cgs' -o new.cgs"),
        ("encode|small.cgs|-o|a b.cgs", "compgs encode 'a b.cgs' -o small.cgs"),
        ("train|run|-o|scene", "compgs train scene -o run"),
        ("compare|a b.cgs|scene|--scene|a b.cgs", None),  # the same word twice: nothing is guessed
        ("evaluate|nowhere.cgs|scene", None),
        ("export|nowhere.cgs|new.spz", None),
    ],
)
def test_exchanged_arguments_are_recognized(
    capsys: pytest.CaptureFixture[str], folder: Path, typed: str, meant: str | None
) -> None:
    before = sorted(folder.rglob("*"))
    assert main(typed.split("|")) in (1, 2)
    err = capsys.readouterr().err
    suggested = [line for line in err.splitlines() if line.startswith("did you mean: ")]
    assert suggested == ([] if meant is None else [f"did you mean: {meant}"])
    assert sorted(folder.rglob("*")) == before


def test_a_command_after_its_file_is_recognized(capsys: pytest.CaptureFixture[str], folder: Path) -> None:
    assert main(["a b.cgs", "info"]) == 2
    assert "did you mean compgs info 'a b.cgs'?" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("command", "usage"),
    [
        ("info", "usage: compgs info FILE|RUN [OPTIONS]"),
        ("train", "usage: compgs train SCENE -o RUN [OPTIONS]"),
        ("render", "usage: compgs render FILE|RUN [SCENE] -o FOLDER|MP4|WEBP|GIF [OPTIONS]"),
        ("serve", "usage: compgs serve [FOLDER] [OPTIONS]"),
        ("compress", "usage: compgs compress FILE -o OUT.cgs [OPTIONS]"),
    ],
)
def test_usage_lines_have_brackets_around_what_may_be_left_out(
    capsys: pytest.CaptureFixture[str], command: str, usage: str
) -> None:
    with pytest.raises(SystemExit):
        parse([command, "--help"])
    assert capsys.readouterr().out.splitlines()[0] == usage


def test_what_a_usage_line_asks_for_is_enough_to_be_parsed() -> None:
    assert usage_of("train", Train.asked_for, options_of(Train)).startswith(
        "usage: compgs train SCENE -o RUN"
    )
    assert parse(["train", "SCENE", "-o", "RUN"]) == Train(scene=Path("SCENE"), output=Path("RUN"))


def test_a_device_that_is_not_there_is_said_before_anything_else(
    capsys: pytest.CaptureFixture[str], folder: Path
) -> None:
    for typed in (
        ["evaluate", "nowhere.cgs"],
        ["render", "nowhere.cgs", "-o", "out"],
        ["view", "nowhere.cgs"],
    ):
        main([*typed, "--device", "cuda:99"])
        err = capsys.readouterr().err
        assert "--device cuda:99" in err and "nowhere" not in err
