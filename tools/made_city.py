"""Makes a scene of a small city, ray-traced, as a COLMAP data set: the gallery's `city` is trained on it.

    python tools/made_city.py scenes/city
    compgs train scenes/city -o runs/city --preset quick --steps 800 --lmbda 5e-4 --no-eval

Houses stand in blocks between streets, with trees and two parks. Cameras fly around the city on two circles. The same
command writes the same files.
"""

import sys
from pathlib import Path

import numpy as np
from PIL import Image

from compgs.cameras import Camera
from compgs.numerics.rotations import rigid
from compgs.scene import ray_tracing as rt
from compgs.scene.colmap import ColmapCamera
from compgs.scene.colmap_writer import write_sparse_model
from compgs.scene.generated import observe

VIEWS = 60
WIDTH, HEIGHT = 400, 300  # pixels
BLOCKS = 4  # along each side of the city
BLOCK = 1.0  # side of a block, world units
STREET = 0.42  # width of a street, world units
PARKS = {(1, 2), (3, 0)}
WALLS = ((0.6, 0.5, 0.38), (0.5, 0.2, 0.12), (0.62, 0.6, 0.56), (0.3, 0.33, 0.36), (0.55, 0.4, 0.22))
GLASS = (0.1, 0.16, 0.24)
Row = tuple[
    int, tuple[float, ...], tuple[float, ...], int, tuple[float, ...], tuple[float, ...], float, float
]


def city(rng: np.random.Generator) -> rt.Solids:
    """Return the ground, the landscape around it, and all that stands on it."""
    asphalt, slabs, grass = (0.13, 0.13, 0.14), (0.42, 0.4, 0.36), (0.12, 0.24, 0.06)
    rows: list[Row] = [
        # kind, center, size, texture, its two colors, gloss, yaw
        (rt.BACKDROP, (0, 0, 0), (16, 16, 16), rt.LANDSCAPE, (0, 0, 0), (0, 0, 0), 0.0, 0.0),
        (rt.GROUND, (0, 0, 0), (1, 1, 1), rt.TILES, asphalt, (0.17, 0.17, 0.17), 0.0, 0.0),
    ]
    pitch = BLOCK + STREET
    for i in range(BLOCKS):
        for j in range(BLOCKS):
            x, y = (i - (BLOCKS - 1) / 2) * pitch, (j - (BLOCKS - 1) / 2) * pitch
            park = (i, j) in PARKS
            floor = grass if park else slabs
            second = tuple(0.7 * value for value in floor)
            half = (BLOCK / 2, BLOCK / 2, 0.02)
            rows.append((rt.BOX, (x, y, 0.02), half, rt.SPOTS, floor, second, 0.0, 0.0))
            rows += trees(rng, x, y) if park else houses(rng, x, y)
    kinds, centers, sizes, textures, first, second_colors, gloss, yaws = zip(*rows, strict=True)
    return rt.Solids(
        np.array(kinds, dtype=np.int64),
        np.array(centers, dtype=np.float64),
        np.array(sizes, dtype=np.float64),
        np.array(yaws, dtype=np.float64),
        np.array(textures, dtype=np.int64),
        np.stack([np.array(first, dtype=np.float64), np.array(second_colors, dtype=np.float64)], axis=1),
        np.array(gloss, dtype=np.float64),
    )


def houses(rng: np.random.Generator, x: float, y: float) -> list[Row]:
    """Return the houses of a block around (x, y): four, or one tower; roofs are boxes of their own."""
    tall = 1.5 * np.exp(-(x * x + y * y) / 6)  # the middle of the city is higher
    corners = ((-1, -1), (-1, 1), (1, -1), (1, 1)) if rng.random() < 0.75 else ((0, 0),)
    rows: list[Row] = []
    for a, b in corners:
        place = 0.24 * BLOCK
        width, depth = rng.uniform(0.15, 0.21, 2) * (1.0 if a else 1.7)
        height = rng.uniform(0.12, 0.3) + rng.uniform(0.1, 0.5) * tall * (1.0 if a else 1.6)
        wall = WALLS[rng.integers(len(WALLS))]
        center, size = (x + place * a, y + place * b, 0.04 + height), (width, depth, height)
        rows.append((rt.BOX, center, size, rt.BRICKS, GLASS, wall, 0.1, 0.0))
        roof = (0.27, 0.09, 0.06) if rng.random() < 0.5 else (0.22, 0.22, 0.22)
        lid, shape = (*center[:2], 0.04 + 2 * height + 0.02), (width + 0.015, depth + 0.015, 0.02)
        rows.append((rt.BOX, lid, shape, rt.MARBLE, roof, tuple(1.3 * v for v in roof), 0.0, 0.0))
    return rows


def trees(rng: np.random.Generator, x: float, y: float) -> list[Row]:
    """Return the trees of a park around (x, y), a crown on each trunk."""
    rows: list[Row] = []
    for a in (-0.32, 0.0, 0.32):
        for b in (-0.32, 0.0, 0.32):
            dx, dy = rng.uniform(-0.06, 0.06, 2)
            radius, height = rng.uniform(0.08, 0.13), rng.uniform(0.15, 0.25)
            trunk, bark = (x + a + dx, y + b + dy, 0.04 + height / 2), (0.25, 0.14, 0.07)
            rows.append((rt.CYLINDER, trunk, (0.02, 0.02, height / 2), rt.WOOD, bark, bark, 0.0, 0.0))
            crown = (*trunk[:2], 0.04 + height + 0.6 * radius)
            green = np.array([0.1, 0.25, 0.05]) * rng.uniform(0.8, 1.3)
            leaves, shade = tuple(green), tuple(0.45 * green)
            rows.append((rt.SPHERE, crown, (radius,) * 3, rt.SPOTS, leaves, shade, 0.0, 0.0))
    return rows


def flights() -> list[Camera]:
    """Return the cameras: a high circle that shows all, and a low one, nearer to the middle."""
    cameras = []
    for index in range(VIEWS):
        low = index % 2
        turn = 2 * np.pi * (index + 0.3 * low) / VIEWS
        elevation = np.radians((27 if low else 44) + 5 * np.sin(5 * turn))
        distance, target = (5.0, np.array([0.0, 0.0, 0.3])) if low else (7.0, np.array([0.0, 0.0, 0.1]))
        flat = np.array([np.cos(turn), np.sin(turn)]) * np.cos(elevation)
        center = target + distance * np.array([*flat, np.sin(elevation)])
        forward = (target - center) / distance
        right = np.array([-np.sin(turn), np.cos(turn), 0.0])
        rotation = np.stack([right, np.cross(forward, right), forward])
        pose = rigid(rotation, -rotation @ center)
        focal = 0.95 * WIDTH
        cameras.append(Camera(pose, focal, focal, WIDTH / 2, HEIGHT / 2, WIDTH, HEIGHT))
    return cameras


def main(folder: Path) -> None:
    """Write images/ and sparse/0 of the scene into a new folder."""
    rng = np.random.default_rng(7)
    solids, cameras = city(rng), flights()
    (folder / "images").mkdir(parents=True)
    names = [f"view_{index:03d}.png" for index in range(VIEWS)]
    photographs = []
    for camera, name in zip(cameras, names, strict=True):
        photographs.append(rt.render(solids, camera))
        Image.fromarray(photographs[-1]).save(folder / "images" / name)
    images, points = observe(solids, cameras, names, photographs, rng)
    lens = (cameras[0].fx, cameras[0].fy, cameras[0].cx, cameras[0].cy)
    model = [ColmapCamera(1, "PINHOLE", WIDTH, HEIGHT, lens)]
    write_sparse_model(folder / "sparse" / "0", model, images, points)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
