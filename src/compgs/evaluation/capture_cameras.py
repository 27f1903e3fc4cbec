"""Cameras of a capture, whose photographs need not be there: their size is then what the poses' file says.

Lens distortion is left out.
"""

from pathlib import Path

from compgs.cameras import Camera
from compgs.errors import SceneError, UnsupportedCamera
from compgs.scene.blender import read_blender
from compgs.scene.capture import PosedImage, check_camera
from compgs.scene.colmap import find_sparse_model
from compgs.scene.colmap_capture import read_colmap
from compgs.scene.frames import read_frames
from compgs.scene.nerfstudio import read_nerfstudio

EXPECTED = (
    "expected the folder of a COLMAP model (sparse/0), transforms.json, transforms_train.json, or a list of cameras as "
    "3DGS (cameras.json) and compgs write them"
)
LAYOUTS = {"transforms_train.json": read_blender, "transforms.json": read_nerfstudio}
LONGEST_LENS = 16.0  # widths of the picture: a focal length in pixels, and a size that nobody knows, are more


def is_capture(path: Path) -> bool:
    """A folder, or a file of poses as captures have it, in place of a camera file."""
    return path.is_dir() or (path.name.startswith("transforms") and path.suffix == ".json" and path.is_file())


def cameras_of_capture(path: Path) -> list[tuple[str, Camera]]:
    """Names and cameras, in the order of the names. Raises SceneError, UnsupportedCamera."""
    found = sorted(_images(path), key=lambda posed: posed.name)
    for posed in found:
        check_camera(posed.camera, f"{path}: {posed.name}")
        if posed.camera.width == 1 and posed.camera.fx > LONGEST_LENS:
            raise UnsupportedCamera(
                f"{path}: {posed.name}: a focal length in pixels, but not the size of the picture; add w and h"
            )
    return [(posed.name, posed.camera) for posed in found]


def _images(path: Path) -> tuple[PosedImage, ...]:
    if path.is_file():
        return read_frames(path).images
    sparse = find_sparse_model(path)
    if sparse is not None:
        return read_colmap(path, sparse, path / "images").images
    for name, read in LAYOUTS.items():
        if (path / name).is_file():
            return read(path).images
    raise SceneError(f"{path}: no cameras found; {EXPECTED}")
