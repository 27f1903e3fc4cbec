"""A written video is one: ffmpeg reads its frames back as they were."""

import sys
from pathlib import Path

import numpy as np
import pytest

from compgs.errors import MissingDependency, OutputError
from compgs.evaluation.video import write_video

imageio_ffmpeg = pytest.importorskip("imageio_ffmpeg")


def moving_square(i: int, width: int, height: int) -> np.ndarray:
    """On a gradient, both in color."""
    y, x = np.mgrid[:height, :width]
    frame = np.stack([255 * x / width, 255 * y / height, np.full_like(x, 90)], axis=2)
    frame[20:40, 10 + 4 * i : 30 + 4 * i] = (200, 40, 220)
    return frame.astype(np.uint8)


def test_frames_are_read_back_as_they_were_written(tmp_path: Path) -> None:
    frames = [moving_square(i, 120, 80) for i in range(12)]
    path = tmp_path / "new" / "out.mp4"
    assert write_video(path, iter(frames), frames_per_second=24) == 12
    reader = imageio_ffmpeg.read_frames(str(path))
    meta = next(reader)
    found = [np.frombuffer(data, np.uint8).reshape(80, 120, 3) for data in reader]
    assert meta["size"] == (120, 80) and meta["fps"] == 24 and meta["codec"] == "h264"
    assert len(found) == 12
    for written, read in zip(frames, found, strict=True):
        assert np.abs(written.astype(int) - read).mean() < 3
    assert [p.name for p in path.parent.iterdir()] == ["out.mp4"]
    head = path.read_bytes()
    assert head.index(b"moov") < head.index(b"mdat")  # plays while it arrives


def test_odd_sides_grow_by_a_pixel(tmp_path: Path) -> None:
    write_video(tmp_path / "odd.mp4", [moving_square(0, 99, 61)] * 2, frames_per_second=10)
    assert next(imageio_ffmpeg.read_frames(str(tmp_path / "odd.mp4")))["size"] == (100, 62)


def test_what_fails_leaves_the_old_video(tmp_path: Path) -> None:
    path = tmp_path / "out.mp4"
    path.write_bytes(b"old")

    def broken() -> "object":
        yield moving_square(0, 64, 48)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_video(path, broken(), frames_per_second=10)  # type: ignore[arg-type]
    with pytest.raises(OutputError, match="no frames"):
        write_video(path, [], frames_per_second=10)
    assert path.read_bytes() == b"old" and len(list(tmp_path.iterdir())) == 1


def test_without_ffmpeg_the_install_line_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(MissingDependency, match=r"pip install '.\[video\]'.*PNG frames"):
        write_video(tmp_path / "out.mp4", [moving_square(0, 64, 48)], frames_per_second=10)
