"""A run's folder, or its file, says how its scene is read; a file elsewhere tells what it does not fit."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from compgs.cameras import Camera
from compgs.cli.main import main
from compgs.cli.run_folder import RunSettings, SceneSource, save_settings
from compgs.codec.decoder import decode
from compgs.config import Config
from compgs.evaluation.camera_path import orbit

SIZE = (128, 96)  # twice that of the cameras that the file keeps


def write_scene(folder: Path, cameras: list[Camera]) -> None:
    """A nerfstudio scene of flat photographs; the first and the ninth view are held out."""
    (folder / "images").mkdir(parents=True)
    frames = []
    for i, camera in enumerate(cameras):
        large = camera.resized(*SIZE)
        matrix = np.linalg.inv(large.world_to_camera) @ np.diag([1.0, -1, -1, 1])
        name = f"images/{i:02d}.png"
        Image.new("RGB", SIZE, (10 * i, 100, 50)).save(folder / name)
        values = {
            "w": SIZE[0],
            "h": SIZE[1],
            "fl_x": large.fx,
            "fl_y": large.fy,
            "cx": large.cx,
            "cy": large.cy,
        }
        frames.append({"file_path": name, "transform_matrix": matrix.tolist(), **values})
    (folder / "transforms.json").write_text(json.dumps({"frames": frames}))


@pytest.fixture
def run(tmp_path: Path, tiny_cgs: Path) -> Path:
    """A folder as `compgs train scene -o garden -r 2` leaves it."""
    kept = list(decode(tiny_cgs).viewpoints)
    others = [camera for _, camera in orbit(np.eye(3), frames=2, width=64, height=48, elevation=70.0)]
    write_scene(tmp_path / "scene", [others[0], *kept[:7], others[1], *kept[7:]])
    folder = tmp_path / "garden"
    source = SceneSource(str(tmp_path / "scene"), 2, "images", 8, True, None)
    save_settings(folder, RunSettings("quick", source, Config()))
    shutil.move(tiny_cgs, folder / "garden.cgs")
    return folder


def outcome(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str]:
    """The exit code, and what was said beside the results, but for kernels that are compiled on their first use."""
    code = main(list(map(str, arguments)))
    lines = capsys.readouterr().err.splitlines(keepends=True)
    return code, "".join(line for line in lines if not line.startswith("compiling"))


def results(folder: Path) -> dict:
    return json.loads((folder / "results.json").read_text())


def test_a_run_and_its_file_are_evaluated_as_it_was_trained(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, run: Path
) -> None:
    file, scene = run / "garden.cgs", tmp_path / "scene"
    for name, arguments in (
        ("run", [run]),
        ("file", [file]),
        ("moved", [run, scene]),
        ("by hand", [file, scene, "-r", 2]),
    ):
        code, err = outcome(capsys, "evaluate", *arguments, "-o", tmp_path / name)
        assert (code, err) == (0, "")
        assert results(tmp_path / name)["width"] == 64
        assert results(tmp_path / name)["views"] == 2
        assert results(tmp_path / name)["psnr"] == results(tmp_path / "run")["psnr"]
        assert results(tmp_path / name)["notes"] == []


def test_results_as_json_are_those_of_the_folder_and_alone_on_standard_output(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, run: Path
) -> None:
    assert main(["evaluate", str(run), "--json", "-o", str(tmp_path / "out")]) == 0
    found = json.loads(capsys.readouterr().out)
    views = found.pop("per_view")
    assert found == results(tmp_path / "out")
    assert views == json.loads((tmp_path / "out" / "per_view.json").read_text())


def test_options_go_before_the_settings_of_the_run_and_what_differs_is_said(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, run: Path
) -> None:
    for arguments in (
        [run, "--test-every", 2],
        [run / "garden.cgs", tmp_path / "scene", "-r", 2, "--test-every", 2],
    ):
        code, err = outcome(capsys, "evaluate", *arguments)
        assert code == 0
        assert "garden.cgs was trained with --test-every 8 (now 2)" in err
        assert "-r " not in err


def test_a_file_alone_tells_resolution_split_and_scene(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, run: Path
) -> None:
    file, scene = tmp_path / "alone.cgs", tmp_path / "scene"
    shutil.copy(run / "garden.cgs", file)
    code, err = outcome(capsys, "evaluate", file, scene)
    assert code == 0 and err.count("\n") == 1
    assert err.startswith(
        "warning: trained on images of 64 x 48 pixels, evaluated on 128 x 96, 2 times larger"
    )
    assert "(-r)" in err
    code, err = outcome(capsys, "evaluate", file, scene, "-r", 2, "--test-every", 2)
    assert code == 0 and err.count("\n") == 1
    assert "held out here" in err and "(--test-every)" in err
    shutil.rmtree(scene)
    write_scene(scene, [camera for _, camera in orbit(np.eye(3), frames=9, width=64, height=48)])
    code, err = outcome(capsys, "evaluate", file, scene, "-r", 2)
    assert code == 0 and err.startswith("warning: another scene")


def test_a_run_renders_its_own_held_out_views(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, run: Path
) -> None:
    code, err = outcome(capsys, "render", run, "-o", tmp_path / "views")
    assert (code, err) == (0, "")
    cameras = json.loads((tmp_path / "views" / "cameras.json").read_text())
    assert [camera["name"] for camera in cameras] == ["images/00.png", "images/08.png"]
    assert Image.open(tmp_path / "views" / "00000.png").size == (64, 48)
    code, _ = outcome(capsys, "render", run, "--path", "cameras", "--frames", 3, "-o", tmp_path / "way")
    assert code == 0 and len(list((tmp_path / "way").glob("*.png"))) == 3


@pytest.mark.parametrize("command", ["evaluate", "render"])
def test_a_run_without_its_file_says_how_it_goes_on(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, run: Path, command: str
) -> None:
    (run / "garden.cgs").unlink()
    rest = ["-o", tmp_path / "out"]
    code, err = outcome(capsys, command, run, *rest)
    assert code == 1 and err.count("\n") == 1
    assert "has not written garden.cgs yet" in err and f"compgs train -o {run} --resume" in err


def test_a_file_beside_a_run_is_not_the_runs(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, run: Path
) -> None:
    shutil.copy(run / "garden.cgs", run / "other.cgs")
    code, err = outcome(capsys, "evaluate", run / "other.cgs")
    assert code == 2 and "no scene was given" in err
    (run / "config.json").write_text("rubbish")
    code, err = outcome(capsys, "evaluate", run / "garden.cgs", tmp_path / "scene", "-r", 2)
    assert (code, err) == (0, "")
    code, err = outcome(capsys, "evaluate", run)
    assert code == 1 and "config.json: not the settings of a run" in err
