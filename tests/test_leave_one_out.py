"""The default without each rule: which are left out, and what the table says of them."""

import json
import math
import sys
from dataclasses import replace
from pathlib import Path

import pytest

sys.path.append(str(Path(__file__).parents[1] / "benchmarks"))

import leave_one_out
from ablation_tables import Row

from compgs.cli.main import main, parse
from compgs.cli.run_folder import save_settings
from compgs.cli.train import Train


def row(bytes_: float, psnr: float, curve: str = "") -> Row:
    return Row("", curve, psnr, None, 0.9, None, None, bytes_, 1, 1, 1.0, {})


def test_a_row_beside_a_straight_line_takes_what_the_closed_form_says() -> None:
    line = [row(size, 20 + 2 * math.log(size), "default") for size in (1e5, 2e5, 4e5)]
    same, half, better = (
        row(2e5, 20 + 2 * math.log(2e5)),
        row(1e5, 20 + 2 * math.log(2e5)),
        row(3e5, 24 + 2 * math.log(3e5)),
    )
    assert leave_one_out.bytes_beside(line, same, "psnr") == pytest.approx(0.0)
    assert leave_one_out.bytes_beside(line, half, "psnr") == pytest.approx(-0.5)
    assert leave_one_out.bytes_beside(line, better, "psnr") == pytest.approx(math.exp(-2.0) - 1)


def test_where_bytes_buy_nothing_there_is_no_comparison() -> None:
    line = [row(size, 30 - math.log(size), "default") for size in (1e5, 2e5, 4e5)]
    assert leave_one_out.bytes_beside(line, row(1e5, 20.0), "psnr") is None
    assert leave_one_out.bytes_beside(line, replace(row(1e5, 20.0), bytes=None), "psnr") is None


def test_a_rule_that_does_not_act_on_the_scene_is_not_left_out(tmp_path: Path) -> None:
    scene = tmp_path / "scene"
    assert main(["demo-scene", str(scene), "--views", "12", "--width", "32", "--height", "24"]) == 0
    commands: list[list[str]] = []

    def trained(arguments: list[str]) -> None:
        commands.append(arguments)
        folder = Path(arguments[arguments.index("-o") + 1])
        lmbda = float(arguments[arguments.index("--lmbda") + 1])
        results: dict[str, object] = {
            "psnr": 20 - math.log(lmbda), "ssim": 0.9 - 0.01 * math.log(lmbda), "lpips": None,
            "bytes": round(100 / lmbda), "anchors": 100, "coupled_primitives": 800, "views": 12, "width": 32,
            "height": 24, "components": {},
        }  # fmt: skip
        (folder / "results.json").write_text(json.dumps(results))
        (folder / "training.json").write_text(json.dumps({"steps": 60}))
        train = parse(arguments)
        assert isinstance(train, Train)
        save_settings(folder, train.settings(folder))

    only = ["--only", "dropout", "dense_points", "rate_every"]
    out = ["-o", str(tmp_path / "out"), "--runs", str(tmp_path / "runs"), "--steps", "60"]
    leave_one_out.main([str(scene), "--lmbda", "0.001", *only, *out], trained)
    asked = [c[c.index("--set") + 1] for c in commands if "--set" in c]
    # Ten training views are few, and 20,000 anchors more than the balls have.
    assert asked == ["training.rules=all but dropout", "training.rules=all but rate_every"]
    assert len(commands) == 5
    text = (tmp_path / "out" / "leave_one_out_scene_0.001.md").read_text()
    assert "| without dropout | 26.91 | 0.9691 | 100,000 | 100 |" in text
    assert text.count("+0 % | +0 % |") == 2


def test_a_rule_that_is_none_is_refused_by_name(tmp_path: Path) -> None:
    with pytest.raises(SystemExit, match=r"sharper: the rules are .*dense_points"):
        leave_one_out.main([str(tmp_path), "--lmbda", "1", "--only", "sharper"])
