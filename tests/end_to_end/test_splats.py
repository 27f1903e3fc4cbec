"""Plain 3DGS from the command line: photographs in, a .ply out, evaluated and rendered by the code of .cgs files."""

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from compgs.cli import training_command as train_command
from compgs.cli.main import main
from compgs.formats import read_ply
from compgs.metrics import psnr
from compgs.training import TrainingStatus

STEPS = 250
OPTIONS = [
    "--method",
    "3dgs",
    "--steps",
    str(STEPS),
    "--seed",
    "7",
]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory, scene_folder: Path) -> Path:
    """The folder of a finished run, named `tiny`."""
    folder = tmp_path_factory.mktemp("runs") / "tiny"
    assert main(["train", str(scene_folder), "-o", str(folder), *OPTIONS]) == 0
    return folder


def test_a_run_leaves_everything_that_one_of_the_other_method_does(run: Path) -> None:
    names = {str(path.relative_to(run)) for path in run.rglob("*") if path.is_file()}
    views = {f"test/{kind}/0000{i}.png" for kind in ("renders", "gt") for i in range(2)}
    expected = {"tiny.ply", "results.json", "per_view.json", "config.json", "training.json", "cameras.json"}
    assert names == expected | views | {"contact_sheet.png", "checkpoint.safetensors"}


def test_results_are_of_the_file(run: Path) -> None:
    results = json.loads((run / "results.json").read_text())
    splats = len(read_ply(run / "tiny.ply"))
    assert results["file"] == "tiny.ply"
    assert results["bytes"] == (run / "tiny.ply").stat().st_size == sum(results["components"].values())
    assert results["components"]["harmonics"] == 180 * splats
    training = json.loads((run / "training.json").read_text())
    assert results["splats"] == training["splats"] == training["curve"]["primitives"][-1] == splats
    assert training["curve"]["step"][-1] == training["steps"]
    assert results["bits_per_splat"] == pytest.approx(8 * results["bytes"] / splats)
    assert results["anchors"] is results["bits_per_anchor"] is results["coupled_primitives"] is None


def test_held_out_views_are_recognizable(run: Path) -> None:
    for path in (run / "test" / "gt").iterdir():
        photograph = np.asarray(Image.open(path))
        rendering = np.asarray(Image.open(run / "test" / "renders" / path.name))
        flat = np.broadcast_to(photograph.mean((0, 1)).round().astype(np.uint8), photograph.shape)
        assert psnr(rendering, photograph) > psnr(flat, photograph) + 1


def test_evaluating_and_rendering_the_file_again_gives_the_same(
    run: Path, scene_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "alone.ply"
    file.write_bytes((run / "tiny.ply").read_bytes())
    assert main(["evaluate", str(file), str(scene_folder), "-o", str(tmp_path / "report")]) == 0
    assert f"{file.stat().st_size:,} bytes" in capsys.readouterr().out
    theirs = json.loads((run / "results.json").read_text())
    ours = json.loads((tmp_path / "report" / "results.json").read_text())
    for key in ("sha256", "bytes", "components", "splats", "psnr", "ssim"):
        assert ours[key] == theirs[key]
    assert main(["render", str(file), str(scene_folder), "-o", str(tmp_path / "views")]) == 0
    for image in (run / "test" / "renders").iterdir():
        assert image.read_bytes() == (tmp_path / "views" / image.name).read_bytes()
    circle = ["--frames", "2", "--width", "64", "--height", "48", "--background", "1", "0", "0"]
    assert main(["render", str(file), *circle, "-o", str(tmp_path / "orbit")]) == 0
    assert len(list((tmp_path / "orbit").glob("*.png"))) == 2


@pytest.mark.slow
def test_a_run_that_was_stopped_continues_to_the_same_file(
    run: Path,
    scene_folder: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    @contextmanager
    def stopped_on_the_way() -> Iterator[Callable[[TrainingStatus], None]]:
        def stop(status: TrainingStatus) -> None:
            if status.step >= 120:
                raise KeyboardInterrupt

        yield stop

    folder = tmp_path / "stopped"
    with monkeypatch.context() as patch:
        patch.setattr(train_command, "training", stopped_on_the_way)
        assert main(["train", str(scene_folder), "-o", str(folder), *OPTIONS]) == 130
    assert f"compgs train -o {folder} --resume" in capsys.readouterr().err
    assert not (folder / "stopped.ply").exists()
    assert main(["encode", str(folder)]) == 1
    assert "method 3dgs" in capsys.readouterr().err
    assert main(["train", "-o", str(folder), "--resume"]) == 0
    assert (folder / "stopped.ply").read_bytes() == (run / "tiny.ply").read_bytes()
