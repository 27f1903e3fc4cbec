"""Frames as an .mp4 that every browser and player shows (H.264), by the ffmpeg that imageio-ffmpeg brings along."""

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from compgs.errors import MissingDependency, OutputError, install_line
from compgs.outputs import replacing

QUALITY = 8  # of imageio-ffmpeg's 0 to 10: hardly any loss to be seen
# The file is at a temporary place whose name says nothing; its index comes first, so that it plays while it arrives.
FFMPEG_OPTIONS = (
    *("-f", "mp4", "-movflags", "+faststart"),
    # What players take a video of any size for, if it says nothing, differs: it says what its colors are.
    *("-vf", "scale=out_color_matrix=bt709:out_range=tv", "-colorspace", "bt709"),
    *("-color_primaries", "bt709", "-color_trc", "bt709"),
)


def check_video() -> None:
    """Raises MissingDependency, with the remedy, where no video can be written."""
    try:
        import imageio_ffmpeg

        imageio_ffmpeg.get_ffmpeg_exe()
    except (ImportError, RuntimeError) as error:
        raise MissingDependency(
            f"an .mp4 needs imageio-ffmpeg: {install_line('video')}; PNG frames in a folder need nothing"
        ) from error


def write_video(
    path: Path,
    frames: Iterable[np.ndarray],  # [H, W, 3] uint8, all of one size
    *,
    frames_per_second: float,
) -> int:
    """Write an .mp4, whole or not at all; how many frames it has.

    Sides that are odd grow by a pixel, which repeats the last one: the color format has one color for four pixels.
    Raises MissingDependency, OutputError.
    """
    check_video()
    import imageio_ffmpeg

    count, writer = 0, None
    with replacing(path) as temporary:
        try:
            for frame in frames:
                height, width = frame.shape[:2]
                if writer is None:
                    size = width + width % 2, height + height % 2
                    writer = imageio_ffmpeg.write_frames(
                        str(temporary),
                        size,
                        fps=frames_per_second,
                        codec="libx264",
                        quality=QUALITY,
                        macro_block_size=1,
                        output_params=list(FFMPEG_OPTIONS),
                    )
                    writer.send(None)
                padded = np.pad(frame, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
                writer.send(np.ascontiguousarray(padded))
                count += 1
        except OSError as error:
            raise OutputError(f"{path}: ffmpeg cannot write it ({error})") from error
        finally:
            if writer is not None:
                writer.close()
        if not count:
            raise OutputError(f"{path}: there are no frames to write")
    return count
