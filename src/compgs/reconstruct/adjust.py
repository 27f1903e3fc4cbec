"""Cameras that a capture has, made better: bundle adjustment, by features found anew.

Reconstructions of photographs whose lenses were undone before, each by an estimate of its own, can be off by half a
pixel in parts of every photograph, and no scene is sharp that is trained on them (docs/results/truck.md). Here poses,
principal points and distortions are fitted again, together with the points that features show. Focal lengths stay.
"""

import os
import shutil
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from compgs.errors import ConfigError, MissingSparseModel, SceneError
from compgs.numerics.nearest import nearest
from compgs.outputs import write_json
from compgs.reconstruct.mapping import AdjustJob, Progress, adjust_cameras, check_colmap, silent
from compgs.reconstruct.photographs import size_and_turn
from compgs.reconstruct.report import camera_center, viewing_direction
from compgs.reconstruct.scene_folder import new_scene
from compgs.scene.colmap import SparseModel, find_sparse_model, model_files, read_sparse_model
from compgs.scene.colmap_capture import image_path
from compgs.scene.colmap_writer import write_sparse_model
from compgs.scene.doubt import ADJUSTMENT
from compgs.scene.names import Names

# A photograph is compared with its 10 nearest, and every 4th of the next 50.
NEAR, WIDE, WIDE_EVERY = 10, 50, 4
AROUND = 12  # points of features that say how a given point moves
MOST_TURNED = 0.9  # radians between viewing directions: photographs that differ more share few features
LEFT_BEHIND = ("frames", "rigs", "project")  # files of COLMAP's beside a model, which no longer belong to it


@dataclass(frozen=True)
class AdjustOptions:
    """How features are found."""

    features: int = 6000  # most of a photograph
    feature_size: int = 1600  # pixels of the longer side: larger photographs are shrunk to find features
    threads: int | None = None
    seed: int = 0


@dataclass(frozen=True)
class Adjusted:
    """Says what came of it: errors in pixels of the photographs, before and after."""

    scene: Path
    photographs: int
    seldom_seen: tuple[str, ...]  # names of photographs with too few common points to say where they are
    points: int
    error_before: float  # mean distance from features to where the points are seen
    error_after: float
    # the same, of what is common to the features of a part of a photograph: a quadratic polynomial of the place
    shift_before: float
    shift_after: float
    seconds: float


def adjust(
    source: Path,
    scene: Path,
    options: AdjustOptions | None = None,
    *,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> Adjusted:
    """Write a copy of the COLMAP capture `source` to `scene`, with cameras that fit its photographs better.

    Photographs, masks and lists are linked, or copied where that is not possible. The world's frame stays: the cameras'
    centers lie as close to the former ones as a similarity brings them. The given points are carried along; where they
    are fewer than those of the features, these take their place.
    Raises SceneError and its kinds where there is no COLMAP model, or photographs are not those that it is of,
    MissingDependency without pycolmap, OutputError, ConfigError.
    """
    options = options or AdjustOptions()
    for name in ("features", "feature_size"):
        if getattr(options, name) < 128:
            raise ConfigError(f"{name} {getattr(options, name)}: expected 128 or more")
    check_colmap()
    if not source.is_dir():
        raise SceneError(f"{source}: expected the folder of a capture, found none")
    sparse = find_sparse_model(source)
    if sparse is None:
        raise MissingSparseModel(
            f"{source}: has no COLMAP model (sparse/0), and only those are adjusted; photographs without poses get "
            f"theirs from: compgs reconstruct {source} -o SCENE"
        )
    with new_scene(scene, overwrite=overwrite) as work:
        return _adjust_in(work, source, sparse, scene, options, progress or silent)


def _adjust_in(
    work: Path, source: Path, sparse: Path, scene: Path, options: AdjustOptions, progress: Progress
) -> Adjusted:
    began = time.monotonic()
    model = read_sparse_model(sparse)
    if len(model.images) < 3:
        raise SceneError(f"{sparse}: {len(model.images)} photographs with a pose; expected 3 or more")
    names = _photographs(work / "images", source, model)
    (work / "pairs.txt").write_text(
        "".join(f"{names[a]} {names[b]}\n" for a, b in pairs_in_view(model)), encoding="utf-8"
    )
    (work / "model").mkdir()
    job = AdjustJob(
        images=str(work / "images"),
        database=str(work / "database.db"),
        pairs=str(work / "pairs.txt"),
        given=str(sparse),
        names={image.name: name for image, name in zip(model.images, names, strict=True)},
        adjusted=str(work / "model"),
        features=options.features,
        feature_size=options.feature_size,
        threads=options.threads,
        seed=options.seed,
    )
    told = adjust_cameras(job, len(names), progress)
    target = work / "scene"
    _linked(source, target, sparse)
    _store(model, work, target / sparse.relative_to(source))
    result = Adjusted(
        scene=scene,
        photographs=len(names),
        seldom_seen=tuple(told["seldom_seen"]),
        points=int(told["points"]),
        error_before=float(told["error_before"]),
        error_after=float(told["error_after"]),
        shift_before=float(told["shift_before"]),
        shift_after=float(told["shift_after"]),
        seconds=time.monotonic() - began,
    )
    write_json(target / ADJUSTMENT, {**result.__dict__, "scene": scene.name})
    return result


def _store(given: SparseModel, work: Path, folder: Path) -> None:
    """Write the adjusted model. Where more points were given than features show, they are kept, and moved as the
    features around them were.
    """
    adjusted = read_sparse_model(work / "model")
    if len(given.points.positions) <= len(adjusted.points.positions):
        for file in adjusted.files:
            shutil.copyfile(file, folder / file.name)
        return
    moved = np.load(work / "moved.npz")
    points = replace(
        given.points,
        positions=carried(given.points.positions, moved["there"], moved["now"]),
        errors=np.full(len(given.points.positions), -1.0),  # not known
    )
    nothing, of_none = np.zeros((0, 2)), np.zeros(0, np.int64)
    images = [replace(image, observations=nothing, point_ids=of_none) for image in adjusted.images]
    write_sparse_model(folder, adjusted.cameras.values(), images, points)


def carried(points: np.ndarray, there: np.ndarray, now: np.ndarray) -> np.ndarray:
    """points [P, 3], each moved as those around it were: by the median over the `AROUND` nearest of `there` [M, 3],
    which are `now` [M, 3] elsewhere.
    """
    if len(there) == 0:
        return points
    _, around = nearest(there, points, min(AROUND, len(there)))
    return points + np.median((now - there)[around], axis=1)


def pairs_in_view(model: SparseModel) -> list[tuple[int, int]]:
    """Pairs of the model's images that may show the same, each once: near ones that look the same way."""
    looks = np.stack([viewing_direction(image) for image in model.images])
    centers = np.stack([camera_center(image) for image in model.images])
    reach = max(float(np.linalg.norm(centers - centers.mean(axis=0), axis=1).mean()), 1e-12)
    pairs = set()
    for first in range(len(centers)):
        angle = np.arccos(np.clip(looks @ looks[first], -1, 1))
        cost = np.linalg.norm(centers - centers[first], axis=1) / reach + angle
        cost[(angle > MOST_TURNED) | (np.arange(len(cost)) == first)] = np.inf
        order = np.argsort(cost, kind="stable")
        order = order[np.isfinite(cost[order])]
        for second in (*order[:NEAR], *order[NEAR : NEAR + WIDE : WIDE_EVERY]):
            pairs.add((min(first, int(second)), max(first, int(second))))
    return sorted(pairs)


def _photographs(folder: Path, source: Path, model: SparseModel) -> list[str]:
    """Links to the photographs, those of each camera in a folder of its own, by names without spaces; their names."""
    found, names = Names(), []
    for number, image in enumerate(model.images):
        path = image_path(image.name, source, source / "images", found)
        if not path.is_file():
            raise SceneError(f"{path}: the photograph of the model's image {image.name!r} is missing")
        size, turned = size_and_turn(path)
        camera = model.cameras[image.camera_id]
        if size != (camera.width, camera.height):
            raise SceneError(
                f"{path}: is of {size[0]} x {size[1]} pixels, its camera of {camera.width} x {camera.height}; give "
                "the photographs that the model was made of"
            )
        if turned:
            raise SceneError(
                f"{path}: its orientation tag asks for a turn, and features are found in photographs as they are "
                "stored; store it upright, or begin with compgs reconstruct"
            )
        name = f"{image.camera_id:08}/{number:08}{path.suffix.lower()}"
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        _link(str(path.absolute()), str(folder / name))
        names.append(name)
    return names


def _linked(source: Path, target: Path, sparse: Path) -> None:
    """The capture without its model and what came of that."""
    models = {file.name for file in model_files(sparse).values()}

    def without(folder: str, names: list[str]) -> list[str]:
        hidden = [name for name in names if name.startswith(".")]
        if Path(folder) != sparse:
            return hidden
        old = [name for name in names if name in models or Path(name).stem in LEFT_BEHIND]
        return hidden + old + [name for name in names if Path(name).stem.lower() == "points3d"]

    shutil.copytree(source, target, copy_function=_link, ignore=without)


def _link(source: str, target: str) -> None:
    """One file under two names; a copy where the disk has no such links."""
    try:
        os.link(os.path.realpath(source), target)
    except OSError:
        shutil.copyfile(source, target)
