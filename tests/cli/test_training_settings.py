"""Settings from the command line, and how a run remembers them."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from compgs.cli.ending import say_miss
from compgs.cli.main import parse
from compgs.cli.run_folder import (
    RunSettings,
    SceneSource,
    beginning,
    file_name,
    load_settings,
    save_settings,
)
from compgs.cli.settings import parse_value, with_settings
from compgs.cli.train import Train
from compgs.cli.training_command import interrupted
from compgs.cli.usage import UsageError
from compgs.config import Config, load_config
from compgs.errors import CheckpointError, ConfigError, TrainingError
from compgs.outputs import write_bytes
from compgs.training.run.checkpoint import CHECKPOINT_NAME


def train(*arguments: object) -> Train:
    command = parse(["train", *map(str, arguments)])
    assert isinstance(command, Train)
    return command


@pytest.mark.parametrize(
    ("assignment", "section", "key", "value"),
    [
        ("training.steps=5000", "training", "steps", 5000),
        ("training.steps=5_000", "training", "steps", 5000),
        ("training.lmbda=5e-3", "training", "lmbda", 0.005),
        ("training.rate=elements", "training", "rate", "elements"),
        ("training.embedding_lr=0.01,1e-4", "training", "embedding_lr", (0.01, 1e-4)),
        ("training.embedding_lr=[0.01, 1e-4]", "training", "embedding_lr", (0.01, 1e-4)),
        ("model.voxel_size=none", "model", "voxel_size", None),
        ("model.voxel_size=0.02", "model", "voxel_size", 0.02),
        ("model.heads=separate", "model", "heads", "separate"),
        (" control.every = 0.1 ", "control", "every", 0.1),
    ],
)
def test_a_setting_is_read_by_its_type(assignment: str, section: str, key: str, value: Any) -> None:
    config = with_settings(load_config("paper"), [assignment])
    assert getattr(getattr(config, section), key) == value
    assert type(getattr(getattr(config, section), key)) is type(value)
    expected = load_config("paper").to_dict()
    expected[section][key] = value
    assert config.to_dict() == expected


@pytest.mark.parametrize(
    ("assignment", "word"),
    [
        ("training.steps=1.5", "whole number"),
        ("training.steps=", "whole number"),
        ("training.lmbda=a lot", "a number"),
        ("training.lmbda=nan", "--lmbda nan: expected 0 to 100"),
        ("training.rate=bytes", "one of bits, elements"),
        ("training.embedding_lr=0.1", "2 numbers"),
        ("training.embedding_lr=0.1,x", "a number"),
        ("trainings.steps=1", "model, entropy, control, training"),
        ("training.step=1", "steps"),
        ("model.coupled_primitives=0", "1 to 64"),
        ("steps=1", "section.key=value"),
        ("training.steps", "section.key=value"),
    ],
)
def test_a_bad_setting_is_refused_with_what_was_expected(assignment: str, word: str) -> None:
    with pytest.raises(ConfigError, match=word):
        with_settings(Config(), [assignment])


def test_truth_values_are_words() -> None:
    assert parse_value(bool, "True") is True
    assert parse_value(bool, "false") is False
    with pytest.raises(ValueError, match="true or false"):
        parse_value(bool, "1")


def test_options_with_names_of_their_own_are_settings() -> None:
    settings = train("scene", "-o", "run", "--lmbda", "0.01", "--steps", "77", "--seed", "5").settings(
        Path("run")
    )
    t = settings.config.training
    assert (t.lmbda, t.steps, t.seed) == (0.01, 77, 5)


def test_flags_of_3dgs_mean_the_same() -> None:
    theirs = train("-s", "scene", "-m", "run", "-i", "photos", "-r", "4", "--eval", "--iterations", "700")
    ours = train("scene", "-o", "run", "--images", "photos", "--downscale", "4", "--steps", "700")
    assert theirs.settings(Path("run")) == ours.settings(Path("run"))
    assert theirs.output == ours.output
    underscores = train(
        "--source_path", "scene", "--model_path", "run", "--images", "photos", "--resolution", "4"
    )
    assert underscores.output == ours.output
    assert underscores.settings(Path("run")).scene == ours.settings(Path("run")).scene


def test_large_photographs_are_reduced_on_the_cpu_unless_somebody_says_otherwise(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def downscale(*options: str) -> int | str:
        return train("scene", "-o", tmp_path / "run", *options).settings(tmp_path / "run").scene.downscale

    monkeypatch.setattr("compgs.devices.chosen_device", lambda device: device or "cpu")
    assert [downscale(), downscale("-r", "1"), downscale("-r", "auto")] == ["auto", 1, "auto"]
    monkeypatch.setattr("compgs.devices.chosen_device", lambda device: device or "cuda")
    assert [downscale(), downscale("-r", "auto"), downscale("--device", "cpu")] == [1, "auto", "auto"]
    with pytest.raises(UsageError, match="-r: expected a whole number or auto"):
        downscale("-r", "half")


def test_a_run_remembers_which_views_are_held_out(tmp_path: Path) -> None:
    begun = train("scene", "-o", tmp_path, "--hold-out", "sector").settings(tmp_path)
    assert begun.scene.split == "sector"
    save_settings(tmp_path, begun)
    (tmp_path / CHECKPOINT_NAME).touch()
    assert train("-o", tmp_path, "--resume").settings(tmp_path) == begun
    content = json.loads((tmp_path / "config.json").read_text())
    del content["scene"]["split"]  # as runs have it that began before there was a choice
    (tmp_path / "config.json").write_text(json.dumps(content))
    assert load_settings(tmp_path).scene.split == "auto"


def test_a_run_remembers_how_it_began(tmp_path: Path) -> None:
    begun = train(
        "scene", "-o", tmp_path, "--preset", "quick", "-r", "2", "--no-eval", "--background", "0.5", "0", "1"
    )
    save_settings(tmp_path, begun.settings(tmp_path))
    (tmp_path / CHECKPOINT_NAME).touch()
    assert train("-o", tmp_path, "--resume").settings(tmp_path) == begun.settings(tmp_path)
    moved = train("elsewhere", "-o", tmp_path, "--resume").settings(tmp_path)
    assert moved.scene == SceneSource("elsewhere", 2, "images", 8, False, (0.5, 0.0, 1.0))
    assert moved.config == begun.settings(tmp_path).config


@pytest.mark.parametrize("other", [["--lmbda", "0.1"], ["--set", "model.width=64"], ["--preset", "paper"]])
def test_a_run_is_not_continued_with_other_settings(tmp_path: Path, other: list[str]) -> None:
    save_settings(tmp_path, train("scene", "-o", tmp_path, "--preset", "quick").settings(tmp_path))
    (tmp_path / CHECKPOINT_NAME).touch()
    with pytest.raises(ConfigError, match=r"continue"):
        train("-o", tmp_path, "--resume", *other).settings(tmp_path)


def test_a_run_that_was_killed_before_its_first_checkpoint_begins_again_as_it_began(tmp_path: Path) -> None:
    begun = train("scene", "-o", tmp_path, "--steps", "77").settings(tmp_path)
    save_settings(tmp_path, begun)
    again = train("-o", tmp_path, "--resume")
    assert again.settings(tmp_path) == begun
    assert not again.continues(tmp_path)
    (tmp_path / CHECKPOINT_NAME).touch()
    assert again.continues(tmp_path)


@pytest.mark.parametrize("failure", [TrainingError, KeyboardInterrupt, MemoryError])
def test_a_run_that_fails_before_its_first_checkpoint_leaves_nothing(
    tmp_path: Path, failure: type[BaseException]
) -> None:
    folder = tmp_path / "runs" / "garden"
    settings = train("scene", "-o", folder).settings(folder)
    with pytest.raises(failure), beginning(folder, settings):
        assert load_settings(folder) == settings
        raise failure
    assert list(tmp_path.iterdir()) == []
    folder.mkdir(parents=True)
    (folder / "notes.txt").touch()
    with pytest.raises(failure), beginning(folder, settings):
        raise failure
    assert [path.name for path in folder.iterdir()] == ["notes.txt"]


def test_a_run_that_fails_after_a_checkpoint_can_be_continued(tmp_path: Path) -> None:
    settings = train("scene", "-o", tmp_path).settings(tmp_path)
    with pytest.raises(TrainingError), beginning(tmp_path, settings):
        (tmp_path / CHECKPOINT_NAME).touch()
        raise TrainingError
    elsewhere = replace(settings, scene=replace(settings.scene, path="elsewhere"))
    with pytest.raises(TrainingError), beginning(tmp_path, elsewhere, anew=False):
        raise TrainingError
    assert load_settings(tmp_path) == settings


@pytest.mark.parametrize("content", ["", "[]", "{}", '{"preset": "quick", "scene": {}, "settings": {}}'])
def test_damaged_run_settings_are_refused_by_name(tmp_path: Path, content: str) -> None:
    (tmp_path / "config.json").write_text(content)
    with pytest.raises(CheckpointError, match=r"config\.json"):
        load_settings(tmp_path)


def test_settings_survive_the_file(tmp_path: Path) -> None:
    config = with_settings(load_config("paper"), ["training.embedding_lr=0.01,1e-4", "model.voxel_size=0.5"])
    settings = RunSettings("paper", SceneSource("a folder/ü", 4, "images", 8, True, None), config)
    save_settings(tmp_path, settings)
    assert load_settings(tmp_path) == settings
    assert json.loads((tmp_path / "config.json").read_text())["settings"]["model"]["voxel_size"] == 0.5


def test_the_file_is_named_after_the_run(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    assert file_name(Path("runs/garden")) == "garden.cgs"
    monkeypatch.chdir(tmp_path)
    assert file_name(Path(".")) == f"{tmp_path.name}.cgs"


@pytest.fixture
def finished(tmp_path: Path) -> Path:
    """The folder of a finished run, with something else in it."""
    folder = tmp_path / "run"
    save_settings(folder, train("scene", "-o", folder, "--steps", "5").settings(folder))
    for name in (CHECKPOINT_NAME, "training.json", "results.json", "run.cgs", "run.ply", "notes.txt"):
        (folder / name).write_text("earlier")
    return folder


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


@pytest.mark.parametrize("failure", [ConfigError, TrainingError, KeyboardInterrupt])
def test_a_run_that_replaces_another_leaves_it_as_it_was_until_its_first_checkpoint(
    finished: Path, failure: type[BaseException]
) -> None:
    before = contents(finished)
    settings = train("other", "-o", finished, "--overwrite").settings(finished)
    with pytest.raises(failure), beginning(finished, settings) as earlier:
        assert earlier is not None
        earlier.look()
        assert contents(finished) == before
        assert "is as it was" in interrupted(finished, earlier)
        raise failure
    assert contents(finished) == before


@pytest.mark.parametrize("checkpoint_was_there", [True, False])
def test_with_its_first_checkpoint_a_run_takes_the_place_of_the_earlier_one(
    finished: Path, checkpoint_was_there: bool
) -> None:
    if not checkpoint_was_there:
        (finished / CHECKPOINT_NAME).unlink()
    settings = train("other", "-o", finished, "--overwrite").settings(finished)
    with beginning(finished, settings) as earlier:
        assert earlier is not None
        write_bytes(finished / CHECKPOINT_NAME, b"new")
        earlier.look()
        assert sorted(contents(finished)) == [CHECKPOINT_NAME, "config.json", "notes.txt"]
        assert load_settings(finished) == settings
        assert "--resume" in interrupted(finished, earlier)
        (finished / "run.cgs").write_text("new")
        earlier.look()
        assert (finished / "run.cgs").exists()


def test_a_checkpoint_that_is_written_at_the_very_end_counts(finished: Path) -> None:
    settings = train("other", "-o", finished, "--overwrite").settings(finished)
    with pytest.raises(KeyboardInterrupt), beginning(finished, settings):
        write_bytes(finished / CHECKPOINT_NAME, b"new")
        raise KeyboardInterrupt
    assert load_settings(finished) == settings
    assert not (finished / "run.cgs").exists()


@pytest.mark.parametrize(
    "other",
    [
        ["-r", "2"],
        ["--images", "photos"],
        ["--test-every", "4"],
        ["--hold-out", "sector"],
        ["--no-eval"],
        ["--background", "1", "0", "0"],
    ],
)
def test_a_scene_is_not_read_otherwise_when_a_run_goes_on(finished: Path, other: list[str]) -> None:
    with pytest.raises(UsageError, match=rf"{other[0] if other[0] != '-r' else '--downscale'}.*leave it out"):
        train("-o", finished, "--resume", *other).settings(finished)


def test_options_that_say_what_a_run_began_with_are_no_contradiction(tmp_path: Path) -> None:
    options = ["-r", "2", "--images", "photos", "--test-every", "4", "--no-eval"]
    begun = train("scene", "-o", tmp_path, *options).settings(tmp_path)
    save_settings(tmp_path, begun)
    assert train("-o", tmp_path, "--resume", *options).settings(tmp_path) == begun
    assert train("-o", tmp_path, "--resume").settings(tmp_path) == begun


def test_a_run_that_began_in_python_is_sent_back_there(tmp_path: Path) -> None:
    (tmp_path / CHECKPOINT_NAME).touch()
    with pytest.raises(CheckpointError, match=r"began in Python .* compgs\.train with the same scene"):
        train("-o", tmp_path, "--resume").settings(tmp_path)


def test_someone_who_stops_a_run_is_told_how_to_go_on(tmp_path: Path) -> None:
    assert "nothing was kept" in interrupted(tmp_path)
    (tmp_path / CHECKPOINT_NAME).touch()
    assert f"compgs train -o {tmp_path} --resume" in interrupted(tmp_path)


def test_a_size_that_was_asked_for_is_compared_with_the_file(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "run"
    folder.mkdir()
    (folder / "run.cgs").write_bytes(bytes(131_200))
    (folder / "training.json").write_text('{"steps": 40, "lmbda": 0.002}')
    say_miss(folder, 130_000)
    assert capsys.readouterr().out == "asked 130.0 kB, written 131.2 kB: +0.9 %\n"
    facts = json.loads((folder / "training.json").read_text())
    assert facts == {
        "steps": 40,
        "lmbda": 0.002,
        "target_bytes": 130_000,
        "bytes": 131_200,
        "miss": pytest.approx(0.0092, abs=1e-4),
    }
    (folder / "training.json").unlink()  # as a run that was stopped after its last step
    say_miss(folder, 80_000)
    assert json.loads((folder / "training.json").read_text())["target_bytes"] == 80_000
    out = capsys.readouterr().out
    assert "+64.0 %" in out and "131.2 kB is what these settings reached" in out


def test_a_target_size_is_a_setting_of_the_run() -> None:
    assert (
        "training.target_bytes=1500000" in train("scene", "-o", "run", "--target-size", "1.5MB").assignments()
    )
    assert not [a for a in train("scene", "-o", "run").assignments() if "target_bytes" in a]
