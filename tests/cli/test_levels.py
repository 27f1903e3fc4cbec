"""`--level`: which level of detail of a streamed .sog a command opens."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from compgs.cli.main import main
from compgs.formats import SplatArrays, read_ply, sog


def splats(count: int, seed: int) -> SplatArrays:
    draw = np.random.default_rng(seed).normal
    shapes = (count, 3), (count, 3), (count, 4), (count,), (count, 3), (count, 3, 3)
    arrays = SplatArrays(*(draw(size=shape).astype(np.float32) for shape in shapes))
    return replace(arrays, log_scales=arrays.log_scales / 4 - 2)


@pytest.fixture
def streamed(tmp_path: Path) -> Path:
    """300 splats, and 40 at the coarser level."""
    lods = {}
    for level, count in enumerate((300, 40)):
        (tmp_path / f"{level}.sog").write_bytes(sog.encoded(splats(count, level)))
        lods[str(level)] = {"file": level, "offset": 0, "count": count}
    meta = {"lodLevels": 2, "filenames": ["0.sog", "1.sog"], "tree": {"lods": lods}}
    path = tmp_path / "lod-meta.json"
    path.write_text(json.dumps(meta))
    return path


@pytest.mark.parametrize(("options", "count"), [([], 300), (["--level", "0"], 300), (["--level", "1"], 40)])
def test_export_writes_the_level_that_is_asked_for(
    streamed: Path, tmp_path: Path, options: list[str], count: int
) -> None:
    assert main(["export", str(streamed), str(tmp_path / "a.ply"), *options]) == 0
    assert len(read_ply(tmp_path / "a.ply")) == count


def test_render_draws_the_level_that_is_asked_for(streamed: Path, tmp_path: Path) -> None:
    fine, coarse = tmp_path / "fine", tmp_path / "coarse"
    options = ["--frames", "1", "--width", "32", "--height", "24"]
    assert main(["render", str(streamed), "-o", str(fine), *options]) == 0
    assert main(["render", str(streamed), "-o", str(coarse), "--level", "1", *options]) == 0
    pictures = [next(folder.glob("*.png")).read_bytes() for folder in (fine, coarse)]
    assert pictures[0] != pictures[1]


@pytest.mark.parametrize(
    ("name", "level", "message"),
    [
        ("lod-meta.json", "2", "level 2: expected 0, the finest, to 1, the coarsest"),
        ("0.sog", "0", "--level is for scenes of several levels (lod-meta.json)"),
    ],
)
def test_a_level_that_is_not_there_is_a_message(
    streamed: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str, level: str, message: str
) -> None:
    assert main(["export", str(streamed.parent / name), str(tmp_path / "a.ply"), "--level", level]) != 0
    assert message in " ".join(capsys.readouterr().err.split())


def test_compress_learns_the_level_that_is_asked_for(
    streamed: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    output = tmp_path / "coarse.cgs"
    options = ["--steps", "4", "--views", "4", "--width", "32", "--set", "model.coupled_primitives=2"]
    assert main(["compress", str(streamed), "-o", str(output), "--level", "1", *options]) == 0
    assert "40 splats" in capsys.readouterr().out
    told = json.loads((tmp_path / "coarse.run" / "results.json").read_text())["compress"]
    needed = (streamed, tmp_path / "1.sog")
    assert (told["source_splats"], told["source_bytes"]) == (40, sum(path.stat().st_size for path in needed))
    assert main(["compress", "-o", str(output), "--resume"]) == 0
    assert "40 splats" in capsys.readouterr().out
    assert main(["compress", "-o", str(output), "--resume", "--level", "0"]) != 0
    assert "--level: --resume continues with what the run began with" in capsys.readouterr().err
