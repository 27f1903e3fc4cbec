"""`compgs export`: what is said, and which mistakes are caught before anything is computed."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from compgs.cli.export import report
from compgs.cli.main import main
from compgs.exporting import Exported
from compgs.formats import encoded
from compgs.model.splats import SplatArrays
from compgs.opening import open_scene

ORIGIN = (0.0, 0.0, 0.0)


def outcome(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str, str]:
    code = main([str(a) for a in arguments])
    captured = capsys.readouterr()
    return code, captured.out, captured.err


def test_a_scene_is_written_and_its_loss_is_said(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, tiny_cgs: Path
) -> None:
    out = tmp_path / "a.spz"
    code, said, err = outcome(capsys, "export", tiny_cgs, out, "--degree", 1, "--refine", 2)
    assert (code, err) == (0, "")
    splats = open_scene(out).counts["splats"]
    assert f"({out.stat().st_size:,} bytes), {splats:,} splats of degree 1" in said
    assert "beside tiny.cgs: " in said and "dB from the worst of 24 cameras" in said


@pytest.mark.parametrize("version", [3, 4])
def test_the_version_of_an_spz_file_can_be_chosen(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, tiny_cgs: Path, version: int
) -> None:
    if version == 4:
        pytest.importorskip("zstandard")
    options = ["--spz-version", version, "--degree", 0, "--refine", 0]
    code, _, err = outcome(capsys, "export", tiny_cgs, tmp_path / "a.spz", *options)
    assert (code, err) == (0, "")
    assert (tmp_path / "a.spz").read_bytes().startswith(b"\x1f\x8b" if version == 3 else b"NGSP\x04")


@pytest.mark.parametrize("kind", ["ply", "spz", "sog"])
def test_the_least_size_that_is_named_is_enough_and_one_byte_less_is_not(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, tiny_cgs: Path, kind: str
) -> None:
    options = ["--degree", 0, "--refine", 0, "--max-bytes"]
    _, _, err = outcome(capsys, "export", tiny_cgs, tmp_path / f"a.{kind}", *options, 10)
    least = int(err.split("expected ")[1].split(" or more")[0])
    code, _, err = outcome(capsys, "export", tiny_cgs, tmp_path / f"a.{kind}", *options, least - 1)
    assert code == 2 and f"expected {least} or more" in err
    code, said, _ = outcome(capsys, "export", tiny_cgs, tmp_path / f"a.{kind}", *options, least)
    assert code == 0 and ", 1 splats of degree 0" in said
    assert (tmp_path / f"a.{kind}").stat().st_size <= least


def test_limits_are_kept_and_what_they_cost_is_said(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, tiny_cgs: Path
) -> None:
    out = tmp_path / "a.ply"
    options = ["--max-bytes", "10kB", "--degree", 0, "--refine", 0]
    code, said, _ = outcome(capsys, "export", tiny_cgs, out, *options)
    assert code == 0 and out.stat().st_size <= 10_000
    assert "splats were left out" in said
    code, _, _ = outcome(capsys, "export", tiny_cgs, out, "--max-splats", 10, "--degree", 0, "--overwrite")
    assert code == 0 and open_scene(out).counts == {"splats": 10}


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (["nowhere.cgs", "a.ply"], 1, "nowhere.cgs: there is no such file"),
        (["FILE", "a.splat"], 1, "a.splat: expected a name that ends in .ply"),
        (["FILE", "FILE"], 1, "expected a name that ends in"),
        (["FILE", "there.ply"], 1, "--overwrite"),
        (["FILE", "a.ply", "--degree", "4"], 2, "--degree 4: expected 0 to 3"),
        (["FILE", "a.ply", "--refine", "-1"], 2, "--refine -1"),
        (["FILE", "a.ply", "--max-splats", "0"], 2, "--max-splats 0"),
        (["FILE", "a.ply", "--max-bytes", "much"], 2, "--max-bytes much: expected a size"),
        (["FILE", "a.ply", "--max-bytes", "10", "--refine", "0"], 2, "--max-bytes 10: too few for any splat"),
        (
            ["FILE", "a.html", "--max-bytes", "3kB"],
            2,
            "--max-bytes 3000: a.html will hold the .cgs file as it is",
        ),
        (["FILE", "a.html", "--degree", "1"], 2, "--degree 1: a.html will hold"),
        (["FILE"], 2, "compgs export --help"),
    ],
)
def test_mistakes_are_one_clear_line_and_nothing_is_written(
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    tiny_cgs: Path,
    arguments: list[str],
    code: int,
    words: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("there.ply").touch()
    found, _, err = outcome(capsys, "export", *[str(tiny_cgs) if a == "FILE" else a for a in arguments])
    assert found == code
    assert err.startswith("error: ") and words in err
    assert sorted(path.name for path in tmp_path.iterdir()) == ["there.ply", "tiny.cgs"]


def test_a_report_says_what_was_lost_and_left_out() -> None:
    done = Exported(1_500_000, 2000, 2, 3000, (40.0, 44.0), (1000000.25, 0.5, 0.0))
    assert report(Path("a.cgs"), Path("b.sog"), done) == [
        "b.sog: 1.50 MB (1,500,000 bytes), 2,000 splats of degree 2",
        "beside a.cgs: 42.00 dB, 40.00 dB from the worst of 2 cameras, in pictures as large as its photographs",
        "3,000 of 5,000 splats were left out; a lower --degree leaves room for more of them",
        "note: positions count from 1000000.25 0.5 0: .sog has no place for that; .ply and .glb do",
    ]


def test_a_report_says_that_other_programs_draw_a_sharp_scene_softer() -> None:
    done = Exported(100, 20, 0, 0, (40.0,), ORIGIN, softer=True)
    assert (
        "note: other programs draw splats softer than a.cgs is"
        in report(Path("a.cgs"), Path("b.ply"), done)[-1]
    )


def test_a_report_says_that_fitting_was_left_out_where_there_was_something_to_fit(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, tiny_cgs: Path
) -> None:
    out, again = tmp_path / "a.ply", tmp_path / "b.ply"
    _, said, _ = outcome(capsys, "export", tiny_cgs, out, "--degree", 0, "--refine", 0)
    assert "note: the splats were not fitted to the scene's pictures; --refine 100" in said
    _, said, _ = outcome(capsys, "export", out, again, "--refine", 0)
    assert "not fitted" not in said
    _, said, _ = outcome(capsys, "export", tiny_cgs, out, "--degree", 0, "--refine", 1, "--overwrite")
    assert "not fitted" not in said


def test_a_lower_degree_is_not_advised_where_there_is_none() -> None:
    done = Exported(100, 20, 0, 30, (40.0,), ORIGIN)
    assert report(Path("a.cgs"), Path("b.ply"), done)[-1] == "30 of 50 splats were left out"


def test_a_report_of_equal_pictures_and_of_a_page() -> None:
    same = Exported(1000, 5, 3, 0, (float("inf"),) * 2, ORIGIN)
    assert report(Path("a.ply"), Path("b.ply"), same)[1] == "its pictures are those of a.ply, from 2 cameras"
    page = Exported(1000, None, None, 0, (), ORIGIN)
    assert report(Path("a.cgs"), Path("b.html"), page) == [
        "b.html: 1.0 kB, a page that shows a.cgs without anything else"
    ]


def test_what_is_left_out_of_a_file_of_splats_is_said_once(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, random_splats: Callable[..., SplatArrays]
) -> None:
    splats = random_splats()
    splats.means[3, 1] = np.nan
    source, out = tmp_path / "a.ply", tmp_path / "b.ply"
    source.write_bytes(encoded(splats, "ply"))
    code, said, err = outcome(capsys, "export", source, out)
    assert (code, err) == (0, "")
    lines = [line for line in said.splitlines() if line.startswith("note: ")]
    assert len(lines) == 1 and lines[0].startswith(f"note: {source}: 1 of 60 splats were left out")
    assert "59 splats" in said
