"""What a suite's file may say, and what it becomes."""

from pathlib import Path

import pytest

from compgs.cli.benchmark import Benchmark
from compgs.cli.main import parse
from compgs.cli.train import Train
from compgs.errors import ConfigError, SceneError
from compgs.suites.benchmark import some_of
from compgs.suites.jobs import check_scenes, jobs_of
from compgs.suites.suite import SHIPPED, Suite, load_suite, parse_suite


def test_every_scene_method_rate_and_seed_is_a_run_of_its_own(suite: Suite, tmp_path: Path) -> None:
    jobs = jobs_of(suite, tmp_path / "data", tmp_path)
    assert len(jobs) == 2 * (2 + 1) * 2
    assert len({job.folder for job in jobs}) == len(jobs)
    assert {(job.scene, job.method, job.rate, job.seed) for job in jobs} == {
        (scene, *method, seed)
        for scene in ("north", "south")
        for method in (("compgs default", "lambda 0.001"), ("compgs default", "lambda 0.01"), ("3dgs", ""))
        for seed in (0, 1)
    }
    assert [job.seed for job in jobs] == [0] * 6 + [1] * 6  # a whole table of one seed first


def test_a_run_is_the_command_that_a_person_would_type(suite: Suite, tmp_path: Path) -> None:
    job = next(j for j in jobs_of(suite, Path("/data"), tmp_path) if j.rate == "lambda 0.01" and j.seed == 1)
    train = parse([*job.command, "-o", str(job.folder)])
    assert isinstance(train, Train)
    asked = train.settings(job.folder)
    assert (asked.method, asked.preset, asked.scene.path) == ("compgs", "default", "/data/north_folder")
    assert (asked.scene.downscale, asked.config.training.steps, asked.config.training.seed) == (2, 30, 1)
    assert (asked.config.training.lmbda, asked.config.model.width) == (0.01, 16)
    assert train.threads == 1


def test_a_suite_may_hold_a_sector_out(tmp_path: Path) -> None:
    text = """
[scenes.plush]
path = "plush"
[scenes."plush sector"]
path = "plush"
hold_out = "sector"
[methods.3dgs]
method = "3dgs"
"""
    suite = parse_suite(text, "suite")
    plain, sector = jobs_of(suite, Path("/data"), tmp_path)
    assert "--hold-out" not in plain.command  # nor before there was this option: such runs are not repeated
    train = parse([*sector.command, "-o", "out"])
    assert isinstance(train, Train) and train.settings(Path("out")).scene.split == "sector"
    with pytest.raises(ConfigError, match=r"hold_out: expected one of auto, every, sector, found 'half'"):
        parse_suite(text.replace('"sector"', '"half"'), "suite")


@pytest.mark.parametrize("name", SHIPPED)
def test_shipped_suites_are_read_and_their_runs_are_commands(name: str, tmp_path: Path) -> None:
    suite = load_suite(name)
    for job in jobs_of(suite, Path("/data"), tmp_path):
        assert isinstance(parse([*job.command, "-o", "out"]), Train)
    assert all(scene.published for scene in suite.scenes)


def test_the_help_names_every_shipped_suite() -> None:
    named = " ".join((Benchmark.__doc__ or "").split())
    assert f"one that is shipped: {', '.join(SHIPPED)}." in named


def test_the_paper_s_rows_are_as_printed() -> None:
    rows = {(row.method, row.rate): row for row in load_suite("tanks_and_temples").published}
    assert rows["CompGS", "lambda 0.001"].bytes == pytest.approx(9.60 * 2**20, abs=1)  # MiB
    assert rows["3dgs", ""].bytes == 434_380_000
    assert rows["c3dgs", ""].psnr == 23.58
    mean = {(row.method, row.rate): row for row in load_suite("mip_nerf_360").published}
    assert mean["CompGS", "lambda 0.01"].psnr == 26.37


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("x = [", "not TOML"),
        ("", "scenes: expected at least one table"),
        ('[scenes.a]\n[methods.b]\nmethod="3dgs"', "scenes.a: path is missing"),
        (
            '[scenes.a]\npath="p"\ncolor=1\n[methods.b]\nmethod="3dgs"',
            "scenes.a: 'color' is unknown; there are",
        ),
        (
            '[scenes.a]\npath="p"\ndownscale="2"\n[methods.b]\nmethod="3dgs"',
            "scenes.a.downscale: expected int",
        ),
        ('[scenes.a]\npath="p"\n[methods.b]\nmethod="4dgs"', "there is no method '4dgs'; there are compgs"),
        ('[scenes."../a"]\npath="p"\n[methods.b]\nmethod="3dgs"', "expected letters"),
        (
            '[scenes.a]\npath="p"\n[methods.b]\nmethod="3dgs"\nvary={x=1}',
            "vary: expected one setting and a list",
        ),
        (
            'seeds=[-1]\n[scenes.a]\npath="p"\n[methods.b]\nmethod="3dgs"',
            "seeds: expected a list of whole numbers",
        ),
        ('[train]\nlambda=1\n[scenes.a]\npath="p"\n[methods.b]\nmethod="3dgs"', "train: 'lambda' is unknown"),
        (
            '[scenes.a]\npath="p"\n[methods.b]\nmethod="3dgs"\n[[published]]\nmethod="x"',
            "published 1: source",
        ),
    ],
)
def test_what_is_wrong_in_a_suite_is_said_with_its_place(text: str, said: str) -> None:
    with pytest.raises(ConfigError) as caught:
        parse_suite(text, "suite.toml")
    assert str(caught.value).startswith("suite.toml")
    assert said in str(caught.value)


def test_an_unknown_suite_is_answered_with_those_there_are() -> None:
    with pytest.raises(ConfigError, match=r"nothing: there is no such suite.*mip_nerf_360"):
        load_suite("nothing")


def test_missing_scenes_are_named_with_where_they_are_published(suite: Suite, tmp_path: Path) -> None:
    (tmp_path / "south").mkdir()
    with pytest.raises(
        SceneError, match=r"1 of 2 scenes are missing: north \(.*north_folder, published at the nor"
    ):
        check_scenes(suite, tmp_path)
    check_scenes(some_of(suite, ["south"], []), tmp_path)
    with pytest.raises(ConfigError, match="scenes 'east': not in the suite, which has north, south"):
        some_of(suite, ["east"], [])
