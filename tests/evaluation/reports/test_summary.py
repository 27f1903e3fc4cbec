"""Means, scatter and BD-rates by hand."""

import math

import pytest

from compgs.errors import ConfigError
from compgs.evaluation.reports import summary
from compgs.evaluation.reports.runs import read_runs
from compgs.evaluation.reports.summary import (
    bd_rate_table,
    means_table,
    points_of,
    results_table,
    views_table,
    worst_views,
)
from compgs.evaluation.reports.tables import Spread, Table

from .conftest import Maker


def records(table: Table) -> list[dict[str, object]]:
    keys = [column.key for column in table.columns]
    return [dict(zip(keys, row, strict=True)) for row in table.rows]


def test_seeds_are_averaged_with_their_scatter(make_run: Maker) -> None:
    folders = [make_run(f"s{seed}", seed=seed, bytes=size, psnr=(psnr,)) for seed, size, psnr in SEEDS]
    points = points_of(read_runs(folders)[0])
    assert len(points) == 1
    (row,) = records(results_table(points))
    assert row["seeds"] == 3
    assert row["bytes"] == Spread(pytest.approx(1000.0), pytest.approx(100.0))
    assert row["psnr"] == Spread(pytest.approx(30.0), pytest.approx(math.sqrt(0.52)))
    assert row["train_seconds"] == pytest.approx(101.0)
    assert row["primitives"] == 200 and row["frames_per_second"] == pytest.approx(50.0)


SEEDS = ((0, 900, 29.4), (1, 1000, 29.8), (2, 1100, 30.8))


def test_one_seed_has_no_scatter_and_what_a_seed_lacks_is_unknown(make_run: Maker) -> None:
    folders = [make_run("a", results={"anchors": None}), make_run("b", seed=1), make_run("c", lmbda=0.5)]
    rows = records(results_table(points_of(read_runs(folders)[0])))
    assert [row["anchors"] for row in rows] == [None, 50]
    assert "lpips" not in rows[0] and "ratio" not in rows[0]


def test_seconds_of_a_training_that_went_on_are_unknown(make_run: Maker) -> None:
    run = read_runs([make_run("a")])[0][0]
    run.training["resumed"] = True  # type: ignore[index]
    assert "train_seconds" not in records(results_table(points_of([run])))[0]


def test_sizes_are_compared_with_plain_3dgs_of_the_same_scene(make_run: Maker) -> None:
    folders = [
        make_run("plain", method="3dgs", bytes=80_000),
        make_run("ours", bytes=1000),
        make_run("other", scene="room"),
    ]
    rows = records(results_table(points_of(read_runs(folders)[0])))
    assert [(row["scene"], row["ratio"]) for row in rows] == [
        ("garden", 1.0),
        ("garden", 80.0),
        ("room", None),
    ]


def test_means_over_scenes_are_of_what_every_scene_has(make_run: Maker) -> None:
    folders = [
        make_run("a", bytes=1000, psnr=(20.0,)),
        make_run("b", bytes=3000, psnr=(30.0,), scene="room"),
        make_run("c", bytes=500, lmbda=0.1),
    ]
    points = points_of(read_runs(folders)[0])
    table = means_table(points)
    assert table is not None and table.title == "Means of 2 scenes"
    (mean,) = records(table)
    assert (mean["rate"], mean["bytes"], mean["psnr"], mean["seeds"]) == ("lambda 0.001", 2000, 25.0, 1)
    assert means_table([point for point in points if point.scene == "garden"]) is None


def curve(make_run: Maker, preset: str, factor: float, scene: str = "garden") -> list[object]:
    """Four rates, PSNR and SSIM by the logarithm of the bytes at `factor` 1."""
    return [
        make_run(
            f"{preset}{scene}{i}", preset=preset, scene=scene, lmbda=10.0**-i,
            bytes=round(factor * 1000 * 4**i), psnr=(20.0 + 2 * i,), ssim=0.6 + 0.1 * i,
        )
        for i in range(4)
    ]  # fmt: skip


def test_bd_rates_of_shifted_curves_are_their_shift_by_both_measures(make_run: Maker) -> None:
    folders = [*curve(make_run, "paper", 1), *curve(make_run, "default", 0.4)]
    folders += [*curve(make_run, "paper", 1, "room"), *curve(make_run, "default", 0.8, "room")]
    folders.append(make_run("alone", method="3dgs", bytes=10**6))
    table = bd_rate_table(points_of(read_runs(folders)[0]), "compgs paper")  # type: ignore[arg-type]
    assert table is not None and "beside compgs paper" in table.notes[0] and len(table.notes) == 1
    assert [tuple(row[:2]) for row in table.rows] == [
        ("garden", "compgs default"),
        ("room", "compgs default"),
        (summary.ALL_SCENES, "compgs default"),
    ]
    for row, expected in zip(table.rows, (-0.6, -0.2, -0.4), strict=True):
        assert row[2:] == (pytest.approx(expected, abs=1e-3), pytest.approx(expected, abs=1e-3))


def test_a_measure_of_which_less_is_better_is_compared_as_such_where_all_runs_have_it(
    make_run: Maker,
) -> None:
    def run(name: str, share: float, i: int, **more: object) -> object:
        flip = {"flip": 0.3 / 2**i, **more}
        size = int(share * 10_000 * 4**i)
        return make_run(
            f"{name}{i}", preset=name, lmbda=0.1 / 10**i, bytes=size, psnr=(20.0 + i,), results=flip
        )

    folders = [run(name, share, i) for name, share in (("paper", 1.0), ("default", 0.5)) for i in range(4)]
    table = bd_rate_table(points_of(read_runs(folders)[0]), "compgs paper")  # type: ignore[arg-type]
    assert table is not None and [column.title for column in table.columns[2:]] == [
        "by PSNR",
        "by SSIM",
        "by FLIP",
    ]
    assert [table.rows[0][i] for i in (2, 4)] == pytest.approx([-0.5, -0.5], abs=1e-3)
    folders.append(run("default", 0.5, 4, flip=None))
    table = bd_rate_table(points_of(read_runs(folders)[0]), "compgs paper")  # type: ignore[arg-type]
    assert table is not None and [column.title for column in table.columns[2:]] == ["by PSNR", "by SSIM"]


def test_points_of_which_a_smaller_file_has_the_quality_are_left_out_and_counted(make_run: Maker) -> None:
    folders = [*curve(make_run, "paper", 1), *curve(make_run, "default", 0.5)]
    folders.append(make_run("worse", lmbda=0.5, bytes=40_000, psnr=(21.0,), ssim=0.65))
    table = bd_rate_table(points_of(read_runs(folders)[0]), "compgs paper")  # type: ignore[arg-type]
    assert table is not None and table.rows[0][2] == pytest.approx(-0.5, abs=1e-3)
    assert [note for note in table.notes if "PSNR: 1 point is left out" in note]


def test_a_bd_rate_that_there_is_none_of_has_its_reason(make_run: Maker) -> None:
    folders = [*curve(make_run, "paper", 1), *curve(make_run, "default", 0.5)]
    for folder in folders[4:]:
        path = folder / "results.json"  # type: ignore[operator]
        path.write_text(path.read_text().replace('"psnr": ', '"psnr": 9'))
    table = bd_rate_table(points_of(read_runs(folders)[0]), "compgs paper")  # type: ignore[arg-type]
    assert table is not None and table.rows[0][2] is None
    assert table.rows[0][3] == pytest.approx(-0.5, abs=1e-3)
    assert any("no common quality" in note for note in table.notes)


def test_without_two_curves_there_are_no_bd_rates(make_run: Maker) -> None:
    points = points_of(read_runs(curve(make_run, "paper", 1))[0])  # type: ignore[arg-type]
    assert bd_rate_table(points, "compgs paper") is None
    with pytest.raises(ConfigError, match="no run is of that method; there are compgs paper"):
        bd_rate_table(points, "compgs best")


def test_the_worst_views_come_first(make_run: Maker) -> None:
    folders = [make_run("a", psnr=(30.0, 20.0)), make_run("b", lmbda=0.5, psnr=(10.0, 25.0))]
    points = points_of(read_runs(folders)[0])
    assert worst_views(points) == ["bright.jpg", "dark.jpg"]
    assert worst_views(points[:1]) == ["dark.jpg", "bright.jpg"]
    rows = records(views_table(points))
    assert [(row["view"], row["psnr"]) for row in rows] == [
        ("bright.jpg", 30.0),
        ("bright.jpg", 10.0),
        ("dark.jpg", 20.0),
        ("dark.jpg", 25.0),
    ]
