"""Which runs belong together, and what is missing, is read from their folders."""

import json
from pathlib import Path

import pytest

from compgs.errors import ReportError
from compgs.evaluation.reports.runs import read_runs

from .conftest import Maker


def names(folders: list[Path]) -> list[tuple[str, str, str, int | None]]:
    return [(run.scene, run.method, run.rate, run.seed) for run in read_runs(folders)[0]]


def test_method_preset_rate_and_seed_are_those_of_the_settings(make_run: Maker) -> None:
    folders = [
        make_run("a", preset="paper", lmbda=0.01, seed=3),
        make_run("b", lmbda=1e-4, scene="room"),
        make_run("c", settings={"training.target_bytes": 130_000}),
        make_run("d", method=None),
    ]
    assert names(folders) == [
        ("garden", "compgs paper", "lambda 0.01", 3),
        ("room", "compgs default", "lambda 0.0001", 0),
        ("garden", "compgs default", "130,000 bytes asked", 0),
        ("garden", "d", "", None),
    ]


def test_other_methods_have_no_lambda_unless_their_training_knows_one(make_run: Maker) -> None:
    plain = make_run("plain", method="3dgs")
    facts = json.loads((plain / "training.json").read_text())
    (plain / "training.json").write_text(json.dumps({k: v for k, v in facts.items() if k != "lmbda"}))
    quick = make_run("quick", method="3dgs", preset="quick", lmbda=0.5)
    assert names([plain, quick]) == [("garden", "3dgs", "", 0), ("garden", "3dgs quick", "lambda 0.5", 0)]


def test_presets_and_settings_of_another_methods_own_are_its_rates(make_run: Maker) -> None:
    folders = [
        make_run("a", method="c3dgs", preset="small"),
        make_run("b", method="c3dgs", preset="default", settings={"c3dgs.codebook": 64}),
        make_run("c", method="c3dgs", preset="default", settings={"c3dgs.codebook": 4096}),
        make_run("d", method="c3dgs", preset="quick"),
    ]
    for folder in folders:
        (folder / "training.json").write_text("{}")
    assert [(method, rate) for _, method, rate, _ in names(folders)] == [
        ("c3dgs", "small"),
        ("c3dgs", "c3dgs.codebook=64"),
        ("c3dgs", "c3dgs.codebook=4096"),
        ("c3dgs quick", ""),
    ]


def test_runs_of_one_preset_with_different_settings_are_not_one_curve(make_run: Maker) -> None:
    folders = [
        make_run("a", settings={"training.steps": 500}),
        make_run("b", settings={"training.steps": 900}, lmbda=0.1),
        make_run("c", preset="paper", settings={"training.steps": 500}),
    ]
    assert [method for _, method, _, _ in names(folders)] == [
        "compgs default, training.steps=500",
        "compgs default, training.steps=900",
        "compgs paper",
    ]


def test_a_scene_in_two_sizes_is_two_scenes(make_run: Maker) -> None:
    folders = [make_run("a"), make_run("b", results={"width": 96}), make_run("c", scene="room")]
    assert [scene for scene, *_ in names(folders)] == ["garden (48 px)", "garden (96 px)", "room"]


def test_a_scene_of_which_a_sector_is_held_out_is_another_scene(make_run: Maker) -> None:
    folders = [
        make_run("a"),
        make_run("b", results={"split": "one in 8 by name"}),
        make_run("c", results={"split": "a sector of 3 of 24 views"}),
    ]
    assert [scene for scene, *_ in names(folders)] == [
        "garden",
        "garden",
        "garden (a sector of 3 of 24 views)",
    ]


def test_a_folder_of_runs_stands_for_them(make_run: Maker) -> None:
    inside = [make_run("a"), make_run("b", lmbda=0.1)]
    (inside[0].parent / "notes").mkdir()
    assert names([inside[0].parent]) == names(inside)
    assert len(read_runs([inside[0].parent, inside[1]])[0]) == 2  # named twice, there once


def test_what_is_missing_is_said_and_the_rest_is_read(make_run: Maker, tmp_path: Path) -> None:
    whole, bare = make_run("whole"), make_run("bare", method=None, pictures=False)
    (bare / "per_view.json").unlink()
    unfinished = make_run("unfinished")
    (unfinished / "results.json").unlink()
    other = make_run("other", results={"schema": "something else"})
    damaged = make_run("damaged")
    (damaged / "results.json").write_text('{"schema": ')
    listed = make_run("listed")
    (listed / "training.json").write_text("[]")
    file = tmp_path / "a.json"
    file.touch()
    runs, notes = read_runs([whole, bare, unfinished, other, damaged, listed, file])
    assert [run.name for run in runs] == ["whole", "bare"]
    said = "\n".join(notes)
    for words in (
        "a.json: no folder of a run",
        "unfinished: no results.json",
        "other/results.json: its schema is 'something else'; expected 'compgs results 1'",
        "damaged/results.json: cannot be read",
        "listed/training.json: expected a dict of JSON, found list",
        "no config.json: bare",
        "no training.json: bare",
        "no per_view.json: bare",
        "no pictures: bare",
    ):
        assert words in said
    assert "whole" not in said and len(notes) == 9


def test_what_all_runs_lack_is_said_once(make_run: Maker) -> None:
    _, notes = read_runs([make_run("a", curve=False), make_run("b", curve=False)])
    assert notes == ("no training curve: all runs",)


def test_where_there_is_no_run_the_reasons_are_the_message(make_run: Maker, tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    with pytest.raises(ReportError, match=r"no runs to report on; .*empty: no results\.json"):
        read_runs([tmp_path / "empty"])
    with pytest.raises(ReportError, match=r"nowhere: does not exist"):
        read_runs([make_run("a"), tmp_path / "nowhere"])
    with pytest.raises(ReportError, match="no runs"):
        read_runs([])


def test_perfect_pictures_are_null_in_json_and_infinite_here(make_run: Maker) -> None:
    run = read_runs([make_run("a", psnr=(None, None))])[0][0]
    assert run.value("psnr") == float("inf")
    assert run.value("lpips") is None and run.value("bytes") == 1000
