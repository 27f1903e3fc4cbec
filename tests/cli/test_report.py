"""`compgs report`: what is written and left out is said; mistakes are caught before anything is written."""

import json
from pathlib import Path

import pytest

from compgs.cli.main import main

RESULTS = {
    "schema": "compgs results 1", "scene": "garden", "file": "a.cgs", "width": 8, "height": 6, "psnr": 28.5,
    "ssim": 0.9, "bytes": 1234, "components": {"positions": 1234}, "decode_seconds": 0.1, "render_seconds": 0.1,
}  # fmt: skip


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Folder of an evaluation, in the present folder."""
    monkeypatch.chdir(tmp_path)
    folder = Path("runs", "a")
    folder.mkdir(parents=True)
    (folder / "results.json").write_text(json.dumps(RESULTS))
    return folder


def outcome(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str, str]:
    code = main([str(a) for a in arguments])
    captured = capsys.readouterr()
    return code, captured.out, captured.err


def test_the_page_its_tables_and_what_is_left_out_are_said(
    capsys: pytest.CaptureFixture[str], run: Path
) -> None:
    (run.parent / "b").mkdir()
    code, said, err = outcome(capsys, "report", run, run.parent / "b", "-o", "out/r.html", "--title", "Mine")
    assert (code, err) == (0, "")
    page = Path("out/r.html").read_text()
    assert "<h1>Mine</h1>" in page and "1,234" in page
    assert "out/r.html: " in said and "runs: 1, scenes: 1" in said
    assert "beside it: r_results.csv, r_components.csv, r.md, r.tex" in said
    assert "note: runs/b: no results.json" in said and "note: no pictures: a" in said


def test_folders_of_runs_are_taken_too(capsys: pytest.CaptureFixture[str], run: Path) -> None:
    assert outcome(capsys, "report", "runs", "-o", "r.html")[0] == 0
    code, _, err = outcome(capsys, "report", "runs", "-o", "r.html")
    assert code == 1 and "--overwrite" in err
    assert outcome(capsys, "report", "runs", "-o", "r.html", "--overwrite")[0] == 0


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (["nowhere", "-o", "r.html"], 1, "nowhere: does not exist; expected the folder of a run"),
        (["empty", "-o", "r.html"], 1, "there are no runs to report on; empty: no results.json"),
        (["-o", "r.html"], 2, "no run was given"),
        (["runs"], 2, "--output PAGE.html is missing"),
        (["runs", "-o", "r.pdf"], 1, "r.pdf: expected a name that ends in .html"),
        (["runs", "-o", "r.html", "--views", "-1"], 2, "--views -1: expected 0 to 1000"),
        (["runs", "-o", "r.html", "--reference", "best"], 2, "--reference 'best': no run is of that method"),
    ],
)
def test_mistakes_are_one_clear_line_and_nothing_is_written(
    capsys: pytest.CaptureFixture[str], run: Path, arguments: list[str], code: int, words: str
) -> None:
    Path("empty").mkdir()
    found, _, err = outcome(capsys, "report", *arguments)
    assert found == code
    assert err.startswith("error: ") and words in err
    assert sorted(path.name for path in Path().iterdir()) == ["empty", "runs"]
