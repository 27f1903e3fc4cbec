"""A scene to train on, of which only splats exist: its photographs are renderings of them, its points their means.

camera ──render──► photograph              (when somebody looks; kept while there is room)
splats ──weights──► points of the anchors' grid, with the colors that the splats have there
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from compgs import metrics
from compgs.cameras import Camera
from compgs.compressing.placing import Placed
from compgs.model.splats import SplatModel
from compgs.render import render
from compgs.scene.image_cache import ImageCache
from compgs.scene.views import Points, Scene, View, scene_extent


@dataclass(frozen=True, eq=False)
class Rendering:
    """A photograph that is taken when it is wanted."""

    cache: ImageCache[np.ndarray]
    model: SplatModel
    camera: Camera
    key: int

    def __call__(self) -> np.ndarray:
        """[H, W, 3] uint8."""
        return self.cache.get(self.key, lambda: metrics.to_8bit(render(self.model, self.camera).image))


def teacher_scene(model: SplatModel, placed: Placed, points: Points, source: Path) -> Scene:
    """The scene that training sees; `points` are where its anchors start (`start.py`)."""
    cache: ImageCache[np.ndarray] = ImageCache()
    train = views(model, placed.train, "train", cache, 0)
    held_out = views(model, placed.held_out, "held_out", cache, len(train))
    return Scene(
        name=source.stem,
        train_views=train,
        test_views=held_out,
        points=points,
        background=model.background,
        extent=scene_extent(np.stack([camera.center for camera in placed.train])),
        source=source,
    )


def views(
    model: SplatModel, cameras: Sequence[Camera], name: str, cache: ImageCache[np.ndarray], first: int
) -> tuple[View, ...]:
    """What the cameras see, under keys of the cache from `first` on."""
    return tuple(
        View(f"{name}_{i:04d}", camera, Rendering(cache, model, camera, first + i))
        for i, camera in enumerate(cameras)
    )
