"""The ablation program around trainings that are made up: what is run, what is not run again, what is written."""

import json
import sys
from pathlib import Path

import pytest

sys.path.append(str(Path(__file__).parents[1] / "benchmarks"))

import ablation
from ablation_tables import bits_each, paired_differences, rows_of

from compgs.cli.main import parse
from compgs.cli.run_folder import save_settings
from compgs.cli.train import Train
from compgs.evaluation.reports.summary import front


class Trainings:
    """Stands for `compgs`: leaves the results of a run, the better the larger its file."""

    def __init__(self) -> None:
        self.commands: list[list[str]] = []

    def __call__(self, arguments: list[str]) -> None:
        self.commands.append(arguments)
        folder = Path(arguments[arguments.index("-o") + 1])
        lmbda = float(arguments[arguments.index("--lmbda") + 1]) if "--lmbda" in arguments else 0.001
        count = round(100_000 / (1 + 100 * lmbda))
        results = {
            "psnr": 20 + count / 2e4 + 0.1 * ("paper" not in arguments), "ssim": 0.9, "lpips": None, "bytes": count,
            "anchors": 100, "coupled_primitives": 800, "views": 12, "width": 60, "height": 45, "threads": 1,
            "components": {"positions": 1000, "residual embeddings": 2000, "container": count - 3000},
        }  # fmt: skip
        (folder / "results.json").write_text(json.dumps(results))
        (folder / "training.json").write_text(json.dumps({"steps": 60}))
        train = parse(arguments)
        assert isinstance(train, Train)
        if not train.resume:
            save_settings(folder, train.settings(folder))


@pytest.mark.parametrize("name", list(ablation.STUDIES))
def test_every_variant_is_a_command_line_that_compgs_understands(name: str, tmp_path: Path) -> None:
    for variant in ablation.STUDIES[name]:
        command = ablation.train_command(
            variant, Path("scene"), tmp_path, ["-r", "8", "--preset", "quick", "--steps", "60"], seed=3
        )
        train = parse(command)
        assert isinstance(train, Train)
        config = train.settings(tmp_path).config
        assert (config.training.steps, config.training.seed) == (60, 3)


def study(tmp_path: Path, trainings: Trainings, name: str, *more: str) -> str:
    arguments = [
        name,
        str(tmp_path / "scene"),
        "-o",
        str(tmp_path / "out"),
        "--runs",
        str(tmp_path / "runs"),
        *more,
    ]
    ablation.main(arguments, trainings)
    return (tmp_path / "out" / f"ablation_{name}_scene.md").read_text()


@pytest.mark.slow
def test_a_finished_variant_is_not_run_again_unless_its_settings_change(tmp_path: Path) -> None:
    trainings = Trainings()
    first = study(tmp_path, trainings, "bitstream", "--seeds", "0", "1", "--steps", "60")
    assert len(trainings.commands) == 6
    assert study(tmp_path, trainings, "bitstream", "--seeds", "0", "1", "--steps", "60") == first
    assert len(trainings.commands) == 6
    study(tmp_path, trainings, "bitstream", "--seeds", "0", "1", "--steps", "80")
    assert len(trainings.commands) == 12


def test_what_another_study_has_trained_is_not_trained_again(tmp_path: Path) -> None:
    trainings = Trainings()
    study(tmp_path, trainings, "curve", "--only", "paper_0.001", "paper_0.01")
    before = len(trainings.commands)
    text = study(tmp_path, trainings, "bitstream", "--preset", "paper")
    assert len(trainings.commands) == before + 1  # lambda = 0.005
    assert "| lambda = 0.001 | 24.55 |" in text
    study(tmp_path, trainings, "coupled", "--preset", "paper", "--set", "training.lmbda=0.001")
    assert len(trainings.commands) == before + 3  # K = 5 and 15


def test_a_setting_that_an_older_record_lacks_counts_as_its_default(tmp_path: Path) -> None:
    trainings = Trainings()
    study(tmp_path, trainings, "coupled", "--only", "k5")
    record = tmp_path / "runs" / "coupled" / "scene_k5_seed0.json"
    known = json.loads(record.read_text())
    del known["settings"]["settings"]["training"]["exposure"], known["settings"]["method"]
    record.write_text(json.dumps(known))
    study(tmp_path, trainings, "coupled", "--only", "k5")
    assert len(trainings.commands) == 1
    study(tmp_path, trainings, "coupled", "--only", "k5", "--set", "training.exposure=true")
    assert len(trainings.commands) == 2


def test_a_variant_that_was_stopped_continues(tmp_path: Path) -> None:
    folder = tmp_path / "runs" / "coupled" / "scene_k5_seed0"

    class Stopped(Trainings):
        def __call__(self, arguments: list[str]) -> None:
            if "--resume" not in arguments:
                (folder / "checkpoint.safetensors").write_bytes(b"half way")
                raise KeyboardInterrupt
            super().__call__(arguments)

    trainings = Stopped()
    with pytest.raises(KeyboardInterrupt):
        study(tmp_path, trainings, "coupled", "--only", "k5")
    study(tmp_path, trainings, "coupled", "--only", "k5")
    assert trainings.commands == [["train", "-o", str(folder), "--resume"]]


def test_a_variant_that_another_version_began_starts_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Stopped(Trainings):
        def __call__(self, arguments: list[str]) -> None:
            (tmp_path / "runs" / "coupled" / "scene_k5_seed0" / "checkpoint.safetensors").write_bytes(b"half")
            raise KeyboardInterrupt

    monkeypatch.setattr(ablation, "git_commit", lambda: "first")
    with pytest.raises(KeyboardInterrupt):
        study(tmp_path, Stopped(), "coupled", "--only", "k5")
    monkeypatch.setattr(ablation, "git_commit", lambda: "second")
    trainings = Trainings()
    study(tmp_path, trainings, "coupled", "--only", "k5")
    assert ["--resume" in command for command in trainings.commands] == [False]


def test_the_report_says_what_the_runs_said(tmp_path: Path) -> None:
    text = study(tmp_path, Trainings(), "bitstream")
    assert "| lambda = 0.001 | 24.65 | 0.9000 | 90,909 | 100 | 800 |" in text
    assert "12 held-out views, 60 x 45 pixels; 60 steps; seeds 0; commit " in text
    assert "| residual embeddings | 2,000 | 2,000 | 2,000 |" in text
    assert (
        "| bits per anchor primitive | 80.0 | 80.0 | 80.0 |" in text
    )  # 1000 bytes of positions, 100 anchors
    assert "| bits per coupled primitive | 20.0 | 20.0 | 20.0 |" in text
    whole = json.loads((tmp_path / "out" / "ablation_bitstream_scene.json").read_text())
    assert {"commit", "machine", "seed", "seconds", "command"} <= whole["records"][0].keys()
    assert (tmp_path / "out" / "ablation_bitstream_scene.png").read_bytes().startswith(b"\x89PNG")


def test_curves_are_compared_by_bd_rate(tmp_path: Path) -> None:
    text = study(tmp_path, Trainings(), "curve")
    assert "BD-rate of default against paper by PSNR: -" in text
    assert "PSNR is not always" not in text and "paper: SSIM is not always better with more bytes" in text
    assert "FLIP" not in text


def test_spreads_and_paired_differences_are_over_seeds() -> None:
    def record(variant: str, seed: int, psnr: float) -> dict:
        results = {
            "psnr": psnr,
            "ssim": 0.9,
            "bytes": 8000,
            "anchors": 10,
            "coupled_primitives": 80,
            "components": {},
        }
        return {
            "variant": variant,
            "label": variant,
            "curve": "",
            "seed": seed,
            "seconds": 1.0,
            "results": results,
        }

    records = [record("a", 0, 20.0), record("a", 1, 22.0), record("b", 0, 21.0), record("b", 1, 23.2)]
    rows = rows_of(records)
    assert [row.psnr for row in rows] == pytest.approx([21.0, 22.1])
    assert rows[0].psnr_spread == pytest.approx(2**0.5)
    assert paired_differences(records) == ["b minus a, same seeds: +1.10 ± 0.14 dB over 2"]
    assert bits_each(rows[0]) == (0.0, 0.0)


def test_a_point_that_a_smaller_file_beats_is_not_on_the_front() -> None:
    curve = [(300.0, 30.0), (100.0, 28.0), (200.0, 27.0), (400.0, 30.0), (250.0, 29.0)]
    assert front(curve) == [(100.0, 28.0), (250.0, 29.0), (300.0, 30.0)]
    assert front(front(curve)) == front(curve)
