"""The layout with a file for each split: `transforms_train.json`, and `transforms_test.json` or `transforms_val.json`.

Synthetic NeRF scenes, rendered by Blender, have it with one angle for all intrinsics. Captures have it too, with
intrinsics as in `transforms.json`, which may lie beside: what that one alone says (points, or all intrinsics) is used.
"""

from pathlib import Path

from compgs.errors import SceneError
from compgs.scene.capture import Capture
from compgs.scene.frames import Frames, read_frames
from compgs.scene.points_of_frames import points_of
from compgs.scene.transforms import read_transforms
from compgs.scene.views import Points

TRAIN = "transforms_train.json"
HELD_OUT = ("transforms_test.json", "transforms_val.json")  # the first that is there


def read_blender(folder: Path) -> Capture:
    """Training and held-out views are those of the files; without a file of held-out ones none are named."""
    whole = folder / "transforms.json"
    beside = read_transforms(whole) if whole.is_file() else None
    train = read_frames(folder / TRAIN, beside)
    if not train.images:
        raise SceneError(f"{train.file}: no frames; expected at least one training view")
    file = next((folder / name for name in HELD_OUT if (folder / name).is_file()), None)
    held_out = None if file is None else read_frames(file, beside)
    files, notes = [train.file], [*train.notes]
    # A frame of both files is held out.
    names = frozenset() if held_out is None else frozenset(image.name for image in held_out.images)
    both = sum(image.name in names for image in train.images)
    if both:
        notes.append(f"{both} frames are in {TRAIN} and in the file of held-out ones: they are held out")
    images = tuple(image for image in train.images if image.name not in names)
    if held_out is not None:
        images += held_out.images
        files.append(held_out.file)
        known = {note.partition(": ")[2] for note in notes}
        notes += [note for note in held_out.notes if note.partition(": ")[2] not in known]
    points, ply, of_points = _points(train, whole if beside is not None else None)
    return Capture(
        images,
        names or None,
        points,
        str(folder),
        # White: what the published figures of the synthetic scenes stand on.
        (1.0, 1.0, 1.0) if beside is None else (0.0, 0.0, 0.0),
        cut_out=beside is not None,
        notes=(*notes, *of_points),
        files=(*files, *ply),
        split=held_out.file.name if held_out is not None and names else "",
    )


def _points(train: Frames, whole: Path | None) -> tuple[Points, tuple[Path, ...], tuple[str, ...]]:
    if train.values.get("ply_file_path") is not None or whole is None:
        return points_of(train.values, train.file)
    points, ply, notes = points_of(read_transforms(whole), whole)
    return points, (*ply, whole) if ply else (), notes
