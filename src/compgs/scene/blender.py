"""The layout of the synthetic NeRF scenes: `transforms_train.json` and `transforms_test.json`."""

from pathlib import Path

import numpy as np

from compgs.cameras import Camera
from compgs.errors import SceneError
from compgs.scene.capture import Capture, PosedImage, check_camera, check_inside
from compgs.scene.images import image_size
from compgs.scene.transforms import IMAGE_SUFFIXES, file_path, number, read_transforms, world_to_camera
from compgs.scene.views import Points


def read_blender(folder: Path) -> Capture:
    """Training and test views are those of the two files; without a test file none are named."""
    train = _read_split(folder, folder / "transforms_train.json")
    test_file = folder / "transforms_test.json"
    test = _read_split(folder, test_file) if test_file.is_file() else ()
    if not train:
        raise SceneError(
            f"{folder / 'transforms_train.json'}: no frames; expected at least one training view"
        )
    nothing = Points(np.zeros((0, 3)), np.zeros((0, 3), dtype=np.uint8))
    names = frozenset(posed.name for posed in test) if test else None
    # white: what the scenes' published figures stand on
    return Capture(train + test, names, nothing, str(folder), (1.0, 1.0, 1.0), cut_out=False)


def _read_split(folder: Path, file: Path) -> tuple[PosedImage, ...]:
    values = read_transforms(file)
    angle = number(values, "camera_angle_x", str(file))
    if not 0 < angle < np.pi:
        raise SceneError(f"{file}: camera_angle_x is {angle}; expected radians above 0 and below pi")
    posed = []
    for index, frame in enumerate(values["frames"]):
        place = f"{file}, frame {index}"
        relative = file_path(frame, place)
        check_inside(
            folder / relative, (folder,), f"the image of frame {index} in {file.name}, {relative!r},"
        )
        path = _with_suffix(folder / relative)
        # the file does not say the size; a missing image is reported with all others, later
        width, height = image_size(path) if path.is_file() else (1, 1)
        focal = 0.5 * width / np.tan(0.5 * angle)
        camera = Camera(world_to_camera(frame, place), focal, focal, width / 2, height / 2, width, height)
        check_camera(camera, place)
        posed.append(PosedImage(relative, path, camera))
    return tuple(posed)


def _with_suffix(path: Path) -> Path:
    """The file names of these scenes come without their suffix, mostly."""
    if path.is_file():
        return path
    candidates = [path.with_name(path.name + suffix) for suffix in IMAGE_SUFFIXES]
    return next((c for c in candidates if c.is_file()), candidates[0] if not path.suffix else path)
