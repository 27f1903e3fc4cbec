"""Held-out views: whether they can be measured, and how far they are from what was trained on."""

import os
from concurrent.futures import ThreadPoolExecutor

from compgs.errors import SceneError
from compgs.scene.angles import nearest_angles
from compgs.scene.views import Scene, View


def check_held_out(scene: Scene) -> None:
    """Looks at every held-out view. Raises SceneError for the first that cannot be read or measured, by name.

    What would end an evaluation is known before a training this way.
    """
    with ThreadPoolExecutor(max_workers=min(8, os.cpu_count() or 1)) as pool:
        for _ in pool.map(check_view, scene.test_views):
            pass


def check_view(view: View) -> None:
    """Raises SceneError where the view cannot be read, or its mask leaves nothing."""
    view.image  # noqa: B018  # raises for a photograph that cannot be read
    mask = view.mask
    if mask is not None and not mask.any():
        raise SceneError(
            f"{view.name}: its mask leaves no pixel to evaluate on; mend the mask, or remove the view from the poses"
        )


def degrees_to_training(scene: Scene) -> list[float | None]:
    """Return the angle of each held-out view to the nearest training view (`compgs.scene.angles`); None without any."""
    held_out, trained = ([view.camera for view in views] for views in (scene.test_views, scene.train_views))
    return nearest_angles(held_out, trained, scene.points.positions, scene.extent)
