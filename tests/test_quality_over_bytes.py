"""The chart of quality over bytes: what it reads, what it refuses, and what it draws of several seeds."""

import json
import sys
from pathlib import Path
from typing import Any

import pytest

sys.path.append(str(Path(__file__).parents[1] / "benchmarks"))

from quality_over_bytes import check_comparable, drawn, main, points_of, read_records
from quality_over_bytes_figure import styles


def record(variant: str, curve: str, size: int, psnr: float = 28.0, seed: int = 0, **more: Any) -> dict:
    results = {
        "schema": "compgs results 1",
        "scene": "fox",
        "file": f"{variant}{seed}",
        "views": 7,
        "width": 178,
        "height": 317,
        "psnr": psnr,
        "ssim": 0.9,
        "bytes": size,
        "splats": None,
        "sha256": f"{variant} {seed} {size}",
        **more,
    }
    return {
        "variant": variant,
        "label": f"{variant}!",
        "curve": curve,
        "seed": seed,
        "commit": "abc",
        "training": {"steps": 1500},
        "results": results,
    }


CURVES = [
    record("paper_0.1", "paper", 90_000, 27.0),
    record("paper_0.001", "paper", 250_000, 28.5),
    record("default_0.001", "default", 60_000, 28.2),
]
PLAIN = record("3dgs", "", 12_800_000, 29.0, splats=51_619)


def written(path: Path, content: object) -> Path:
    path.write_text(json.dumps(content))
    return path


def test_tables_single_records_and_results_of_a_run_are_read(tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    table = written(tmp_path / "table.json", {"rows": [], "records": CURVES})
    single = written(tmp_path / "single.json", PLAIN)
    results = written(tmp_path / "run" / "results.json", PLAIN["results"])
    written(tmp_path / "run" / "training.json", {"steps": 2000})
    assert read_records(table) == CURVES
    assert read_records(single) == [PLAIN]
    (alone,) = read_records(results)
    assert (alone["variant"], alone["results"]) == ("run", PLAIN["results"])
    assert points_of([alone])[0].steps == 2000


@pytest.mark.parametrize("content", [{"psnr": 3}, [1, 2]])
def test_other_json_is_refused_by_name(tmp_path: Path, content: object) -> None:
    with pytest.raises(SystemExit, match=r"other\.json: neither records"):
        read_records(written(tmp_path / "other.json", content))
    with pytest.raises(SystemExit, match=r"missing\.json: cannot be read"):
        read_records(tmp_path / "missing.json")


def test_only_curves_and_plain_3dgs_are_drawn_each_file_once() -> None:
    hybrid = record("hybrid", "", 300_000)
    assert drawn([*CURVES, hybrid, PLAIN, CURVES[0]]) == [*CURVES, PLAIN]


@pytest.mark.parametrize(
    ("key", "value"), [("scene", "plush"), ("views", 8), ("width", 356), ("height", 634)]
)
def test_results_of_other_views_are_refused(key: str, value: object) -> None:
    check_comparable([*CURVES, PLAIN])
    with pytest.raises(SystemExit, match=f"other0: expected .*{key}.* as of paper_0.10, found .*{value}"):
        check_comparable([*CURVES, record("other", "default", 1, **{key: value})])
    with pytest.raises(SystemExit, match="nothing to draw"):
        check_comparable([])


def test_seeds_of_a_variant_are_one_point_with_its_spread() -> None:
    seeds = [record("default_0.001", "default", 60_000 + 3000 * s, 28.0 + s, seed=s) for s in (0, 1, 2)]
    single, several, plain = points_of([CURVES[0], *seeds, PLAIN])
    assert (several.seeds, several.bytes, several.psnr) == (3, 63_000, 29.0)
    assert (several.bytes_spread, several.psnr_spread, several.ssim_spread) == pytest.approx((3000, 1, 0))
    assert (single.seeds, single.psnr_spread) == (1, None)
    assert (plain.curve, plain.label) == ("3DGS", "3DGS")
    assert several.commits == ("abc",)


def test_runs_of_other_lengths_are_points_of_their_own() -> None:
    longer = {**CURVES[0], "training": {"steps": 5000}}
    assert [point.steps for point in points_of([CURVES[0], longer])] == [1500, 5000]


def test_points_of_a_curve_are_in_the_order_of_their_bytes() -> None:
    points = points_of([CURVES[1], CURVES[2], CURVES[0]])
    assert [point.label for point in points] == ["paper_0.1!", "paper_0.001!", "default_0.001!"]


def test_a_preset_looks_the_same_in_every_chart() -> None:
    whole, half = styles(points_of([*CURVES, PLAIN])), styles(points_of([CURVES[2], PLAIN]))
    assert whole["default"] == half["default"] != whole["paper"]
    assert whole["3DGS"] == half["3DGS"]
    assert styles(points_of([record("x", "other", 1), *CURVES]))["default"] == whole["default"]


def test_chart_table_and_numbers_are_written(tmp_path: Path) -> None:
    table = written(tmp_path / "table.json", {"records": [*CURVES, PLAIN]})
    # The end of the name is no ending: `.5` stays.
    main([str(table), "-o", str(tmp_path / "out" / "fox_0.5")])
    text = (tmp_path / "out" / "fox_0.5.md").read_text()
    assert "| 3DGS | 29.00 | 0.9000 | 12,800,000 | 1500 | 1 |" in text
    assert "7 held-out views, 178 x 317 pixels" in text
    content = json.loads((tmp_path / "out" / "fox_0.5.json").read_text())
    assert [point["bytes"] for point in content["points"]] == [90_000, 250_000, 60_000, 12_800_000]
    assert (tmp_path / "out" / "fox_0.5.png").read_bytes().startswith(b"\x89PNG")
