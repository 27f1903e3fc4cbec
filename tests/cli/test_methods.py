"""Settings and files of the methods that `compgs train` knows."""

from pathlib import Path
from typing import Any

import pytest

from compgs.cli.main import main, parse
from compgs.cli.run_folder import file_name, load_settings, save_settings
from compgs.cli.train import Train
from compgs.errors import CheckpointError, ConfigError
from compgs.training.run.checkpoint import CHECKPOINT_NAME


def settings(*arguments: object) -> Any:
    command = parse(["train", "scene", *map(str, arguments)])
    assert isinstance(command, Train)
    assert command.output is not None
    return command.settings(command.output)


def test_the_hybrid_method_is_the_default() -> None:
    assert settings("-o", "run").method == "compgs"


def test_presets_steps_seed_and_settings_of_its_own_apply_to_3dgs() -> None:
    options = [
        "--preset",
        "quick",
        "--seed",
        5,
        "--set",
        "splats.harmonics=1",
        "--set",
        "training.views_per_step=2",
    ]
    found = settings("-o", "run", "--method", "3dgs", *options)
    assert (found.method, found.config.training.steps, found.config.training.seed) == ("3dgs", 4000, 5)
    assert (found.config.splats.harmonics, found.config.training.views_per_step) == (1, 2)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--method", "3dgs", "--lmbda", "0.01"], r"--lmbda: not a setting of --method 3dgs"),
        (["--method", "3dgs", "--set", "model.width=64"], r"--set model.width: not a setting of --method 3dgs"),
        (["--method", "3dgs", "--set", "training.rate=bits"], r"training.rate: .* which has splats"),
        (["--set", "splats.harmonics=1"], r"splats.harmonics: not a setting of --method compgs, which has model"),
        (["--method", "3dgs", "--set", "splats.harmonics=4"], "0 to 3"),
        (["--method", "3dgs", "--set", "splats.position_lr=0.1,-1"], "expected 2 numbers, each above 0"),
        (["--method", "3dgs", "--set", "splats.reset_opacity=0.001"], "expected more than splats.prune_opacity"),
        (["--method", "3dgs", "--set", "splat.harmonics=1"], "no section 'splat'"),
    ],
)  # fmt: skip
def test_settings_that_a_method_does_not_have_are_refused(options: list[str], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        settings("-o", "run", *options)


def test_a_run_remembers_its_method(tmp_path: Path) -> None:
    begun = settings("-o", tmp_path, "--method", "3dgs")
    save_settings(tmp_path, begun)
    (tmp_path / CHECKPOINT_NAME).touch()
    assert load_settings(tmp_path) == begun
    assert settings("-o", tmp_path, "--resume").method == "3dgs"
    with pytest.raises(ConfigError, match="began with 3dgs"):
        settings("-o", tmp_path, "--resume", "--method", "compgs")
    text = (tmp_path / "config.json").read_text()
    (tmp_path / "config.json").write_text(text.replace('"3dgs"', '"4dgs"'))
    with pytest.raises(CheckpointError, match=r"config\.json.*4dgs"):
        load_settings(tmp_path)


def test_files_are_named_by_what_they_are() -> None:
    assert file_name(Path("runs/garden"), ".ply") == "garden.ply"


@pytest.mark.parametrize("command", ["evaluate", "render"])
def test_a_damaged_ply_is_refused_before_anything_is_read_or_made(
    command: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "scene.ply"
    file.write_bytes(b"ply\nformat ascii 1.0\nelement vertex 1\nend_header\n1 2 3\n")
    assert main([command, str(file), str(tmp_path / "no scene"), "-o", str(tmp_path / "out")]) == 1
    expected = f"error: {file}: property 'x' is missing: these are points, not splats"
    assert capsys.readouterr().err.startswith(expected)
    assert not (tmp_path / "out").exists()
