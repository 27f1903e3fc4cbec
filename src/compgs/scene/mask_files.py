"""Which mask file belongs to which view, and views of which a mask leaves nothing."""

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

from compgs.errors import SceneError
from compgs.scene.capture import Capture, PosedImage, check_inside
from compgs.scene.masks import FOLDER, find_mask, mask_beside
from compgs.scene.names import Names
from compgs.scene.views import View


def with_masks(capture: Capture, folder: Path, images: str) -> Capture:
    """Return the views with the mask files that there are, and what is to be noted. Raises SceneError for masks outside
    of the scene.
    """
    names = Names()
    masks = _masks_folder(folder)
    capture = replace(
        capture,
        images=tuple(
            posed
            if posed.mask
            else replace(posed, mask=_mask_of(posed, masks, (folder / images, folder), names))
            for posed in capture.images
        ),
    )
    for posed in capture.images:
        if posed.mask is not None:
            check_inside(posed.mask, (folder, folder / images), f"the mask of the view {posed.name!r}")
    masked = sum(posed.mask is not None for posed in capture.images)
    if masks is None and not masked:
        return capture
    if masked == 0:
        note = (
            f"{FOLDER}/ is not used: it has a mask for no view; of the photograph a.jpg the mask is a.png, a.jpg.png, "
            "a.jpg.mask.png or a_mask.png"
        )
    else:
        note = (
            f"masks: {masked} of {len(capture.images)} views have one; where it is black, pixels do not count"
        )
    return replace(capture, notes=(*capture.notes, note))


def _masks_folder(folder: Path) -> Path | None:
    """Find the folder of masks, in any letter case."""
    if (folder / FOLDER).is_dir():
        return folder / FOLDER
    return next((p for p in sorted(folder.iterdir()) if p.is_dir() and p.name.lower() == FOLDER), None)


def _mask_of(posed: PosedImage, masks: Path | None, folders: tuple[Path, ...], names: Names) -> Path | None:
    """Find a photograph's mask: in the folder of masks by the photograph's name, relative to the first of `folders`
    that it is in; else beside the photograph.
    """
    if masks is not None:
        for folder in folders:
            if posed.path.is_relative_to(folder):
                found = find_mask(masks, posed.path.relative_to(folder).as_posix(), names)
                if found is not None:
                    return found
    return mask_beside(posed.path, names)


def without_empty(views: Sequence[View], looked_at: Sequence[bool]) -> tuple[list[View], tuple[str, ...]]:
    """The views, those left out of which a mask leaves no pixel, and a sentence about them.

    Of the views that are not to be `looked_at` nothing is read. Raises SceneError where no view is left.
    """
    chosen = [view for view, look in zip(views, looked_at, strict=True) if look]
    with ThreadPoolExecutor(max_workers=min(8, os.cpu_count() or 1)) as pool:
        empty = {
            view.name for view, is_empty in zip(chosen, pool.map(_is_empty, chosen), strict=True) if is_empty
        }
    if not empty:
        return list(views), ()
    if len(empty) == len(views):
        raise SceneError(
            f"the masks of all {len(views)} views leave no pixel; a pixel counts where its mask is white, or where the "
            "photograph is opaque: mend the masks, or invert them"
        )
    kept = [view for view in views if view.name not in empty]
    if len(empty) == 1:
        return kept, (f"1 view is left out, its mask leaves no pixel: {min(empty)}",)
    return kept, (f"{len(empty)} views are left out, their masks leave no pixel, such as {min(empty)}",)


def _is_empty(view: View) -> bool:
    mask = view.mask
    return mask is not None and not mask.any()
