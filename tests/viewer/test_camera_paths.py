"""A recorded path is what was recorded, survives its file, and becomes a film."""

import io
import json
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from compgs.cameras import Camera
from compgs.errors import SceneError, UnsupportedCamera
from compgs.evaluation.camera_path import read_cameras
from compgs.viewer import camera_paths
from compgs.viewer.camera_paths import RECORD_SECONDS, CameraPath, filmed

from .test_picture import looking


def flight(count: int) -> list[Camera]:
    return [looking(np.array([4.5e6 + i, 0.3, -2.0]), np.array([4.5e6 + i, 0.0, 7.0])) for i in range(count)]


def test_a_path_survives_its_file_which_is_a_camera_file(tmp_path: Path) -> None:
    path = CameraPath(flight(3))
    (tmp_path / "path.json").write_bytes(path.content())
    for found in (
        CameraPath.of(path.content(), "path.json").views,
        [c for _, c in read_cameras(tmp_path / "path.json")],
    ):
        for a, b in zip(path.views, found, strict=True):
            np.testing.assert_array_equal(a.world_to_camera, b.world_to_camera)
            assert (a.fx, a.fy, a.cx, a.cy, a.width, a.height) == (b.fx, b.fy, b.cx, b.cy, b.width, b.height)


@pytest.mark.parametrize(
    "content", [b"\xff", b"{}", b"[1]", b"[]", b"[" * 100_000, json.dumps([{"fx": 1}]).encode()]
)
def test_what_is_no_path_is_refused_with_its_name(content: bytes) -> None:
    with pytest.raises(SceneError, match=r"^mine\.json: "):
        CameraPath.of(content, "mine.json")


def test_no_path_has_more_views_than_there_is_room_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(camera_paths, "MOST_VIEWS", 2)
    path = CameraPath()
    for camera in flight(3):
        path.add(camera)
    assert len(path.views) == 2
    with pytest.raises(SceneError, match="3 cameras; expected at most 2"):
        CameraPath.of(CameraPath(flight(3)).content(), "long.json")


def test_a_flight_is_recorded_now_and_then_and_only_while_it_moves() -> None:
    path, (a, b, c) = CameraPath(), flight(3)
    step = RECORD_SECONDS
    told = [(a, 0.0), (b, 0.1 * step), (b, 1.1 * step), (b, 2.2 * step), (c, 2.3 * step), (c, 3.0 * step)]
    assert [path.record(camera, 50 + now) for camera, now in told] == [True, False, True, False, True, False]
    assert path.views == [a, b, c]
    path.remove_last()
    assert path.views == [a, b]
    path.clear()
    path.remove_last()
    with pytest.raises(UnsupportedCamera, match="found 0"):
        path.frames(5, 64, 48)


def drawn(camera: Camera) -> np.ndarray:
    """A color that says where the camera is."""
    return np.full((camera.height, camera.width, 3), round(40 * (camera.center[0] - 4.5e6)), np.uint8)


def test_a_film_has_a_frame_for_each_camera(tmp_path: Path) -> None:
    imageio_ffmpeg = pytest.importorskip("imageio_ffmpeg")
    told: list[tuple[int, int]] = []
    cameras = CameraPath(flight(3)).frames(5, 64, 48)
    name, content = filmed(cameras, drawn, "garden", 10, lambda done, total: told.append((done, total)))
    assert name == "garden.mp4" and told == [(i + 1, 5) for i in range(5)]
    (tmp_path / name).write_bytes(content)
    reader = imageio_ffmpeg.read_frames(str(tmp_path / name))
    assert next(reader)["size"] == (64, 48)
    shades = [np.frombuffer(frame, np.uint8).mean() for frame in reader]
    np.testing.assert_allclose(shades, [0, 20, 40, 60, 80], atol=3)


def test_without_ffmpeg_a_film_is_a_zip_of_frames(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    name, content = filmed(flight(3), drawn, "garden", 10, lambda *_: None)
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        assert name == "garden.zip" and archive.namelist() == ["00000.png", "00001.png", "00002.png"]
        image = np.asarray(Image.open(archive.open("00002.png")))
    assert image.shape == (140, 200, 3) and (image == 80).all()


def test_a_film_that_is_stopped_ends_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    count = 0

    def progress(done: int, total: int) -> None:
        nonlocal count
        count = done
        raise KeyError

    for missing in (False, True):
        if missing:
            monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
        with pytest.raises(KeyError):
            filmed(flight(9), drawn, "garden", 10, progress)
        assert count == 1
