"""How far poses that were found are from given ones, after the best similarity between the two worlds.

    compgs reconstruct ../shared/scenes/plush_960/images -o scenes/plush_found
    python benchmarks/poses.py ../shared/scenes/plush_960 scenes/plush_found

Prints, over the views that both scenes have: the distance between camera centers as a share of the median distance of
the given centers from their middle, the angle between viewing rotations, and the ratio of focal lengths.
"""

import argparse
from pathlib import Path

import numpy as np

from compgs.scene import load_scene


def similarity(found: np.ndarray, given: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """Scale, rotation [3, 3] and shift [3] that bring `found` [V, 3] closest to `given` [V, 3] (Umeyama 1991)."""
    a, b = found - found.mean(0), given - given.mean(0)
    u, s, vt = np.linalg.svd(b.T @ a)
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    rotation = (u * sign) @ vt
    scale = float((s * sign).sum() / (a**2).sum())
    return scale, rotation, given.mean(0) - scale * rotation @ found.mean(0)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("given", type=Path)
    parser.add_argument("found", type=Path)
    options = parser.parse_args()
    scenes = [load_scene(folder, holdout=False) for folder in (options.given, options.found)]
    given, found = ({view.name: view.camera for view in scene.train_views} for scene in scenes)
    names = sorted(given.keys() & found.keys())
    a = np.stack([found[name].center for name in names])
    b = np.stack([given[name].center for name in names])
    scale, turn, shift = similarity(a, b)
    distances = np.linalg.norm(scale * a @ turn.T + shift - b, axis=1)
    distances /= np.median(np.linalg.norm(b - b.mean(0), axis=1))
    angles = []
    for name in names:
        between = found[name].world_to_camera[:3, :3] @ turn.T @ given[name].world_to_camera[:3, :3].T
        angles.append(np.degrees(np.arccos(np.clip((np.trace(between) - 1) / 2, -1, 1))))
    focal = np.median([found[name].fx / given[name].fx for name in names])
    print(f"{len(names)} views of {len(given)} given and {len(found)} found")
    print(f"centers: {100 * np.median(distances):.3f} % median, {100 * distances.max():.3f} % worst")
    print(f"rotations: {np.median(angles):.3f} degrees median, {max(angles):.3f} worst")
    print(f"focal lengths: {focal:.4f} of the given ones")


if __name__ == "__main__":
    main()
