"""Whether a scene is the one that a file was made from, and is read as it was then.

A file keeps a few of its training cameras (`docs/bitstream.md`, Viewpoints). Found again among a scene's views, they
tell another scene, another resolution, and views that count as held out now but were trained on.
"""

from collections.abc import Sequence

import numpy as np

from compgs.cameras import Camera
from compgs.scene.views import Scene

# Scene extents; files round positions to less than 1/30000.
SAME_PLACE = 1e-3
# Degrees; files round rotations to less than 0.02.
SAME_DIRECTION = 0.1


def misfits(viewpoints: Sequence[Camera], scene: Scene) -> tuple[str, ...]:
    """One sentence for each way in which the scene is not what the file was trained on; none without viewpoints.

    `viewpoints`: cameras of the world that a file keeps, all of them of training views.
    """
    if not viewpoints:
        return ()
    views = (*scene.train_views, *scene.test_views)
    found = _found_again(viewpoints, scene, [view.camera for view in views])
    if not found:
        return (
            f"another scene: none of the {len(viewpoints)} cameras that the file keeps is among the views of "
            f"{scene.name}",
        )
    notes = []
    if len(found) < len(viewpoints):
        notes.append(
            f"of the {len(viewpoints)} cameras that the file keeps only {len(found)} are among the views of "
            f"{scene.name}: views were removed since, or poses changed"
        )
    trained_on = sum(index >= len(scene.train_views) for index in found.values())
    if trained_on:
        notes.append(
            f"of the {len(found)} cameras of training views that the file keeps {trained_on} are held out here: views "
            "that were trained on are counted; hold out as in training (test_every=...)"
        )
    return (*notes, *_other_resolution([(viewpoints[i], views[j].camera) for i, j in found.items()]))


def _other_resolution(pairs: Sequence[tuple[Camera, Camera]]) -> tuple[str, ...]:
    """A sentence if most of the cameras (in the file, in the scene) have images of other sizes."""
    differing = [(then, now) for then, now in pairs if (then.width, then.height) != (now.width, now.height)]
    if 2 * len(differing) <= len(pairs):  # (of many different lenses a file keeps but 16)
        return ()
    then, now = differing[0]
    factor = now.width / then.width
    change = f"{factor:.3g} times larger" if factor > 1 else f"{1 / factor:.3g} times smaller"
    return (
        f"trained on images of {then.width} x {then.height} pixels, evaluated on {now.width} x {now.height}, {change}: "
        "read them as in training (downscale=...)",
    )


def _found_again(viewpoints: Sequence[Camera], scene: Scene, cameras: Sequence[Camera]) -> dict[int, int]:
    """Index of the viewpoint -> index of the camera with its pose, for those that there are."""
    centers = np.stack([camera.center for camera in cameras])
    rotations = np.stack([camera.rotation for camera in cameras])
    found = {}
    for i, viewpoint in enumerate(viewpoints):
        distances = np.linalg.norm(centers - viewpoint.center, axis=1) / (SAME_PLACE * scene.extent)
        cosines = (np.einsum("vij,ij->v", rotations, viewpoint.rotation) - 1) / 2
        angles = np.degrees(np.arccos(np.clip(cosines, -1, 1))) / SAME_DIRECTION
        # Some cameras stand in one place, others look in one direction.
        difference = np.maximum(distances, angles)
        if difference.min() <= 1:
            found[i] = int(difference.argmin())
    return found
