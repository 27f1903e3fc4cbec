"""The capture as the training of one tile sees it."""

from dataclasses import replace

import numpy as np

from compgs.errors import SceneError
from compgs.scene import extent_of
from compgs.scene.views import Points, Scene
from compgs.tiles.ground import Ground
from compgs.tiles.plan import Tile, contains
from compgs.tiles.sight import times_seen

# Points outside of a tile that are kept in any case: a training holds so many, and what is thinned out is worse.
KEPT_OUTSIDE = 100_000


def block_scene(scene: Scene, ground: Ground, tile: Tile) -> Scene:
    """The views of a tile, the points of its padded core, and of what else these views see at most as many, or
    KEPT_OUTSIDE.

    What lies outside is in the pictures, too: without anything to show it, the tile would grow fog before its own
    cameras. It is trained along, and cut off in the end. The held-out views stay those of the whole scene. Raises
    SceneError for views that the scene does not have.
    """
    named = {view.name: view for view in scene.train_views}
    if missing := [name for name in tile.views if name not in named]:
        raise SceneError(
            f"{scene.source}: tile {tile.name} is trained on {len(missing)} views that are not there, such as "
            f"{missing[0]}; give the scene that the plan was made for"
        )
    views = tuple(named[name] for name in tile.views)
    points = _points(scene.points, [view.camera for view in views], ground, tile)
    return replace(
        scene,
        name=f"{scene.name} tile {tile.name}",
        train_views=views,
        points=points,
        extent=extent_of(views, points),
    )


def _points(points: Points, cameras: list, ground: Ground, tile: Tile) -> Points:
    inside = contains(tile.padded, ground.places(points.positions))
    around = np.flatnonzero(~inside & (times_seen(cameras, points.positions) > 0))
    most = max(int(inside.sum()), KEPT_OUTSIDE)
    if len(around) > most:
        around = np.random.default_rng(0).choice(around, most, replace=False)
    kept = inside.copy()
    kept[around] = True
    return Points(points.positions[kept], points.colors[kept])
