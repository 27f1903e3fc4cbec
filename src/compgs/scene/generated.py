"""A generated scene, written as a COLMAP data set like a real capture: photographs, poses, sparse points."""

import os
import shutil
import tempfile
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
from PIL import Image

from compgs.cameras import Camera
from compgs.errors import ConfigError, OutputError
from compgs.numerics.rotations import quaternion_from_rotation, rigid
from compgs.outputs import write_json
from compgs.scene import ray_tracing as rt
from compgs.scene.colmap import ColmapCamera, ColmapImage, ColmapPoints
from compgs.scene.colmap_writer import write_sparse_model
from compgs.scene.doubt import GENERATED

POINTS = 8_000  # candidates; those seen by fewer than MIN_TRACK views are dropped
MIN_TRACK = 3


def generate_scene(
    folder: str | Path,
    *,
    views: int = 40,
    width: int = 320,  # pixels
    height: int = 240,  # pixels
    seed: int = 0,
    progress: Callable[[int, int], None] | None = None,  # called with (done, total) views
) -> None:
    """Writes `images/*.png`, `sparse/0/*.bin`, and `generated.json`, which says what was asked for.

    The same arguments give the same files.

    The folder appears when it is complete. Raises OutputError if it exists and is not empty.
    """
    if views < 2 or width < 16 or height < 16:
        raise ConfigError(f"{views} views of {width}x{height}: expected at least 2 views of 16x16 pixels")
    target = Path(folder)
    if target.exists() and (not target.is_dir() or any(target.iterdir())):
        raise OutputError(f"{target}: exists already; choose another folder or remove it")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        unfinished = Path(tempfile.mkdtemp(prefix=f".{target.name}.", dir=target.parent))
        try:
            _write_scene(unfinished, views, width, height, seed, progress)
            unfinished.chmod(0o755)  # a temporary folder is its owner's alone
            os.replace(unfinished, target)
        finally:
            shutil.rmtree(unfinished, ignore_errors=True)
    except OSError as error:
        raise OutputError(f"{target}: cannot be written ({error.strerror or error})") from error


def _write_scene(
    folder: Path, views: int, width: int, height: int, seed: int, progress: Callable[[int, int], None] | None
) -> None:
    rng = np.random.default_rng(seed)
    solids = still_life(rng)
    cameras = camera_path(views, width, height)
    names = [f"view_{index:03d}.png" for index in range(views)]
    (folder / "images").mkdir()
    photographs = []
    with ThreadPoolExecutor(max_workers=min(8, os.cpu_count() or 1)) as pool:
        rendered = pool.map(lambda camera: rt.render(solids, camera), cameras)
        for index, (photograph, name) in enumerate(zip(rendered, names, strict=True)):
            photographs.append(photograph)
            Image.fromarray(photograph).save(folder / "images" / name)
            if progress is not None:
                progress(index + 1, views)
    images, points = observe(solids, cameras, names, photographs, rng)
    params = (cameras[0].fx, cameras[0].fy, cameras[0].cx, cameras[0].cy)
    write_sparse_model(
        folder / "sparse" / "0", [ColmapCamera(1, "PINHOLE", width, height, params)], images, points
    )
    write_json(folder / GENERATED, {"views": views, "width": width, "height": height, "seed": seed})


def still_life(rng: np.random.Generator) -> rt.Solids:
    """Spheres, boxes and cylinders on tiles in front of a landscape, a little different for each seed."""
    cream, slate = (0.78, 0.71, 0.58), (0.16, 0.2, 0.27)
    rows: list[tuple[int, tuple, tuple, int, tuple, tuple, float]] = [
        # kind, center, size, texture, its two colors, gloss
        (rt.BACKDROP, (0, 0, 0), (11, 11, 11), rt.LANDSCAPE, (0, 0, 0), (0, 0, 0), 0.0),
        (rt.GROUND, (0, 0, 0), (1, 1, 1), rt.TILES, (0.62, 0.56, 0.46), (0.3, 0.22, 0.17), 0.04),
        (rt.BOX, (0, 0, 0.25), (0.5, 0.5, 0.25), rt.BRICKS, (0.5, 0.13, 0.07), (0.6, 0.57, 0.52), 0.0),
        (rt.SPHERE, (0, 0, 1.0), (0.5, 0.5, 0.5), rt.MARBLE, slate, cream, 0.5),
        (rt.SPHERE, (1.15, 0.5, 0.4), (0.4, 0.4, 0.4), rt.STRIPES, (0.65, 0.06, 0.05), (0.8, 0.72, 0.6), 0.6),
        (
            rt.SPHERE,
            (-0.85, -0.95, 0.34),
            (0.34, 0.34, 0.34),
            rt.SPOTS,
            (0.75, 0.45, 0.04),
            (0.1, 0.06, 0.04),
            0.4,
        ),
        (
            rt.BOX,
            (-1.05, 0.65, 0.36),
            (0.36, 0.36, 0.36),
            rt.WOOD,
            (0.5, 0.27, 0.1),
            (0.26, 0.11, 0.035),
            0.15,
        ),
        (rt.BOX, (0.8, -0.95, 0.45), (0.22, 0.22, 0.45), rt.SPOTS, (0.07, 0.3, 0.33), (0.55, 0.7, 0.6), 0.2),
        (
            rt.CYLINDER,
            (0.05, 1.3, 0.38),
            (0.28, 0.28, 0.38),
            rt.STRIPES,
            (0.1, 0.17, 0.5),
            (0.7, 0.68, 0.6),
            0.3,
        ),
        (
            rt.CYLINDER,
            (-1.05, 0.65, 0.82),
            (0.2, 0.2, 0.1),
            rt.MARBLE,
            (0.08, 0.25, 0.1),
            (0.45, 0.6, 0.3),
            0.4,
        ),
        (rt.SPHERE, (0.05, 1.3, 0.92), (0.16, 0.16, 0.16), rt.SPOTS, (0.6, 0.1, 0.3), (0.85, 0.75, 0.7), 0.6),
        (rt.SPHERE, (1.5, -0.35, 0.2), (0.2, 0.2, 0.2), rt.MARBLE, (0.2, 0.3, 0.1), (0.75, 0.75, 0.35), 0.5),
        (
            rt.SPHERE,
            (-1.5, -0.25, 0.18),
            (0.18, 0.18, 0.18),
            rt.STRIPES,
            (0.1, 0.35, 0.4),
            (0.7, 0.6, 0.3),
            0.5,
        ),
    ]
    kinds, centers, sizes, textures, first, second, gloss = (
        list(column) for column in zip(*rows, strict=True)
    )
    colors = np.stack([np.array(first, dtype=np.float64), np.array(second, dtype=np.float64)], axis=1)
    solid = np.array(kinds) < rt.GROUND
    colors[solid] *= rng.uniform(0.85, 1.15, size=(solid.sum(), 1, 3))
    yaws = np.where(solid, rng.uniform(-np.pi, np.pi, size=len(rows)), 0.0)
    return rt.Solids(
        np.array(kinds, dtype=np.int64),
        np.array(centers, dtype=np.float64),
        np.array(sizes, dtype=np.float64),
        yaws,
        np.array(textures, dtype=np.int64),
        np.clip(colors, 0.0, 0.9),
        np.array(gloss, dtype=np.float64),
    )


def camera_path(views: int, width: int, height: int) -> list[Camera]:
    """Once around the centre, the height swinging up and down, looking at the middle of the objects."""
    turn = 2 * np.pi * np.arange(views) / views
    elevation = np.radians(29 + 15 * np.sin(3 * turn + 2.4 * np.arange(views)))
    distance = 3.7 + 0.3 * np.cos(2 * turn)
    focal = 0.95 * max(width, height)
    target = np.array([0.0, 0.0, 0.5])
    cameras = []
    for a, e, d in zip(turn, elevation, distance, strict=True):
        center = target + d * np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
        forward = (target - center) / d
        right = np.array([-np.sin(a), np.cos(a), 0.0])
        rotation = np.stack([right, np.cross(forward, right), forward])
        pose = rigid(rotation, -rotation @ center)
        cameras.append(Camera(pose, focal, focal, width / 2, height / 2, width, height))
    return cameras


def observe(
    solids: rt.Solids,
    cameras: list[Camera],
    names: list[str],
    photographs: list[np.ndarray],  # [H, W, 3] uint8 each
    rng: np.random.Generator,
) -> tuple[list[ColmapImage], ColmapPoints]:
    """Poses with observations, and the points they belong to: surface points that enough views see.

    As in a real model, some observations belong to no point.
    """
    positions = _surface_points(solids, cameras, rng)
    pixels = np.stack([_project(positions, camera) for camera in cameras])  # [V, P, 2]
    visible = np.stack([_sees(positions, p, c, solids) for p, c in zip(pixels, cameras, strict=True)])
    kept = visible.sum(axis=0) >= MIN_TRACK
    positions, pixels, visible = positions[kept], pixels[:, kept], visible[:, kept]

    images, color_sum = [], np.zeros((len(positions), 3))
    for index, (camera, name) in enumerate(zip(cameras, names, strict=True)):
        seen = np.flatnonzero(visible[index])
        columns, rows = pixels[index, seen].astype(np.int64).T
        color_sum[seen] += photographs[index][rows, columns]
        strays = rng.random((len(seen) // 4, 2)) * (camera.width, camera.height)
        order = rng.permutation(len(seen) + len(strays))
        images.append(
            ColmapImage(
                image_id=index + 1,
                quaternion=quaternion_from_rotation(camera.rotation),
                translation=camera.translation,
                camera_id=1,
                name=name,
                observations=np.concatenate([pixels[index, seen], strays])[order],
                point_ids=np.concatenate([seen + 1, np.full(len(strays), -1)])[order],
            )
        )
    colors = np.round(color_sum / np.maximum(visible.sum(axis=0), 1)[:, None]).astype(np.uint8)
    ids = np.arange(1, len(positions) + 1, dtype=np.uint64)
    return images, ColmapPoints(ids, positions, colors, np.zeros(len(positions)))


def _surface_points(solids: rt.Solids, cameras: list[Camera], rng: np.random.Generator) -> np.ndarray:
    """[P, 3]: what random pixels of all cameras show."""
    share = -(-POINTS // len(cameras))
    found = []
    for camera in cameras:
        pixels = rng.random((share, 2)) * (camera.width, camera.height)
        rays = np.empty((share, 3))
        rays[:, 0] = (pixels[:, 0] - camera.cx) / camera.fx
        rays[:, 1] = (pixels[:, 1] - camera.cy) / camera.fy
        rays[:, 2] = 1.0
        rays = rays @ camera.rotation
        origins = np.broadcast_to(camera.center, rays.shape).copy()
        found.append(origins + rt.trace(solids, origins, rays)[:, None] * rays)
    return np.concatenate(found)[:POINTS]


def _project(positions: np.ndarray, camera: Camera) -> np.ndarray:
    """[P, 2] pixels; not a number behind the camera."""
    local = positions @ camera.rotation.T + camera.translation
    depth = np.where(local[:, 2] > 1e-6, local[:, 2], np.nan)
    return np.stack(
        [camera.fx * local[:, 0] / depth + camera.cx, camera.fy * local[:, 1] / depth + camera.cy], axis=1
    )


def _sees(positions: np.ndarray, pixels: np.ndarray, camera: Camera, solids: rt.Solids) -> np.ndarray:
    """[P] bool: inside the image, and nothing stands in front."""
    with np.errstate(invalid="ignore"):
        inside = ((pixels >= 0) & (pixels < (camera.width, camera.height))).all(axis=1)
    rays = positions - camera.center
    origins = np.broadcast_to(camera.center, rays.shape).copy()
    # distances in lengths of the ray: 1 is the point itself
    return inside & (rt.trace(solids, origins, rays) > 1 - 1e-4)
