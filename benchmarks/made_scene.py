"""A made-up scene of any number of anchors: for measuring how cost grows.

Anchors lie on spheres and a floor that all cameras look at, each as large as the distance to its neighbours, as at
the start of a training. The images are noise: what they show does not change what a step costs.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np

from compgs.config import Config
from compgs.scene.generated import camera_path
from compgs.scene.views import Points, Scene, View, scene_extent

VIEWS = 4
FLOOR = 3.0  # world units, side length
SPHERES = (
    ((0.0, 0.0, 0.6), 0.6),
    ((0.9, 0.3, 0.35), 0.35),
    ((-0.5, 0.9, 0.3), 0.3),
    ((-0.3, -0.9, 0.4), 0.4),
)


def made_scene(anchors: int, width: int, height: int, seed: int = 0) -> tuple[Scene, Config]:
    """The scene, and the default settings with the voxel size that makes exactly `anchors` anchors of it."""
    rng = np.random.default_rng(seed)
    area = FLOOR**2 + sum(4 * np.pi * radius**2 for _, radius in SPHERES)
    voxel_size = 0.25 * float(np.sqrt(area / anchors))  # a quarter of the anchors' mean distance
    coordinates = np.zeros((0, 3), np.int64)
    while len(coordinates) < anchors:
        more = np.rint(surface_points(anchors, area, rng) / voxel_size).astype(np.int64)
        coordinates = np.unique(np.concatenate([coordinates, more]), axis=0)
    coordinates = coordinates[np.sort(rng.permutation(len(coordinates))[:anchors])]
    positions = (coordinates * voxel_size).astype(np.float32)
    views = tuple(
        View(f"{i}.png", camera, rng.integers(0, 256, (height, width, 3), dtype=np.uint8))
        for i, camera in enumerate(camera_path(VIEWS, width, height))
    )
    scene = Scene(
        name=f"made-{anchors}",
        train_views=views,
        test_views=(),
        points=Points(positions, np.full(positions.shape, 128, np.uint8)),
        background=(0.0, 0.0, 0.0),
        extent=scene_extent(np.stack([view.camera.center for view in views])),
        source=Path(),
    )
    config = Config()
    return scene, replace(config, model=replace(config.model, voxel_size=voxel_size))


def surface_points(count: int, area: float, rng: np.random.Generator) -> np.ndarray:  # [count or so, 3]
    """Uniform on all surfaces; `area` is theirs together."""
    floor = np.zeros((round(count * FLOOR**2 / area), 3))
    floor[:, :2] = rng.uniform(-FLOOR / 2, FLOOR / 2, (len(floor), 2))
    parts = [floor]
    for center, radius in SPHERES:
        directions = rng.standard_normal((round(count * 4 * np.pi * radius**2 / area) + 1, 3))
        parts.append(center + radius * directions / np.linalg.norm(directions, axis=1, keepdims=True))
    return np.concatenate(parts)
