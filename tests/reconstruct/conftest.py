"""Photographs that were computed: three textured walls, of which every pixel's color and every pose are known."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

SIZE = (400, 300)
FOCAL = 380.0


@dataclass(frozen=True)
class Walls:
    """Photographs in a folder, and where they were taken from."""

    folder: Path
    centers: dict[str, np.ndarray]  # [3] by name
    rotations: dict[str, np.ndarray]  # [3, 3] world to camera, by name


@pytest.fixture(scope="session")
def walls(tmp_path_factory: pytest.TempPathFactory) -> Walls:
    folder = tmp_path_factory.mktemp("walls")
    chance = np.random.default_rng(5)
    textures = [texture(chance) for _ in range(3)]
    centers, rotations = {}, {}
    for index in range(7):
        angle = np.radians(25 + 7 * index)
        center = 4.5 * np.array([np.cos(angle), 0.35 + 0.05 * (index % 3), np.sin(angle)])
        rotation = looking_at(center, np.array([0.4, 0.3, 0.4]))
        name = f"photo_{index}.png"
        Image.fromarray(corner(center, rotation, textures)).save(folder / name)
        centers[name], rotations[name] = center, rotation
    return Walls(folder, centers, rotations)


def texture(chance: np.random.Generator) -> np.ndarray:
    """[512, 512, 3] float: blots of all sizes, which features are found in."""
    total = np.zeros((512, 512, 3))
    for cells in (8, 16, 32, 64, 128):
        noise = Image.fromarray(chance.integers(0, 256, (cells, cells, 3), dtype=np.uint8))
        total += np.asarray(noise.resize((512, 512), Image.Resampling.BICUBIC), float)
    return np.clip((total / 5 - 128) * 2.2 + 128, 0, 255)


def looking_at(center: np.ndarray, target: np.ndarray) -> np.ndarray:
    """World to camera: x right, y down, z ahead; the world's up is +y."""
    ahead = (target - center) / np.linalg.norm(target - center)
    right = np.cross(ahead, [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(ahead, right), ahead])


def corner(center: np.ndarray, rotation: np.ndarray, textures: list[np.ndarray]) -> np.ndarray:
    """[H, W, 3] uint8: the planes x = 0, y = 0 and z = 0, four units wide, as a pinhole camera sees them."""
    width, height = SIZE
    u, v = np.meshgrid(np.arange(width) + 0.5 - width / 2, np.arange(height) + 0.5 - height / 2)
    rays = np.stack([u / FOCAL, v / FOCAL, np.ones_like(u)], axis=-1) @ rotation
    image, nearest = np.full((height, width, 3), 90.0), np.full((height, width), np.inf)
    for axis, pattern in enumerate(textures):
        distance = -center[axis] / rays[..., axis]
        hit = center + distance[..., None] * rays
        a, b = hit[..., (axis + 1) % 3], hit[..., (axis + 2) % 3]
        seen = (distance > 0) & (distance < nearest) & (a >= 0) & (a < 4) & (b >= 0) & (b < 4)
        image[seen] = pattern[(a[seen] * 127.9).astype(int), (b[seen] * 127.9).astype(int)]
        nearest[seen] = distance[seen]
    return image.astype(np.uint8)
