"""The layout of nerfstudio and instant-ngp: one `transforms.json` with all frames."""

from pathlib import Path

from compgs.errors import SceneError
from compgs.scene.capture import Capture
from compgs.scene.frames import read_frames
from compgs.scene.points_of_frames import points_of
from compgs.scene.split_names import split_by_names


def read_nerfstudio(folder: Path) -> Capture:
    """The capture of `folder/transforms.json`."""
    file = folder / "transforms.json"
    frames = read_frames(file)
    if not frames.images:
        raise SceneError(f"{file}: no frames; expected at least two views")
    points, ply, of_points = points_of(frames.values, file)
    used, held_out, of_split = split_by_names(frames.images, frames.values, str(file))
    return Capture(
        used,
        held_out,
        points,
        str(file),
        (0.0, 0.0, 0.0),
        notes=(*frames.notes, *of_points, *of_split),
        files=(file, *ply),
        split=f"lists of {file.name}" if held_out is not None else "",
    )
