"""`compgs render`: ways through a scene, videos, and what becomes of old images."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import compgs
from compgs.cameras import Camera
from compgs.cli.main import main
from compgs.evaluation.camera_path import camera_entry
from compgs.evaluation.measure import timed_render
from compgs.metrics import psnr, to_8bit
from compgs.render import Renderable

SIZE = ("--width", "48", "--height", "32")


def write_path(file: Path, path: Path, count: int) -> Path:
    """A camera file of the first cameras that a file keeps."""
    cameras = compgs.decode(file).viewpoints[:count]
    path.write_text(json.dumps([camera_entry(camera, f"key {i}") for i, camera in enumerate(cameras)]))
    return path


def rendered(*arguments: object) -> int:
    return main(["render", *map(str, arguments)])


def test_a_recorded_path_is_gone_from_its_first_camera_to_its_last(tiny_cgs: Path, tmp_path: Path) -> None:
    keys = write_path(tiny_cgs, tmp_path / "path.json", 3)
    out = tmp_path / "out"
    assert rendered(tiny_cgs, "--path", keys, "--frames", 5, *SIZE, "-o", out) == 0
    model = compgs.decode(tiny_cgs)
    entries = json.loads((out / "cameras.json").read_text())
    assert len(entries) == 5 and len(list(out.glob("*.png"))) == 5
    for entry, key in ((entries[0], model.viewpoints[0]), (entries[4], model.viewpoints[2])):
        np.testing.assert_allclose(entry["world_to_camera"], key.world_to_camera, atol=1e-6)
        np.testing.assert_allclose(entry["fx"] / 48, key.fx / key.width)
    camera = model.viewpoints[0].resized(48, 36)
    image = np.asarray(Image.open(out / "00000.png"))
    expected = to_8bit(compgs.render(model, camera).image)
    assert psnr(image, expected[2:34]) > 40


def test_a_video_has_the_frames_of_the_way(tiny_cgs: Path, tmp_path: Path) -> None:
    imageio_ffmpeg = pytest.importorskip("imageio_ffmpeg")
    out = tmp_path / "tour.mp4"
    assert rendered(tiny_cgs, "--frames", 4, *SIZE, "--fps", 8, "-o", out) == 0
    assert imageio_ffmpeg.count_frames_and_secs(str(out)) == (4, 0.5)
    assert rendered(tiny_cgs, "--frames", 2, *SIZE, "-o", out) == 1  # it is there already
    assert rendered(tiny_cgs, "--frames", 2, *SIZE, "-o", out, "--overwrite") == 0
    assert imageio_ffmpeg.count_frames_and_secs(str(out))[0] == 2


def test_no_old_image_stays_among_new_ones(tiny_cgs: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    assert rendered(tiny_cgs, "--frames", 6, *SIZE, "-o", out) == 0
    (out / "notes.txt").write_text("mine")
    assert rendered(tiny_cgs, "--frames", 2, *SIZE, "-o", out, "--overwrite") == 0
    assert sorted(p.name for p in out.iterdir()) == ["00000.png", "00001.png", "cameras.json", "notes.txt"]
    assert len(json.loads((out / "cameras.json").read_text())) == 2


@pytest.mark.parametrize("reason", [MemoryError, KeyboardInterrupt])
def test_old_images_stay_until_all_new_ones_are_there(
    tiny_cgs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, reason: type[BaseException]
) -> None:
    out = tmp_path / "out"
    assert rendered(tiny_cgs, "--frames", 2, *SIZE, "-o", out) == 0
    before = {p.name: p.read_bytes() for p in out.iterdir()}

    views: list[object] = []

    def failing(model: Renderable, camera: Camera) -> tuple[np.ndarray, float]:
        views.append(camera)
        if len(views) == 2:
            raise reason
        return timed_render(model, camera)

    monkeypatch.setattr("compgs.evaluation.measure.timed_render", failing)
    others = sorted(path.name for path in tmp_path.iterdir())
    for folder in (out, tmp_path / "other"):
        views.clear()
        code = rendered(tiny_cgs, "--frames", 3, *SIZE, "-o", folder, "--overwrite")
        assert code == (130 if reason is KeyboardInterrupt else 1) and len(views) == 2
    assert {p.name: p.read_bytes() for p in out.iterdir()} == before
    assert sorted(path.name for path in tmp_path.iterdir()) == others


def test_wrong_paths_are_named(tiny_cgs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    one = write_path(tiny_cgs, tmp_path / "one.json", 1)
    for path, complaint in (("circle", "expected cameras, orbit or a camera file"), (one, "found 1")):
        assert rendered(tiny_cgs, "--path", path, "-o", tmp_path / "out") == 2
        assert f"--path {path}: " in (error := capsys.readouterr().err) and complaint in error
    assert rendered(tiny_cgs, tmp_path, "--path", write_path(tiny_cgs, one, 2), "-o", tmp_path / "out") == 2
    assert not (tmp_path / "out").exists()


def test_the_circle_is_not_turned_where_a_file_has_cameras_of_its_own(
    tiny_cgs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert rendered(tiny_cgs, "--up", 0, 0, 1, "-o", tmp_path / "out") == 2
    assert "--up: of the circle around the scene; give it with --path orbit" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
    assert (
        rendered(tiny_cgs, "--path", "orbit", "--up", 0, 0, 1, "--frames", 1, *SIZE, "-o", tmp_path / "out")
        == 0
    )


def test_a_video_of_cameras_of_two_sizes_is_refused(
    tiny_cgs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("imageio_ffmpeg")
    one = compgs.decode(tiny_cgs).viewpoints[0]
    cameras = tmp_path / "cameras.json"
    cameras.write_text(json.dumps([camera_entry(one, "a"), camera_entry(one.resized(32, 24), "b")]))
    assert rendered(tiny_cgs, "--cameras", cameras, "-o", tmp_path / "out.mp4") == 2
    assert "32 x 24, 64 x 48; name a folder" in capsys.readouterr().err
    assert not (tmp_path / "out.mp4").exists()


def test_without_ffmpeg_a_video_is_refused_before_anything_is_read(
    tmp_path: Path, tiny_cgs: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    assert rendered(tiny_cgs, tmp_path / "nowhere", "-o", tmp_path / "out.mp4") == 1
    assert "pip install '.[video]' in the project's folder" in capsys.readouterr().err


@pytest.mark.parametrize("kind", ["gif", "webp"])
def test_an_animation_has_the_frames_of_the_way_and_their_pace(
    tiny_cgs: Path, tmp_path: Path, kind: str
) -> None:
    out = tmp_path / f"tour.{kind}"
    assert rendered(tiny_cgs, "--frames", 4, *SIZE, "--fps", 10, "-o", out) == 0
    assert rendered(tiny_cgs, "--frames", 4, *SIZE, "-o", tmp_path / "images") == 0
    with Image.open(out) as animation:
        assert (animation.format, animation.n_frames, animation.size) == (kind.upper(), 4, (48, 32))
        animation.load()
        assert animation.info["duration"] == 100 and animation.info["loop"] == 0
        for i in range(4):
            animation.seek(i)
            image = np.asarray(Image.open(tmp_path / "images" / f"{i:05d}.png"))
            assert psnr(np.asarray(animation.convert("RGB")), image) > 25


def test_a_label_stands_in_the_corner_and_leaves_the_rest_of_the_picture(
    tiny_cgs: Path, tmp_path: Path
) -> None:
    size = ("--width", 200, "--height", 120)
    assert rendered(tiny_cgs, "--frames", 1, *size, "-o", tmp_path / "plain") == 0
    assert rendered(tiny_cgs, "--frames", 1, *size, "--label", "{bytes}", "-o", tmp_path / "labelled") == 0
    assert rendered(tiny_cgs, "--frames", 1, *size, "--label", "other", "-o", tmp_path / "other") == 0
    plain, labelled, other = (
        np.asarray(Image.open(tmp_path / name / "00000.png")) for name in ("plain", "labelled", "other")
    )
    changed = np.argwhere((plain != labelled).any(2))
    assert len(changed) > 50 and changed[:, 0].min() > 80 and changed[:, 1].max() < 120
    assert (labelled != other).any(), "the words are those that were asked for"


@pytest.mark.parametrize("name", ["out.webm", "out.PNG", "out.mov"])
def test_files_that_are_not_written_are_refused(
    tiny_cgs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    assert rendered(tiny_cgs, "-o", tmp_path / name) == 2
    assert "a folder for PNG images, or a name that ends in .mp4, .webp or .gif" in capsys.readouterr().err
    assert not (tmp_path / name).exists()


@pytest.mark.parametrize(
    ("options", "size"),
    [((), (640, 480)), (("--width", 100), (100, 76)), (("--height", 60), (80, 60)), (SIZE, (48, 32))],
)
def test_images_of_a_way_have_the_shape_of_the_captures_pictures(
    tiny_cgs: Path, tmp_path: Path, options: tuple[object, ...], size: tuple[int, int]
) -> None:
    """Those of the file are 64 x 48."""
    assert rendered(tiny_cgs, "--frames", 1, *options, "-o", tmp_path / "out") == 0
    assert Image.open(tmp_path / "out" / "00000.png").size == size
