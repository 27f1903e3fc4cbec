"""What a reconstruction is, for programs (JSON) and for people (a picture from above and from the side)."""

from dataclasses import asdict
from typing import Any

import numpy as np
from PIL import Image, ImageDraw

from compgs.numerics.rotations import rotation_from_quaternion
from compgs.reconstruct.reconstruction import Reconstruction
from compgs.scene.colmap import ColmapImage, SparseModel

PANEL = 480  # pixels: width and height of each of the two views
MARGIN = 24
BACKGROUND = (250, 250, 250)
CAMERA = (214, 39, 40)
MOST_POINTS = 50_000  # drawn


def summary(result: Reconstruction, model: SparseModel) -> dict[str, Any]:
    """The content of reconstruction.json: the result's fields, and what the cameras are."""
    fields = asdict(result)
    fields["scene"] = result.scene.name
    cameras = [
        {"model": c.model, "width": c.width, "height": c.height, "parameters": list(c.params)}
        for c in model.cameras.values()
    ]
    return {**fields, "cameras": cameras}


def picture(model: SparseModel) -> Image.Image:
    """Points in their colors and cameras in red, from above and from the side."""
    centers = np.stack([camera_center(image) for image in model.images])
    axes = upright_axes(model.images, centers)
    middle = np.median(model.points.positions, axis=0)
    points = (model.points.positions - middle) @ axes.T
    placed = (centers - middle) @ axes.T
    looks = np.stack([axes @ viewing_direction(image) for image in model.images])
    # Far points would leave no room for what is in front of the cameras.
    near = np.quantile(np.abs(points), 0.95, axis=0)
    reach = max(float(np.maximum(near, np.abs(placed).max(axis=0)).max()), 1e-12)
    canvas = Image.new("RGB", (2 * PANEL, PANEL), BACKGROUND)
    for index, (across, down) in enumerate(((0, 2), (0, 1))):
        panel = _panel(points, model.points.colors, placed, looks, reach, across, down)
        canvas.paste(panel, (index * PANEL, 0))
    return canvas


def camera_center(image: ColmapImage) -> np.ndarray:
    """[3] world units."""
    return -rotation_from_quaternion(image.quaternion).T @ image.translation


def viewing_direction(image: ColmapImage) -> np.ndarray:
    """[3] unit vector, in world axes."""
    return rotation_from_quaternion(image.quaternion)[2]


def upright_axes(images: "tuple[ColmapImage, ...]", centers: np.ndarray) -> np.ndarray:
    """[3, 3]: rows are right, down (the cameras' mean), and forward, in world axes. centers: [V, 3]."""
    down = np.stack([rotation_from_quaternion(image.quaternion)[1] for image in images]).mean(axis=0)
    down /= max(float(np.linalg.norm(down)), 1e-12)
    spread = centers - centers.mean(axis=0)
    flat = spread - np.outer(spread @ down, down)
    right = (
        np.linalg.svd(flat, full_matrices=False)[2][0] if flat.any() else np.eye(3)[np.argmin(np.abs(down))]
    )
    right = right - (right @ down) * down
    right /= max(float(np.linalg.norm(right)), 1e-12)
    return np.stack([right, down, np.cross(right, down)])


def _panel(
    points: np.ndarray,  # [P, 3] in upright axes
    colors: np.ndarray,  # [P, 3] uint8
    centers: np.ndarray,  # [V, 3]
    looks: np.ndarray,  # [V, 3]
    reach: float,  # of the picture, from its middle to its edge, in world units
    across: int,
    down: int,
) -> Image.Image:
    scale = (PANEL / 2 - MARGIN) / reach

    def pixel(place: np.ndarray) -> np.ndarray:
        return np.round(PANEL / 2 + scale * place[..., [across, down]]).astype(np.int64)

    pixels = np.full((PANEL, PANEL, 3), BACKGROUND, np.uint8)
    chosen = np.linspace(0, len(points) - 1, min(len(points), MOST_POINTS)).astype(np.int64)
    at = pixel(points[chosen])
    inside = ((at >= 0) & (at < PANEL)).all(axis=1)
    pixels[at[inside, 1], at[inside, 0]] = colors[chosen][inside]
    image = Image.fromarray(pixels)
    draw = ImageDraw.Draw(image)
    for center, look in zip(centers, looks, strict=True):
        x, y = pixel(center).tolist()
        ahead_x, ahead_y = pixel(center + look * (10 / scale)).tolist()
        draw.line([(x, y), (ahead_x, ahead_y)], fill=CAMERA)
        draw.ellipse([x - 2, y - 2, x + 2, y + 2], fill=CAMERA)
    return image
