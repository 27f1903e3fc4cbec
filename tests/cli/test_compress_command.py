"""`compgs compress` on the command line."""

from pathlib import Path

import pytest

from compgs.cli.main import main
from compgs.cli.sizes import parse_time
from compgs.cli.usage import UsageError


def outcome(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str, str]:
    code = main([str(a) for a in arguments])
    captured = capsys.readouterr()
    return code, captured.out, captured.err


@pytest.fixture
def ply(tmp_path: Path) -> Path:
    import numpy as np

    from compgs.formats import write_ply
    from compgs.model.splats import SplatArrays

    rng = np.random.default_rng(0)
    count = 150
    arrays = {
        "means": rng.normal(size=(count, 3)),
        "log_scales": np.full((count, 3), -2.0),
        "quaternions": rng.normal(size=(count, 4)),
        "opacity_logits": np.full(count, 2.0),
        "dc": rng.normal(size=(count, 3)),
        "rest": np.zeros((count, 0, 3)),
    }
    path = tmp_path / "cloud.ply"
    write_ply(SplatArrays(**{k: v.astype(np.float32) for k, v in arrays.items()}), path)
    return path


def test_a_table_shows_the_file_beside_others(
    capsys: pytest.CaptureFixture[str], ply: Path, tmp_path: Path
) -> None:
    output = tmp_path / "cloud.cgs"
    options = ["--steps", "4", "--views", "4", "--width", "32", "--set", "model.coupled_primitives=2"]
    code, out, err = outcome(capsys, "compress", ply, "-o", output, *options)
    assert (code, err) == (0, "")
    size = f"{output.stat().st_size:,}"
    row = next(line for line in out.splitlines() if line.startswith("cloud.cgs"))
    assert size in row and "dB" in row
    for name in ("cloud.ply", "as .spz", "as .sog"):
        assert any(line.startswith(name) for line in out.splitlines())
    assert (tmp_path / "cloud.run" / "results.json").is_file()

    code, out, err = outcome(capsys, "compress", "-o", output, "--resume")
    assert (code, err) == (0, "") and size in out


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("cloud.ply", "name it with -o"),
        ("-o out.cgs", "no splats were given"),
        ("cloud.ply -o out.cgs --time 5min --steps 9", "--time chooses the steps"),
        ("cloud.ply -o out.cgs --time soon", "--time soon: expected a time"),
        ("cloud.ply -o out.cgs --views 1", "--views 1: expected 2"),
        ("cloud.ply -o out.cgs --up 0 0 0", "--up (0.0, 0.0, 0.0): expected a direction"),
        ("-o out.cgs --resume --overwrite", "give one of them"),
        ("-o out.cgs --resume --views 9", "--views: --resume continues"),
        ("-o out.cgs --resume --steps 9", "training.steps=9: --resume continues"),
    ],
)
def test_what_makes_no_sense_is_a_usage_error(
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    ply: Path,
    tmp_path: Path,
    words: str,
    message: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    code, out, err = outcome(capsys, "compress", *words.split())
    assert (code, out) == (2, "")
    assert message in err and err.count("\n") <= 2
    assert list(tmp_path.iterdir()) == [ply]


def test_files_that_hold_no_splats_are_errors_of_one_line(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    text = tmp_path / "notes.txt"
    text.write_text("no splats")
    for file in (text, tmp_path / "missing.ply"):
        code, out, err = outcome(capsys, "compress", file, "-o", tmp_path / "out.cgs")
        assert (code, out) == (1, "") and err.startswith(f"error: {file}: ") and err.count("\n") == 1


@pytest.mark.parametrize(
    ("text", "seconds"),
    [("5min", 300), ("90s", 90), ("1.5h", 5400), ("1h30min", 5400), ("300", 300), (" 2 m 5 s ", 125)],
)
def test_times_as_people_type_them(text: str, seconds: float) -> None:
    assert parse_time(text, "--time") == seconds


@pytest.mark.parametrize("text", ["", "soon", "5 parsecs", "-5min", "0s", "5min!", "min"])
def test_other_times_are_refused(text: str) -> None:
    with pytest.raises(UsageError, match=r"^--time"):
        parse_time(text, "--time")
