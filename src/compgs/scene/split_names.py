"""Splits that a capture names: lists in nerfstudio's `transforms.json`, or files beside a COLMAP model."""

from collections.abc import Mapping, Sequence
from typing import Any

from compgs.errors import SceneError
from compgs.scene.capture import PosedImage
from compgs.scene.names import as_name, matches

LISTS = ("train_filenames", "val_filenames", "test_filenames")


def split_by_names(
    posed: Sequence[PosedImage], values: Mapping[str, Any], place: str
) -> tuple[tuple[PosedImage, ...], frozenset[str] | None, tuple[str, ...]]:
    """The frames to use, the names of those that are held out (None: no list is given), and what is to be noted.

    Raises SceneError for what is no list of names.
    """
    lists = {key: _names(values[key], key, place) for key in LISTS if values.get(key) is not None}
    return split_by_lists(posed, lists, LISTS[0])


def split_by_lists(
    posed: Sequence[PosedImage], lists: Mapping[str, frozenset[str]], training: str
) -> tuple[tuple[PosedImage, ...], frozenset[str] | None, tuple[str, ...]]:
    """Split as `split_by_names` does, by lists and what they are called; `training` is the one of frames to train on.

    Held out is what the other lists have, or, without any, what the list of training frames does not have. Where both
    what is trained on and what is held out are named, other frames are left out, as nerfstudio does.
    """
    if not lists:
        return tuple(posed), None, ()
    frames = {image.name for image in posed}
    found = {key: matches(names, frames) for key, names in lists.items()}
    meant = {key: frozenset(names.values()) for key, names in found.items()}
    named = frozenset().union(*meant.values())
    train = meant.get(training)
    evaluated = [names for key, names in meant.items() if key != training]
    held_out = frozenset().union(*evaluated) if evaluated else frozenset(frames - named)
    used = tuple(image for image in posed if not (train and evaluated) or image.name in named)
    notes = []
    if strange := sorted(name for key, names in lists.items() for name in names - found[key].keys()):
        notes.append(f"of {len(strange)} names there is no frame, such as {strange[0]!r}")
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
