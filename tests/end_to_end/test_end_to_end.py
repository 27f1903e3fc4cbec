"""The main job on a tiny scene: photographs in, one file out, views rendered from it by another process."""

import contextlib
import io
import json
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import compgs
from compgs.cli import training_command as train_command
from compgs.cli.main import main
from compgs.cli.settings import with_settings
from compgs.evaluation import camera_path
from compgs.evaluation.reduction import reduce_file
from compgs.metrics import psnr, to_8bit
from compgs.render import render
from compgs.training import TrainingStatus

STEPS = 40
CIRCLE = {"frames": 3, "width": 64, "height": 48}
OPTIONS = ["--preset", "quick", "--steps", str(STEPS), "--seed", "7"]


def in_a_new_process(*arguments: object) -> str:
    """Standard output of `compgs` with these arguments."""
    command = [sys.executable, "-m", "compgs", *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


def in_this_process(*arguments: object) -> str:
    """The same without another process."""
    with contextlib.redirect_stdout(io.StringIO()) as out:
        assert main([str(argument) for argument in arguments]) == 0
    return out.getvalue()


Compgs = Callable[..., str]


@pytest.fixture(params=[in_this_process, pytest.param(in_a_new_process, marks=pytest.mark.slow)])
def command(request: pytest.FixtureRequest) -> Compgs:
    """Standard output of `compgs` with some arguments."""
    found: Compgs = request.param
    return found


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory, scene_folder: Path) -> Path:
    """The folder of a finished run, named `tiny`."""
    folder = tmp_path_factory.mktemp("runs") / "tiny"
    assert main(["train", str(scene_folder), "-o", str(folder), *OPTIONS]) == 0
    return folder


def test_a_run_leaves_everything_it_promises(run: Path) -> None:
    names = {str(path.relative_to(run)) for path in run.rglob("*") if path.is_file()}
    views = {f"test/{kind}/0000{i}.png" for kind in ("renders", "gt") for i in range(2)}
    expected = {"tiny.cgs", "results.json", "per_view.json", "config.json", "training.json", "cameras.json"}
    assert names >= expected | views | {"contact_sheet.png", "checkpoint.safetensors"}
    assert not [name for name in names if "partial" in name]


def test_another_process_finds_what_the_training_reported(
    run: Path, scene_folder: Path, tmp_path: Path
) -> None:
    output = tmp_path / "report"
    shown = in_a_new_process("evaluate", run / "tiny.cgs", scene_folder, "-o", output)
    theirs = json.loads((run / "results.json").read_text())
    ours = json.loads((output / "results.json").read_text())
    for key in ("sha256", "bytes", "components", "anchors", "coupled_primitives", "psnr", "ssim"):
        assert ours[key] == theirs[key]
    assert ours["bytes"] == (run / "tiny.cgs").stat().st_size == sum(ours["components"].values())
    assert f"{ours['psnr']:.2f} dB" in shown
    assert f"{ours['bytes']:,} bytes" in shown


def test_held_out_views_are_recognizable_after_a_few_seconds(scene_folder: Path) -> None:
    scene = compgs.load_scene(scene_folder)
    # Few, large anchors: the scene's coarse shapes are learned in a few hundred steps.
    config = with_settings(compgs.load_config("quick"), ["training.steps=300", "model.voxel_size=0.15"])
    model = compgs.train(scene, config).as_hybrid_model()
    for view in scene.test_views:
        flat = np.broadcast_to(view.image.mean((0, 1)).round().astype(np.uint8), view.image.shape)
        assert psnr(to_8bit(render(model, view.camera).image), view.image) > psnr(flat, view.image) + 1


def test_encoding_a_run_again_gives_the_same_bytes(command: Compgs, run: Path, tmp_path: Path) -> None:
    command("encode", run, "-o", tmp_path / "again.cgs")
    assert (tmp_path / "again.cgs").read_bytes() == (run / "tiny.cgs").read_bytes()


def test_a_run_and_its_file_become_the_same_smaller_file_and_the_loss_is_stated(
    run: Path,
    scene_folder: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    smaller = ["--drop", "0.6", "--coarser", "2"]
    assert main(["encode", str(run), "-o", str(tmp_path / "a.cgs"), *smaller]) == 0
    of_run = capsys.readouterr().out
    file = str(run / "tiny.cgs")
    assert main(["encode", file, "-o", str(tmp_path / "b.cgs"), *smaller, "--scene", str(scene_folder)]) == 0
    assert (tmp_path / "a.cgs").read_bytes() == (tmp_path / "b.cgs").read_bytes()
    scene = compgs.load_scene(scene_folder)
    by_training, by_held_out = (
        reduce_file((run / "tiny.cgs").read_bytes(), drop=0.6, coarser=2, cameras=[v.camera for v in views])[
            0
        ]
        for views in (scene.train_views, scene.test_views)
    )
    assert (tmp_path / "a.cgs").read_bytes() == by_training != by_held_out
    for out in (of_run, capsys.readouterr().out):
        assert "the 14 training views" in out
        assert "held-out photographs" in out and "new renderings against old ones" in out
    monkeypatch.setattr(camera_path, "surround", lambda positions: camera_path.orbit(positions, **CIRCLE))
    assert main(["encode", file, "-o", str(tmp_path / "c.cgs"), *smaller]) == 0
    out = capsys.readouterr().out
    assert "3 cameras around the scene" in out and "held-out" not in out
    change = (tmp_path / "c.cgs").stat().st_size / (run / "tiny.cgs").stat().st_size - 1
    assert change < 0 and f"{100 * change:+.1f} %" in out


def test_symbols_do_not_depend_on_process_or_number_of_threads(run: Path, tmp_path: Path) -> None:
    in_a_new_process("decode", run / "tiny.cgs", "-o", tmp_path / "one", "--threads", 1)
    assert main(["decode", str(run / "tiny.cgs"), "-o", str(tmp_path / "all")]) == 0
    with np.load(tmp_path / "one" / "latents.npz") as one, np.load(tmp_path / "all" / "latents.npz") as every:
        assert (
            set(one)
            == set(every)
            == {"positions", "log_scales", "references", "residuals", "anchor_index", "world_offset"}
        )
        for name in one:
            np.testing.assert_array_equal(one[name], every[name])


def test_info_and_render_need_nothing_but_the_file(command: Compgs, run: Path, tmp_path: Path) -> None:
    file = tmp_path / "alone.cgs"
    file.write_bytes((run / "tiny.cgs").read_bytes())
    assert f"{file.stat().st_size:,} bytes" in command("info", file)
    circle = ["--frames", "3", "--width", "64", "--height", "48"]
    assert main(["render", str(file), *circle, "-o", str(tmp_path / "orbit")]) == 0
    assert len(list((tmp_path / "orbit").glob("*.png"))) == 3
    command("render", file, "--cameras", run / "cameras.json", "-o", tmp_path / "views")
    for image in (run / "test" / "renders").iterdir():
        assert image.read_bytes() == (tmp_path / "views" / image.name).read_bytes()


def test_a_background_that_is_asked_for_takes_the_place_of_the_files_own(run: Path, tmp_path: Path) -> None:
    """Seen from a camera that has turned its back on the scene."""
    cameras = json.loads((run / "cameras.json").read_text())[:1]
    away = np.diag([-1.0, 1.0, -1.0, 1.0]) @ np.array(cameras[0]["world_to_camera"])
    away[2, 3] -= 1000.0
    cameras[0]["world_to_camera"] = away.tolist()
    (tmp_path / "cameras.json").write_text(json.dumps(cameras))
    for option, color in ((["--background", "1", "0", "0.2"], (255, 0, 51)), ([], (0, 0, 0))):
        output = tmp_path / f"out{len(option)}"
        command = [
            "render",
            str(run / "tiny.cgs"),
            "--cameras",
            str(tmp_path / "cameras.json"),
            "-o",
            str(output),
        ]
        assert main([*command, *option]) == 0
        assert (np.asarray(Image.open(output / "00000.png")) == color).all()


def test_python_does_the_same_and_the_same_seed_gives_the_same_file(
    run: Path, scene_folder: Path, tmp_path: Path
) -> None:
    scene = compgs.load_scene(scene_folder)
    config = with_settings(compgs.load_config("quick"), [f"training.steps={STEPS}", "training.seed=7"])
    model = compgs.train(scene, config)
    compgs.encode(model, tmp_path / "python.cgs")
    assert (tmp_path / "python.cgs").read_bytes() == (run / "tiny.cgs").read_bytes()

    decoded = compgs.decode(tmp_path / "python.cgs")
    for view in scene.test_views:
        before = psnr(to_8bit(render(model.as_hybrid_model(), view.camera).image), view.image)
        after = psnr(to_8bit(render(decoded, view.camera).image), view.image)
        assert after == pytest.approx(before, abs=0.01)


@contextmanager
def stopped_half_way() -> Iterator[Callable[[TrainingStatus], None]]:
    """Instead of the display of a training: its user."""

    def stop(status: TrainingStatus) -> None:
        if status.step >= STEPS // 2:
            raise KeyboardInterrupt

    yield stop


def test_a_run_that_was_stopped_continues_to_the_same_file(
    run: Path,
    scene_folder: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    folder = tmp_path / "stopped"
    with monkeypatch.context() as patch:
        patch.setattr(train_command, "training", stopped_half_way)
        assert main(["train", str(scene_folder), "-o", str(folder), *OPTIONS]) == 130
    assert f"compgs train -o {folder} --resume" in capsys.readouterr().err
    assert not (folder / "stopped.cgs").exists()
    assert main(["encode", str(folder)]) == 1
    assert "--resume" in capsys.readouterr().err
    assert main(["train", "-o", str(folder), "--resume"]) == 0
    assert (folder / "stopped.cgs").read_bytes() == (run / "tiny.cgs").read_bytes()


@pytest.mark.parametrize(
    ("number", "code"),
    [
        pytest.param(signal.SIGINT, 130, id="Ctrl-C"),
        pytest.param(signal.SIGTERM, 143, id="SIGTERM", marks=pytest.mark.slow),
    ],
)
def test_a_process_that_is_asked_to_end_leaves_a_checkpoint_and_the_usual_code(
    scene_folder: Path, tmp_path: Path, number: signal.Signals, code: int
) -> None:
    folder = tmp_path / "asked"
    command = [
        sys.executable,
        "-m",
        "compgs",
        "train",
        str(scene_folder),
        "-o",
        str(folder),
        "--preset",
        "quick",
    ]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None and process.stderr is not None
        assert any(line.startswith("training: step 10 ") for line in process.stdout)
        process.send_signal(number)
        err = process.stderr.read()
    assert process.returncode == code
    assert err == (
        f"interrupted; the checkpoint is {folder / 'checkpoint.safetensors'}\n"
        f"continue with: compgs train -o {folder} --resume\n"
    )
    assert sorted(path.name for path in folder.iterdir()) == ["checkpoint.safetensors", "config.json"]


@pytest.mark.parametrize("ending", [["--target-size", "1"], ["--set", "model.voxel_size=1e-9"], ["stopped"]])
def test_a_finished_run_survives_its_replacement_until_that_has_a_checkpoint(
    run: Path, scene_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, ending: list[str]
) -> None:
    folder = tmp_path / "tiny"
    shutil.copytree(run, folder)
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    if ending == ["stopped"]:
        monkeypatch.setattr(train_command, "training", stopped_half_way)
    again = ["train", str(scene_folder), "-o", str(folder), *OPTIONS, "--overwrite"]
    assert main(again if ending == ["stopped"] else [*again, *ending]) == (
        130 if ending == ["stopped"] else 1
    )
    assert {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()} == before


@pytest.mark.parametrize("damage", ["truncated", "altered", "empty", "something else"])
def test_a_damaged_file_is_refused_by_every_command(
    run: Path, scene_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], damage: str
) -> None:
    data = (run / "tiny.cgs").read_bytes()
    middle = len(data) // 2
    file = tmp_path / "damaged.cgs"
    file.write_bytes(
        {
            "truncated": data[:-100],
            "altered": data[:middle] + bytes([data[middle] ^ 16]) + data[middle + 1 :],
            "empty": b"",
            "something else": b"\x89PNG\r\n\x1a\n" + bytes(1000),
        }[damage]
    )
    commands = [
        ["info", str(file)],
        ["decode", str(file), "-o", str(tmp_path / "out")],
        ["render", str(file), "-o", str(tmp_path / "out")],
        ["evaluate", str(file), str(scene_folder), "-o", str(tmp_path / "out")],
    ]
    for command in commands:
        assert main(command) == 1
        err = capsys.readouterr().err
        assert err.startswith(f"error: {file}: ")
        assert err.count("\n") == 1
    assert not (tmp_path / "out").exists()
