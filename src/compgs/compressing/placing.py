"""Cameras for a scene of which there are only splats: around it and inside it, where there is something to see.

splats ──► shape ──► candidates ──probe──► those in the open that see something ──cover──► cameras
                                                                                  └─between──► held out
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from compgs.cameras import Camera
from compgs.compressing.probing import Probe, probe
from compgs.compressing.shape import shape_of
from compgs.compressing.surroundings import Lens, Surroundings
from compgs.errors import SceneError
from compgs.model.splats import SplatModel
from compgs.numerics.rotations import quaternion_from_rotation, rigid, rotation_from_quaternion

UP = (0.0, -1.0, 0.0)  # as COLMAP's worlds usually come out, and most files of splats with them
CANDIDATES = 3.0  # for each camera that is wanted
FEWEST_PLACES = 60  # candidates that are looked for however long it takes, or as many as cameras are wanted
TRIES = 12  # places for each candidate; in the open at least one of them is expected to be
SAMPLED = 20_000  # splats by which cameras are chosen
WELL_SEEN = 0.1  # of the largest weight that a splat has in any candidate's picture
# Sine of the angle above the horizon from which on a camera looks up: at a ceiling, or at a ground from below. Few do.
LOOKING_UP, RARELY = 0.17, 0.35
NEIGHBOURS = 4  # of a camera: the nearest ones, between which others are held out
BETWEEN = (0.25, 0.75)  # of the way from a camera to its neighbour
SHAKE = 0.1  # of the way: how far aside, about


@dataclass(frozen=True, eq=False)
class Placed:
    """Cameras of the world, to train with and to judge by."""

    train: tuple[Camera, ...]
    held_out: tuple[Camera, ...]


def place_cameras(
    model: SplatModel,
    count: int,
    held_out: int,
    *,
    lens: Lens | None = None,
    up: tuple[float, float, float] = UP,  # direction of the sky
    seed: int = 0,
    progress: Callable[[int, int], None] | None = None,
    until: float | None = None,
) -> Placed:
    """`count` cameras that between them see each splat that matters several times, and `held_out` others between them.

    The same ones for the same seed. `progress(done, total)` counts candidates. After `until`, on the clock of
    `time.monotonic`, no more of them are looked for than are needed. Raises SceneError if there is no place to look
    from.
    """
    chance = np.random.default_rng(seed)
    upward = np.asarray(up, dtype=np.float64) / np.linalg.norm(up)
    scene = Surroundings(model, shape_of(model), lens or Lens(), upward, chance)
    outside, wanted = scene.outside(), max(2, round(CANDIDATES * count))
    cameras: list[Camera] = []
    probes: list[Probe] = []
    for camera in scene.candidates(TRIES * wanted, outside):
        looked = probe(model, camera)
        if not looked.good:
            continue
        cameras.append(camera)
        probes.append(looked)
        if progress:
            progress(len(cameras), wanted)
        late = until is not None and time.monotonic() > until
        if len(cameras) == wanted or (late and len(cameras) >= min(count, FEWEST_PLACES)):
            break
    if len(cameras) < 2:
        raise SceneError(
            "no place was found from which these splats can be looked at: they are too few, too transparent, or fill "
            "all space; give cameras (--cameras)"
        )
    upwards = np.array([camera.rotation[2] @ upward > LOOKING_UP for camera in cameras])
    chosen = cover(probes, scene.shape.weights, np.where(upwards, RARELY, 1.0), count, chance)
    train = tuple(cameras[i] for i in chosen)
    return Placed(train, tuple(between(model, train, held_out, chance)))


def cover(
    probes: Sequence[Probe],
    weights: np.ndarray,  # [M] of the splats
    liking: np.ndarray,  # [C] of the candidates: what others see already counts that much
    count: int,
    chance: np.random.Generator,
) -> list[int]:
    """`count` of the candidates (all, if there are fewer), the best first: each adds most to what is seen.

    A splat that n cameras see well adds its weight / (n + 1) to the worth of the next one: first everything is seen
    once, then everything twice, the heavy ones more often.
    """
    sample = np.arange(len(weights))
    if len(weights) > SAMPLED:
        sample = np.sort(chance.choice(len(weights), SAMPLED, replace=False))
    row = np.full(len(weights), -1)
    row[sample] = np.arange(len(sample))
    seen = np.zeros((len(probes), len(sample)), dtype=np.float32)  # first by how much, then whether well
    for i, looked in enumerate(probes):
        rows = row[looked.splats]
        seen[i, rows[rows >= 0]] = looked.weights[rows >= 0]
    seen = ((seen >= WELL_SEEN * seen.max(axis=0)) & (seen > 0)).astype(np.float32)
    worths, times = weights[sample].astype(np.float32), np.zeros(len(sample), dtype=np.float32)
    chosen: list[int] = []
    for _ in range(min(count, len(probes))):
        new = worths * (times == 0)
        again = worths * (times > 0) / (1.0 + times)
        worth = seen @ new + liking * (seen @ again)
        worth[chosen] = -1.0
        chosen.append(int(worth.argmax()))
        times += seen[chosen[-1]]
    return chosen


def between(
    model: SplatModel, cameras: Sequence[Camera], count: int, chance: np.random.Generator
) -> list[Camera]:
    """`count` cameras in the open between neighbours of the given ones, a little aside; fewer where there are none.

    Neighbours stand close and look the same way, so what lies between two of them looks at the same things.
    """
    centers = np.stack([camera.center for camera in cameras])
    turns = np.stack([quaternion_from_rotation(camera.rotation) for camera in cameras])
    spread = max(float(np.sqrt(((centers - centers.mean(0)) ** 2).sum(1).mean())), 1e-30)
    places = np.concatenate([centers / spread, np.stack([camera.rotation[2] for camera in cameras])], axis=1)
    result: list[Camera] = []
    for _ in range(TRIES * count):
        one = int(chance.integers(len(cameras)))
        distances = np.linalg.norm(places - places[one], axis=1)
        distances[one] = np.inf
        near = np.argsort(distances, kind="stable")[: min(NEIGHBOURS, len(cameras) - 1)]
        other = int(chance.choice(near))
        way = chance.uniform(*BETWEEN)
        turn = turns[other] if turns[one] @ turns[other] >= 0 else -turns[other]
        rotation = rotation_from_quaternion((1 - way) * turns[one] + way * turn)
        aside = SHAKE * np.linalg.norm(centers[other] - centers[one]) * chance.normal(size=3)
        center = (1 - way) * centers[one] + way * centers[other] + aside
        camera = replace(cameras[one], world_to_camera=rigid(rotation, -rotation @ center))
        if probe(model, camera).good:
            result.append(camera)
        if len(result) == count:
            break
    return result
