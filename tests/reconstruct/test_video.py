"""Frames of a video that was made here, of which the sharp ones are known."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageFilter

from compgs.errors import SceneError
from compgs.reconstruct.video import is_video, sharpest_frames, sharpness

SHARP = (2, 9, 11, 17)  # one in each stretch of five frames


def frame(index: int) -> np.ndarray:
    """[48, 64, 3] uint8: a pattern in the frame's own shade, blurred unless it is one of the sharp ones."""
    pixels = np.zeros((48, 64, 3), np.uint8)
    pixels[:, (np.arange(64) // 4) % 2 == 0] = 60 + 8 * index
    image = Image.fromarray(pixels)
    return np.asarray(image if index in SHARP else image.filter(ImageFilter.GaussianBlur(3)))


@pytest.fixture(scope="module")
def video(tmp_path_factory: pytest.TempPathFactory) -> Path:
    ffmpeg = pytest.importorskip("imageio_ffmpeg", reason="the extra `reconstruct` is not installed")
    path = tmp_path_factory.mktemp("video") / "walk.mp4"
    writer = ffmpeg.write_frames(str(path), (64, 48), fps=10, quality=10, macro_block_size=16)
    writer.send(None)
    for index in range(20):
        writer.send(np.ascontiguousarray(frame(index)))
    writer.close()
    return path


def test_the_sharpest_frame_of_each_stretch_is_taken(video: Path) -> None:
    taken = list(sharpest_frames(video, 4))
    shades = [round((int(f[..., 1].max()) - 60) / 8) for f in taken]
    assert np.abs(np.array(shades) - SHARP).max() <= 1  # the video's compression moves shades a little
    assert len(taken) == 4


def test_all_frames_are_taken_where_more_are_asked_for_than_there_are(video: Path) -> None:
    assert len(list(sharpest_frames(video, 100))) == 20


def test_sharpness_falls_with_blur() -> None:
    image = Image.fromarray(frame(SHARP[0]))
    values = [sharpness(np.asarray(image.filter(ImageFilter.GaussianBlur(r)))) for r in (0, 1, 2, 4)]
    assert values == sorted(values, reverse=True) and values[0] > 4 * values[2]


def test_what_is_no_video_is_said(tmp_path: Path) -> None:
    pytest.importorskip("imageio_ffmpeg", reason="the extra `reconstruct` is not installed")
    path = tmp_path / "broken.mp4"
    path.write_bytes(b"no video")
    with pytest.raises(SceneError, match=r"broken\.mp4: cannot be read as a video"):
        next(sharpest_frames(path, 4))
    assert is_video(path) and not is_video(tmp_path)
