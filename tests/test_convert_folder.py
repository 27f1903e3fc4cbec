"""A folder of scenes is converted, and a table says what that saved: as in the image and in the action."""

import io
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from pathlib import Path

import pytest

from compgs.formats import write_ply
from compgs.model.splats import SplatArrays
from compgs.opening import open_scene

ROOT = Path(__file__).resolve().parent.parent
sys.path.append(str(ROOT / "tools"))
import convert_folder  # noqa: E402


@dataclass(frozen=True)
class Done:
    returncode: int
    stdout: str
    stderr: str


def convert(*arguments: object) -> Done:
    """The tool in this process. (The action's step, below, runs it in one of its own.)"""
    with redirect_stdout(io.StringIO()) as out, redirect_stderr(io.StringIO()) as err:
        try:
            code = convert_folder.main([str(argument) for argument in arguments])
        except SystemExit as end:
            code = int(end.code or 0)
    return Done(code, out.getvalue(), err.getvalue())


def rows(table: str) -> dict[str, list[str]]:
    """Cells of each row behind the first, by the first."""
    lines = [re.split(r"(?<!\\)\|", line)[1:-1] for line in table.splitlines()[2:]]
    return {cells[0].strip(): [cell.strip() for cell in cells[1:]] for cells in lines}


@pytest.fixture
def folder(tmp_path: Path, random_splats: Callable[..., SplatArrays], cgs_bytes: bytes) -> Path:
    """Two scenes, one of them in a folder of its own, and what is no scene."""
    scenes = tmp_path / "scenes"
    (scenes / "inner").mkdir(parents=True)
    (scenes / ".git").mkdir()
    write_ply(random_splats(), scenes / "a.ply")
    write_ply(random_splats(), scenes / ".git" / "hidden.ply")
    (scenes / "inner" / "b.cgs").write_bytes(cgs_bytes)
    (scenes / "notes.txt").write_text("no scene")
    return scenes


def test_every_scene_is_there_in_the_other_format_and_the_table_has_its_bytes(folder: Path) -> None:
    done = convert(folder, "-o", folder / "out", "--to", "spz")
    assert done.returncode == 0, done.stderr
    found = {path.relative_to(folder / "out") for path in (folder / "out").rglob("*") if path.is_file()}
    assert found == {Path("a.ply.spz"), Path("inner/b.cgs.spz")}
    table = rows(done.stdout)
    total = 0
    for name in ("a.ply", "inner/b.cgs"):
        written = folder / "out" / f"{name}.spz"
        before, after, share, psnr = table[name]
        assert int(before.replace(",", "")) == (folder / name).stat().st_size
        assert int(after.replace(",", "")) == written.stat().st_size
        assert float(share.split()[0]) == pytest.approx(
            100 * written.stat().st_size / (folder / name).stat().st_size, abs=0.06
        )
        assert float(psnr.split()[0]) > 15
        assert open_scene(written).counts
        total += written.stat().st_size
    assert int(table["**all**"][1].replace(",", "")) == total
    # What was written before is no scene to convert.
    again = convert(folder, "-o", folder / "out", "--to", "spz")
    assert again.stdout == done.stdout


def test_what_is_not_listed_is_left_out(folder: Path, tmp_path: Path) -> None:
    listed = tmp_path / "changed.txt"
    listed.write_text(f"{os.path.relpath(folder / 'a.ply')}\nREADME.md\n")
    done = convert(folder, "-o", tmp_path / "out", "--to", "sog", "--only", listed)
    assert set(rows(done.stdout)) == {"a.ply"}
    listed.write_text("README.md\n")
    done = convert(folder, "-o", tmp_path / "out", "--to", "sog", "--only", listed)
    assert done.returncode == 0 and done.stdout == "No scenes to convert to .sog.\n"


def test_a_file_that_is_no_scene_is_named_and_the_others_are_converted(folder: Path, tmp_path: Path) -> None:
    (folder / "a|<b>.ply").write_bytes(b"ply\nformat ascii 1.0\nend_header\n")
    done = convert(folder, "-o", tmp_path / "out", "--to", "glb")
    table = rows(done.stdout)
    assert done.returncode == 1 and "Traceback" not in done.stderr
    assert "expected" in table[r"a\|&lt;b>.ply"][1] or "no" in table[r"a\|&lt;b>.ply"][1]
    assert (tmp_path / "out" / "a.ply.glb").is_file() and len(table) == 4


def test_a_folder_that_is_not_there_is_one_line(tmp_path: Path) -> None:
    done = convert(tmp_path / "none", "-o", tmp_path / "out")
    assert done.returncode == 2 and "expected a folder of scenes" in done.stderr.splitlines()[-1]
    done = convert(tmp_path, "-o", tmp_path / "out", "--time", "soon")
    assert done.returncode == 2 and "--time soon: expected a time" in done.stderr.splitlines()[-1]


@pytest.mark.slow
def test_splats_become_cgs_files(folder: Path, tmp_path: Path) -> None:
    shutil.rmtree(folder / "inner")
    done = convert(folder, "-o", tmp_path / "out", "--to", "cgs", "--time", "5s")
    assert done.returncode == 0, done.stderr
    assert set(rows(done.stdout)) == {"a.ply"}
    assert open_scene(tmp_path / "out" / "a.ply.cgs").counts


@pytest.mark.slow
@pytest.mark.parametrize("listed", [True, False])
def test_the_step_of_the_action_leaves_its_table_where_the_comment_is_made_of_it(
    listed: bool, folder: Path, tmp_path: Path
) -> None:
    temporary = tmp_path / "runner"
    temporary.mkdir()
    if listed:
        (temporary / "changed.txt").write_text("scenes/a.ply\n")
    environment = {
        "FOLDER": "scenes",
        "TO": "spz",
        "TIME": "5min",
        "OUTPUT": "converted",
        "RUNNER_TEMP": str(temporary),
        "GITHUB_OUTPUT": str(tmp_path / "output"),
        "GITHUB_STEP_SUMMARY": str(tmp_path / "summary"),
        "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}",
    }
    command = ["bash", str(ROOT / "action" / "convert.sh")]
    done = subprocess.run(command, cwd=tmp_path, env=os.environ | environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    name, _, table = (tmp_path / "output").read_text().strip().partition("=")
    assert name == "table"
    assert set(rows(Path(table).read_text())) == (
        {"a.ply"} if listed else {"a.ply", "inner/b.cgs", "**all**"}
    )
    assert (tmp_path / "summary").read_text() == Path(table).read_text()
    assert (tmp_path / "converted" / "a.ply.spz").is_file()
