"""Held-out views: whether they can be measured, and how far they are from what was trained on."""

import os
from concurrent.futures import ThreadPoolExecutor

from compgs.errors import SceneError
from compgs.evaluation.exposure import right_half
from compgs.scene.angles import nearest_angles
from compgs.scene.views import Scene, View


def check_held_out(scene: Scene, *, exposure: bool) -> None:
    """Looks at every held-out view. Raises SceneError for the first that cannot be read or measured, by name.

    What would end an evaluation is known before a training this way.
    """
    with ThreadPoolExecutor(max_workers=min(8, os.cpu_count() or 1)) as pool:
        for _ in pool.map(lambda view: check_view(view, exposure=exposure), scene.test_views):
            pass


def check_view(view: View, *, exposure: bool) -> None:
    """Raises SceneError where the view cannot be read, or its mask leaves nothing of what is measured."""
    view.image  # noqa: B018  # raises for a photograph that cannot be read
    mask = view.mask
    if mask is None:
        return
    if not (right_half(mask) if exposure else mask).any():
        where = "of the right half, which is measured, " if exposure else ""
        raise SceneError(
            f"{view.name}: its mask leaves no pixel {where}to evaluate on; mend the mask, or remove the view from the "
            "poses"
        )


def degrees_to_training(scene: Scene) -> list[float | None]:
    """Return the angle of each held-out view to the nearest training view (`compgs.scene.angles`); None without any."""
    held_out, trained = ([view.camera for view in views] for views in (scene.test_views, scene.train_views))
    return nearest_angles(held_out, trained, scene.points.positions, scene.extent)
