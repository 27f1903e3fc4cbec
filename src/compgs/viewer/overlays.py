"""What can be drawn over the picture: anchors as points, primitives as ellipsoids, cameras as frustums.

Arrays and numbers alone; `controls.py` hands them to the page. All is in the model's local frame.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from compgs.cameras import Camera
from compgs.render import Renderable, blend_of, contributions, local_camera, settings_of, visible_mask

MOST_POINTS = 200_000
MOST_FRUSTUMS = 200
ELLIPSOID_SIGMAS = 1.0  # standard deviations from the middle to the surface
JUDGED_SIDE = 320  # pixels of the image by which primitives are chosen
# Of the scene's radius: size of a point, length of a frustum.
POINT_SHARE, FRUSTUM_SHARE = 0.003, 0.06


@dataclass(frozen=True, eq=False)
class Ellipsoids:
    """N primitives as they are drawn from one camera."""

    means: np.ndarray  # [N, 3]
    quaternions: np.ndarray  # [N, 4] w-x-y-z, unit
    radii: np.ndarray  # [N, 3] world units
    colors: np.ndarray  # [N, 3] uint8


def anchor_points(model: Renderable) -> np.ndarray:
    """[N, 3] float32: anchors, or splats where there are none; evenly chosen if there are too many."""
    positions = model.bounds[0]
    return positions[:: -(-len(positions) // MOST_POINTS)]


def ellipsoids(model: Renderable, camera: Camera, most: int) -> Ellipsoids:
    """The primitives that the image of a camera (of the world) consists of for the most part."""
    share = min(1.0, JUDGED_SIDE / max(camera.width, camera.height))
    width, height = max(1, round(share * camera.width)), max(1, round(share * camera.height))
    local = local_camera(model, camera.resized(width, height))
    settings = settings_of(model)
    g = model.gaussians(local, visible_mask(*model.bounds, local, settings))
    weights = contributions(g, local, settings, blend_of(model))
    largest = np.argsort(-weights, kind="stable")[: min(most, int((weights > 0).sum()))]
    means, quaternions, scales, colors = (
        t[np.sort(largest)] for t in (g.means, g.quaternions, g.scales, g.colors)
    )
    return Ellipsoids(
        means,
        quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True),
        ELLIPSOID_SIGMAS * scales,
        (colors.clip(0, 1) * 255).round().astype(np.uint8),
    )


def sphere(level: int = 2) -> tuple[np.ndarray, np.ndarray]:
    """Vertices [V, 3] on the unit sphere and faces [F, 3] that look outwards: an octahedron, divided `level` times."""
    vertices = np.array([(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1)], float)
    signs = [(x, y, z) for x in (0, 1) for y in (2, 3) for z in (4, 5)]
    faces = np.array([(x, y, z) if (x + y + z) % 2 == 0 else (x, z, y) for x, y, z in signs])
    for _ in range(level):
        corners = vertices[faces]
        middles = corners + np.roll(corners, -1, axis=1)  # of the edges 01, 12, 20
        middles /= np.linalg.norm(middles, axis=2, keepdims=True)
        vertices = np.concatenate([corners, middles], axis=1).reshape(-1, 3)
        base = 6 * np.arange(len(faces))[:, None, None]
        parts = np.array([(0, 3, 5), (3, 1, 4), (5, 4, 2), (3, 4, 5)])
        faces = (base + parts).reshape(-1, 3)
    vertices, index = np.unique(vertices.round(12), axis=0, return_inverse=True)
    return vertices.astype(np.float32), index.reshape(-1)[faces].astype(np.uint32)


def shown_cameras(cameras: Sequence[tuple[str, Camera]]) -> list[tuple[str, Camera]]:
    """All of them, or some, evenly chosen."""
    return list(cameras[:: -(-len(cameras) // MOST_FRUSTUMS)])
