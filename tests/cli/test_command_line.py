"""The command line explains itself, and says in one line what is wrong."""

import subprocess
import sys
from pathlib import Path

import pytest

from compgs import __version__
from compgs.cli.main import COMMANDS, command_name, main

GOLDEN_FILE = Path(__file__).parent.parent / "golden" / "tiny.cgs"
NAMES = [command_name(command) for command in COMMANDS]


def outcome(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str, str]:
    """Exit code, standard output, standard error."""
    code = main([str(a) for a in arguments])
    captured = capsys.readouterr()
    return code, captured.out, captured.err


def test_the_seven_commands_are_there() -> None:
    assert NAMES == ["train", "encode", "decode", "render", "evaluate", "info", "demo-scene"]


@pytest.mark.parametrize("arguments", [[], ["--help"], ["-h"]])
def test_help_lists_every_command(capsys: pytest.CaptureFixture[str], arguments: list[str]) -> None:
    code, out, err = outcome(capsys, *arguments)
    assert (code, err) == (0, "")
    for name in NAMES:
        assert f"  {name} " in out


@pytest.mark.parametrize("name", NAMES)
def test_each_command_explains_itself_with_an_example(capsys: pytest.CaptureFixture[str], name: str) -> None:
    code, out, _ = outcome(capsys, name, "--help")
    assert code == 0
    assert f"usage: compgs {name}" in out
    assert f"\ncompgs {name} " in out.partition("Example")[2]


def test_version(capsys: pytest.CaptureFixture[str]) -> None:
    assert outcome(capsys, "--version") == (0, f"compgs {__version__}\n", "")


def test_the_installed_command_and_the_module_are_the_same() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "compgs", "info", "nowhere.cgs"], capture_output=True, text=True, check=False
    )
    assert done.returncode == 1
    assert done.stderr == "error: nowhere.cgs: there is no such file\n"


@pytest.mark.parametrize(
    "arguments",
    [
        ["frobnicate"],
        ["train", "scene", "-o", "run", "--stpes", "3"],
        ["train", "scene", "-o", "run", "--steps", "many"],
        ["info"],
        ["train", "scene"],
        ["train", "-o", "run"],
        ["train", "scene", "-s", "other", "-o", "run"],
        ["train", "scene", "-o", "run", "--resume", "--overwrite"],
        ["train", "scene", "-o", "run", "--target-size", "small"],
        ["demo-scene", "scene", "--views", "1"],
        ["demo-scene", "scene", "--width", "4"],
    ],
    ids=" ".join,
)
def test_usage_errors_exit_with_2(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path, arguments: list[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    code, _, err = outcome(capsys, *arguments)
    assert code == 2
    assert err
    assert "Traceback" not in err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["train", "nowhere", "-o", "run"], "nowhere"),
        (["train", "nowhere", "-o", "run", "--preset", "best"], "default, paper, quick"),
        (["train", "nowhere", "-o", "run", "--set", "training.lmbda=-1"], "training.lmbda"),
        (["train", "nowhere", "-o", "run", "--set", "training.stepz=1"], "stepz"),
        (["train", "nowhere", "-o", "run", "--set", "steps"], "section.key=value"),
        (["train", "nowhere", "-o", "run", "--lmbda", "1e9"], "training.lmbda"),
        (["train", "nowhere", "-o", "full"], "overwrite"),
        (["train", "-o", "run", "--resume"], "run"),
        (["train", "-o", "full", "--resume"], "config.json"),
        (["train", "nowhere", "-o", "file"], "file"),
        (["encode", "nowhere"], "nowhere"),
        (["encode", "full", "-o", "file"], "overwrite"),
        (["encode", "empty", "-o", "out.cgs"], "checkpoint.safetensors"),
        (["encode", "nowhere.cgs", "--drop", "2", "-o", "out.cgs"], "drop = 2"),
        (["encode", "GOLDEN", "--coarser", "0.5", "-o", "out.cgs"], "coarser = 0.5"),
        (["encode", "GOLDEN", "--drop", "0.5", "-o", "file"], "overwrite"),
        (["encode", "file", "--drop", "0.5", "-o", "out.cgs"], "file: header"),
        (["decode", "nowhere.cgs"], "nowhere.cgs"),
        (["decode", "empty"], "folder"),
        (["decode", "file", "-o", "out"], "file: header"),
        (["decode", "GOLDEN", "-o", "full"], "overwrite"),
        (["render", "nowhere.cgs", "-o", "out"], "nowhere.cgs"),
        (["render", "file", "-o", "out"], "file: header"),
        (["render", "GOLDEN", "-o", "full"], "overwrite"),
        (["evaluate", "nowhere.cgs", "scene"], "nowhere.cgs"),
        (["evaluate", "file", "scene"], "file: header"),
        (["evaluate", "GOLDEN", "scene", "-o", "full"], "overwrite"),
        (["info", "empty"], "folder"),
        (["info", "file"], "file"),
        (["info", "full"], "full/run.cgs"),
        (["demo-scene", "full"], "overwrite"),
        (["demo-scene", "file"], "file"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_wrong_input_is_one_clear_line_and_nothing_is_written(
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    arguments: list[str],
    words: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "empty").mkdir()
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "run.cgs").write_bytes(b"precious")
    (tmp_path / "file").write_bytes(b"something else")
    (tmp_path / "GOLDEN").write_bytes(GOLDEN_FILE.read_bytes())
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}

    code, _, err = outcome(capsys, *arguments)

    assert code == 1
    assert err.startswith("error: ")
    assert err.count("\n") == 1
    assert words in err
    assert "Traceback" not in err
    after = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    assert after == before
    assert not (tmp_path / "run").exists()


def test_a_damaged_file_is_refused_before_the_scene_is_read(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    damaged = bytearray(GOLDEN_FILE.read_bytes())
    damaged[-1] ^= 1
    (tmp_path / "a.cgs").write_bytes(damaged)
    for command in ("evaluate", "render"):
        code, _, err = outcome(
            capsys, command, tmp_path / "a.cgs", tmp_path / "nowhere", "-o", tmp_path / "out"
        )
        assert code == 1
        assert "a.cgs: metadata: its checksum does not match" in err
        assert not (tmp_path / "out").exists()


def test_a_file_is_encoded_again_only_to_become_a_smaller_one(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    (tmp_path / "a.cgs").write_bytes(GOLDEN_FILE.read_bytes())
    code, _, err = outcome(capsys, "encode", tmp_path / "a.cgs", "-o", tmp_path / "b.cgs")
    assert code == 2 and "--drop" in err
    code, _, err = outcome(capsys, "encode", tmp_path / "a.cgs", "--drop", "0.5")
    assert code == 2 and "-o" in err
    assert [path.name for path in tmp_path.iterdir()] == ["a.cgs"]


def test_debug_shows_where_an_error_came_from(tmp_path: Path) -> None:
    with pytest.raises(Exception, match="there is no such file"):
        main(["info", str(tmp_path / "nowhere.cgs"), "--debug"])


def test_a_device_that_is_not_there_is_refused(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    (tmp_path / "a.cgs").write_bytes(GOLDEN_FILE.read_bytes())
    code, _, err = outcome(capsys, "decode", tmp_path / "a.cgs", "--device", "tpu")
    assert code == 2
    assert "cpu or cuda" in err
    code, _, err = outcome(capsys, "decode", tmp_path / "a.cgs", "--device", "cuda:99")
    assert code == 1
    assert "CUDA devices" in err


@pytest.mark.parametrize("threads", ["0", "100000"])
def test_thread_counts_that_are_not_there_are_refused(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, threads: str
) -> None:
    (tmp_path / "a.cgs").write_bytes(GOLDEN_FILE.read_bytes())
    code, _, err = outcome(capsys, "decode", tmp_path / "a.cgs", "--threads", threads)
    assert code == 2
    assert "expected 1 to" in err
