"""What a training says of its plan, and where it keeps it."""

import json
import shutil
from pathlib import Path

import pytest

from compgs.cli.main import main
from compgs.scene.generated import generate_scene
from compgs.training import Plan, load_run
from compgs.words import duration


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("plan") / "scene"
    generate_scene(folder, views=8, width=48, height=36)
    return folder


def test_a_run_says_its_plan_and_keeps_it_with_settings_results_and_checkpoint(
    scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = tmp_path / "run"
    options = ["--steps", "4", "--device", "cpu", "--set", "model.max_anchors=60"]
    assert main(["train", str(scene), "-o", str(run), *options]) == 0
    said = capsys.readouterr().out
    kept = Plan.from_dict(json.loads((run / "config.json").read_text())["plan"])
    assert all(line in said for line in kept.in_words())
    assert json.loads((run / "results.json").read_text())["plan"] == kept.to_dict()
    model = load_run(run)
    assert model.plan == kept
    assert (model.dimensions.width, model.own_residuals) == (kept.width, kept.residuals)


def test_a_training_ends_with_four_lines_and_the_next_commands(
    scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    scene = Path(shutil.copytree(scene, tmp_path / "elsewhere"))
    (scene / "generated.json").unlink()  # a capture from elsewhere, whose cameras may be worth adjusting
    options = ["--steps", "4", "--device", "cpu", "--set", "model.max_anchors=60"]
    assert main(["train", str(scene), "-o", "run", *options]) == 0
    lines = capsys.readouterr().out.splitlines()
    first = next(i for i, line in enumerate(lines) if line.startswith("run/run.cgs: "))
    said = [line for line in lines[first:] if not line.startswith("evaluating views")]
    assert len(said) == 7 and "dB" in said[1]
    assert "run/contact_sheet.png" in said[2] and "run/results.json" in said[3]
    assert [line.split("#")[0].split() for line in said[4:]] == [
        ["next:", "compgs", "view", "run/run.cgs"],
        ["next:", "compgs", "export", "run/run.cgs", "run.html"],
        ["next:", "compgs", "adjust", str(scene), "-o", f"{scene}_adjusted"],
    ]


def test_a_time_becomes_the_steps_that_fit_into_it(
    scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("compgs.compressing.pace.seconds_per_step", lambda *_: 4.0)
    monkeypatch.setattr("compgs.compressing.pace.FEWEST", 3)
    run = tmp_path / "run"
    options = ["--time", "30s", "--device", "cpu", "--set", "model.max_anchors=60"]
    assert main(["train", str(scene), "-o", str(run), *options]) == 0
    kept = json.loads((run / "config.json").read_text())
    steps = kept["settings"]["training"]["steps"]
    assert steps in (6, 7), "30 s, less what the plan took, at 4 s a step"
    assert f"steps: {steps} fit into {duration(30)}" in capsys.readouterr().out
    assert kept["plan"]["start"]["passes"] == steps / 7
    assert json.loads((run / "training.json").read_text())["steps"] == steps


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--time", "1h", "--steps", "9"], "--time chooses the steps"),
        (["--time", "soon"], "--time soon: expected a time"),
        (["--time", "1h", "--resume"], "continues with the steps the run began with"),
        (["--time", "1h", "--method", "3dgs"], "give --steps"),
    ],
)
def test_a_time_that_cannot_be_kept_is_refused(
    scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], options: list[str], message: str
) -> None:
    assert main(["train", str(scene), "-o", str(tmp_path / "run"), *options]) == 2
    assert message in capsys.readouterr().err


def test_a_plan_alone_trains_nothing(
    scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("compgs.compressing.pace.TRIED", 3)
    assert main(["train", str(scene), "--plan", "--device", "cpu", "--set", "model.max_anchors=60"]) == 0
    said = capsys.readouterr().out
    assert "training views, a point is in" in said and "residuals" in said
    assert "time: about" in said and "size not known" in said and "--time 1h" not in said
    assert list(tmp_path.iterdir()) == []


def test_the_plan_of_hours_says_how_to_have_a_shorter_run(
    scene: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("compgs.compressing.pace.seconds_per_step", lambda *_: 0.5)
    assert main(["train", str(scene), "--plan", "--device", "cpu", "--steps", "20000"]) == 0
    assert "--time 1h takes as many as fit into an hour" in capsys.readouterr().out


@pytest.mark.parametrize("options", [["--method", "3dgs"], ["--resume", "-o", "nowhere"]])
def test_there_is_no_plan_of_what_decides_nothing_or_has_begun(
    scene: Path, options: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["train", str(scene), "--plan", *options]) == 2
    assert "--plan" in capsys.readouterr().err
