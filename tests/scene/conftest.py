"""Small captures on disk, for the tests of the readers."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from compgs.numerics.rotations import quaternion_from_rotation
from compgs.scene.colmap import ColmapCamera, ColmapImage, ColmapPoints
from compgs.scene.colmap_writer import write_sparse_model

PINHOLE = ColmapCamera(1, "PINHOLE", 24, 16, (20.0, 21.0, 12.5, 8.25))


def looking_at_origin(center: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(rotation, translation) world to camera of a camera at `center` with z up in its image."""
    forward = -center / np.linalg.norm(center)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    return rotation, -rotation @ center


def smooth_image(rng: np.random.Generator, width: int, height: int) -> np.ndarray:
    """[H, W, 3] uint8, smooth enough to be resampled."""
    x, y = np.meshgrid(np.linspace(0, 1, width), np.linspace(0, 1, height))
    waves = rng.uniform(1, 3, size=(3, 2))
    return np.stack([np.round(127.5 + 120 * np.sin(3 * (a * x + b * y))) for a, b in waves], axis=-1).astype(
        np.uint8
    )


@pytest.fixture
def write_capture(tmp_path: Path) -> Callable[..., Path]:
    """Writes a COLMAP capture of a ring of views around the origin, and returns its folder."""

    def write(
        names: list[str] | None = None,
        *,
        cameras: tuple[ColmapCamera, ...] = (PINHOLE,),
        points: int = 150,
        text: bool = False,
        sparse: str = "sparse/0",
        folder: str = "capture",
    ) -> Path:
        rng = np.random.default_rng(0)
        names = [f"{i:02d}.png" for i in range(10)] if names is None else names
        root = tmp_path / folder
        images = []
        for index, name in enumerate(names):
            camera = cameras[index % len(cameras)]
            angle = 2 * np.pi * index / len(names)
            rotation, translation = looking_at_origin(np.array([3 * np.cos(angle), 3 * np.sin(angle), 1.0]))
            seen = rng.choice(points, size=min(points, 5), replace=False) * 7 + 3 if points else np.zeros(0)
            observations = rng.uniform(-5, 30, size=(len(seen) + 2, 2))  # some lie outside the image
            ids = np.concatenate([seen, [-1, -1]]).astype(np.int64)
            quaternion = quaternion_from_rotation(rotation)
            args = (quaternion, translation, camera.camera_id, name, observations, ids)
            images.append(ColmapImage(5 * index + 2, *args))
            path = root / "images" / name
            path.parent.mkdir(parents=True, exist_ok=True)
            Image.fromarray(smooth_image(rng, camera.width, camera.height)).save(path)
        cloud = ColmapPoints(
            np.arange(points, dtype=np.uint64) * 7 + 3,
            rng.normal(size=(points, 3)),
            rng.integers(0, 256, size=(points, 3), dtype=np.uint8),
            rng.uniform(size=points),
        )
        write_sparse_model(root / sparse, cameras, images, cloud, text=text)
        return root

    return write
