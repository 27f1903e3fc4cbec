"""How bright and in which tint photographs are beside one another, before anything is trained.

The points of a reconstruction have colors: means over the photographs that show them. What photographs have in their
places says how each differs. Where points have no colors that photographs agree with, their headers say how long and
how sensitively each was exposed.
"""

from collections.abc import Sequence

import numpy as np
import torch

from compgs.scene.sight import depths_in, places_in
from compgs.scene.views import Scene, View
from compgs.training.run.distributed import sum_over_ranks


def starting_gains(scene: Scene, own: Sequence[int] | None = None) -> np.ndarray | None:
    """[V, 3] log2 of what the colors of each training view are multiplied by, zero in the mean; None: not known.

    `own`: the views whose photographs this rank reads; None: all.
    """
    gains = gains_by_points(scene, range(len(scene.train_views)) if own is None else own)
    if gains is None:
        gains = gains_by_headers(scene.train_views)
    if gains is None:
        return None
    return np.clip(gains - gains.mean(axis=0), -3.0, 3.0)  # more stops are not believed


def gains_by_points(scene: Scene, own: Sequence[int]) -> np.ndarray | None:
    """[V, 3], or None where points tell too little. Each rank looks at its own views."""
    points = scene.points
    chosen = np.linspace(0, len(points) - 1, min(len(points), 4_000)).round().astype(np.int64)
    positions, colors = np.asarray(points.positions)[chosen], points.colors[chosen]
    rows = np.zeros((len(scene.train_views), 5))  # gains, how alike colors are, and whether both are known
    for index in own:
        row = _against_points(scene.train_views[index], positions, colors)
        if row is not None:
            rows[index] = *row[0], row[1], 1.0
    sum_over_ranks(torch.from_numpy(rows))
    gains, alike, known = rows[:, :3], rows[:, 3], rows[:, 4] > 0
    # What is hidden in a photograph does not agree with it.
    if 2 * known.sum() < len(rows) or np.median(alike[known]) < 0.2:
        return None
    return np.where(known[:, None], gains, gains[known].mean(axis=0))


def _against_points(view: View, positions: np.ndarray, colors: np.ndarray) -> tuple[np.ndarray, float] | None:
    """[3] log2 of the view's colors over the points', median, and how alike the two are; None: too few are shown."""
    camera, image = view.camera, view.image
    shown = depths_in(camera, positions)[1]
    columns, rows, _ = places_in(camera, positions[shown])
    column, row = columns.astype(np.int64), rows.astype(np.int64)
    column, row = column.clip(0, camera.width - 1), row.clip(0, camera.height - 1)
    there, known = image[row, column].astype(np.float64), colors[shown].astype(np.float64)
    # Very dark and very bright colors say little about the exposure.
    useful = ((there > 10) & (there < 245) & (known > 10) & (known < 245)).all(axis=1)
    if (mask := view.mask) is not None:
        useful &= mask[row, column]
    if useful.sum() < 20:
        return None
    ratio = np.log2(there[useful] / known[useful])
    sums = there[useful].sum(axis=1), known[useful].sum(axis=1)
    alike = 0.0 if min(map(np.std, sums)) == 0.0 else float(np.corrcoef(*sums)[0, 1])
    return np.median(ratio, axis=0), alike


def gains_by_headers(views: tuple[View, ...]) -> np.ndarray | None:
    """[V, 3], or None where not every header says how the photograph was exposed."""
    stops = [view.stops for view in views]
    if any(value is None for value in stops):
        return None
    # A photograph exposed twice as long is brighter by 2^(1 / 2.2), 2.2 being the gamma of displays.
    return np.repeat(np.array(stops, dtype=np.float64)[:, None] / 2.2, 3, axis=1)
