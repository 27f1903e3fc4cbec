"""The split that nerfstudio's `transforms.json` may name: `train_filenames`, `val_filenames`, `test_filenames`."""

from collections.abc import Mapping, Sequence
from typing import Any

from compgs.errors import SceneError
from compgs.scene.capture import PosedImage
from compgs.scene.transforms import as_name

LISTS = ("train_filenames", "val_filenames", "test_filenames")


def split_by_names(
    posed: Sequence[PosedImage], values: Mapping[str, Any], place: str
) -> tuple[tuple[PosedImage, ...], frozenset[str] | None, tuple[str, ...]]:
    """The frames to use, the names of those that are held out (None: no list is given), and what is to be noted.

    Held out is what `val_filenames` or `test_filenames` have, or, without both, what `train_filenames` does not have.
    Where both what is trained on and what is held out are named, other frames are left out, as nerfstudio does.
    Raises SceneError for what is no list of names.
    """
    lists = {key: _names(values[key], key, place) for key in LISTS if values.get(key) is not None}
    if not lists:
        return tuple(posed), None, ()
    frames, named = {image.name for image in posed}, frozenset().union(*lists.values())
    train = lists.get("train_filenames")
    evaluated = [names for key, names in lists.items() if key != "train_filenames"]
    held_out = frozenset(frames & frozenset().union(*evaluated) if evaluated else frames - named)
    used = tuple(image for image in posed if not (train and evaluated) or image.name in named)
    notes = []
    if named - frames:
        notes.append(f"of {len(named - frames)} names there is no frame, such as {min(named - frames)!r}")
    if both := (train or frozenset()) & held_out:
        notes.append(f"{len(both)} frames are named as trained on and as held out: they are held out")
    if len(used) < len(posed):
        notes.append(f"{len(posed) - len(used)} frames are not named, and left out")
    if not held_out:
        notes.append("no frame is held out")
    return used, held_out, tuple(f"{', '.join(lists)}: {note}" for note in notes)


def _names(names: Any, key: str, place: str) -> frozenset[str]:
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise SceneError(f"{place}: {key} is {names!r:.60}; expected a list of what frames have as file_path")
    return frozenset(map(as_name, names))
