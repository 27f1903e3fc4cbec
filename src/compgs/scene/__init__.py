"""What was captured: `load_scene` finds the layout of a folder and reads views, poses and points."""

import itertools
import shlex
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from compgs.errors import ConfigError, MissingSparseModel, SceneError
from compgs.scene.blender import read_blender
from compgs.scene.capture import Capture, PosedImage, check_inside
from compgs.scene.colmap import find_sparse_model
from compgs.scene.colmap_capture import read_colmap
from compgs.scene.images import Progress, image_size, load_views
from compgs.scene.masks import FOLDER as MASKS
from compgs.scene.masks import find_mask
from compgs.scene.nerfstudio import read_nerfstudio
from compgs.scene.points import MIN_POINTS, fallback_points
from compgs.scene.unused import unposed_photographs
from compgs.scene.views import Points, Scene, View, scene_extent

__all__ = ["Points", "Scene", "View", "as_scene", "extent_of", "load_scene"]

FALLBACK_POINTS = 20_000  # random points of a scene without sparse points
MAX_DOWNSCALE = 32  # beyond it somebody means a width in pixels


def load_scene(
    path: str | Path,
    *,
    downscale: int = 1,  # images at 1 / downscale of their size
    images: str = "images",  # folder of the images, inside the scene's (COLMAP)
    test_every: int = 8,  # every n-th of the name-sorted views is held out, the first included
    holdout: bool = True,  # False: all views are trained on
    background: tuple[float, float, float] | None = None,  # display RGB, 0 to 1; None: the layout's
    progress: Progress | None = None,  # called with (done, total) views
    at_once: bool = True,  # photographs that all fit into memory are decoded now; False: when somebody looks
) -> Scene:
    """Reads a capture: COLMAP, Blender (`transforms_train.json`) or nerfstudio (`transforms.json`).

    What masks and transparent pixels leave out is in the views' `mask` (`compgs.scene.masks`); with a `background` that
    is given, and in Blender scenes, transparent pixels show it instead.

    Raises SceneError or one of its kinds for missing, damaged or contradicting data, else ConfigError.
    """
    check_reading(downscale, test_every, background)
    folder = Path(path)
    capture = _read_layout(folder, images)
    _check_views(capture, folder)
    for posed in capture.images:
        check_inside(posed.path, (folder, folder / images), f"the image of the view {posed.name!r}")
    unposed = unposed_photographs(folder / images, [posed.path for posed in capture.images])
    capture = _with_masks(capture, folder, images)
    capture, downscale = _prescaled(capture, folder, images, downscale)

    behind = background or capture.background
    cut_out = capture.cut_out and background is None
    views = load_views(capture.images, downscale, None if cut_out else behind, progress, at_once=at_once)
    held_out = _held_out(capture, test_every) if holdout else frozenset()
    points, notes = _enough_points(capture, views)
    return Scene(
        name=folder.resolve().name,
        train_views=tuple(v for v in views if v.name not in held_out),
        test_views=tuple(v for v in views if v.name in held_out),
        points=points,
        background=behind,
        extent=extent_of(views, points),
        source=folder,
        notes=capture.notes + unposed + notes,
    )


def as_scene(scene: Scene | str | Path) -> Scene:
    """The scene itself, or of a folder what `load_scene` reads by default.

    Raises what `load_scene` raises, and ConfigError for what is neither.
    """
    if isinstance(scene, Scene):
        return scene
    if isinstance(scene, str | Path):
        return load_scene(scene)
    raise ConfigError(
        f"scene: expected what compgs.load_scene gives, or the folder of a scene, found {type(scene).__name__}"
    )


def check_reading(downscale: int, test_every: int, background: tuple[float, float, float] | None) -> None:
    """Of the arguments of `load_scene`: raises ConfigError for the first that no scene could be read by."""
    if not 1 <= downscale <= MAX_DOWNSCALE or int(downscale) != downscale:
        raise ConfigError(
            f"downscale {downscale}: expected a whole number from 1 to {MAX_DOWNSCALE}, a factor, not a width"
        )
    if test_every < 2:
        raise ConfigError(f"test_every {test_every}: expected at least 2, so that views are left to train on")
    if background is not None and not (len(background) == 3 and all(0 <= c <= 1 for c in background)):
        raise ConfigError(f"background {background}: expected three numbers from 0 to 1")


def _read_layout(folder: Path, images: str) -> Capture:
    if not folder.is_dir():
        what = "is a file" if folder.exists() else "does not exist"
        raise SceneError(f"{folder}: {what}; expected the folder of a scene")
    if not any(folder.iterdir()):
        raise SceneError(f"{folder}: the folder is empty; expected the folder of a scene")
    sparse = find_sparse_model(folder)
    if sparse is not None:
        capture = read_colmap(folder, sparse, folder / images)
    elif (folder / "transforms_train.json").is_file():
        capture = read_blender(folder)
    elif (folder / "transforms.json").is_file():
        capture = read_nerfstudio(folder)
    else:
        raise MissingSparseModel(
            f"{folder}: no camera poses found; expected a COLMAP sparse model (cameras.bin, images.bin and "
            f"points3D.bin in sparse/0), transforms_train.json (Blender) or transforms.json (nerfstudio). "
            f"For photographs alone, or a video, run: compgs reconstruct {shlex.quote(str(folder))} -o SCENE"
        )
    return replace(capture, images=tuple(sorted(capture.images, key=lambda posed: posed.name)))


def _check_views(capture: Capture, folder: Path) -> None:
    names = [posed.name for posed in capture.images]
    for name, following in itertools.pairwise(names):
        if name == following:
            raise SceneError(f"{folder}: the view {name!r} has more than one pose; remove the others")
    if len(names) < 2:
        raise SceneError(f"{folder}: {len(names)} view with a pose; a scene needs at least 2")


def _with_masks(capture: Capture, folder: Path, images: str) -> Capture:
    """With the files of `masks/`, and what of it is not used. Raises SceneError for masks outside of the scene."""
    masks = folder / MASKS
    if masks.is_dir():
        capture = replace(
            capture,
            images=tuple(
                posed
                if posed.mask
                else replace(posed, mask=_mask_of(posed, masks, (folder / images, folder)))
                for posed in capture.images
            ),
        )
    for posed in capture.images:
        if posed.mask is not None:
            check_inside(posed.mask, (folder,), f"the mask of the view {posed.name!r}")
    masked = sum(posed.mask is not None for posed in capture.images)
    if not masks.is_dir() and not masked:
        return capture
    if masked == 0:
        note = f"{MASKS}/ is not used: it has a mask for no view; names are as in {images}/, with .png at the end"
    else:
        note = (
            f"masks: {masked} of {len(capture.images)} views have one; where it is black, pixels do not count"
        )
    return replace(capture, notes=(*capture.notes, note))


def _mask_of(posed: PosedImage, masks: Path, folders: tuple[Path, ...]) -> Path | None:
    """By the name of the photograph relative to the first of the folders that it is in."""
    for folder in folders:
        if posed.path.is_relative_to(folder):
            found = find_mask(masks, str(posed.path.relative_to(folder)))
            if found is not None:
                return found
    return None


def _prescaled(capture: Capture, folder: Path, images: str, downscale: int) -> tuple[Capture, int]:
    """Takes the images from `images_<downscale>` where that folder has all of them in the promised size."""
    smaller = folder / f"{images}_{downscale}"
    if downscale == 1 or not smaller.is_dir():
        return capture, downscale
    swapped = []
    for posed in capture.images:
        if not posed.path.is_relative_to(folder / images):
            return capture, downscale
        path = smaller / posed.path.relative_to(folder / images)
        if not path.is_file() or not _is_smaller_copy(posed, path, downscale):
            note = (
                f"{smaller.name} is not used: {path.name} is missing there or not 1/{downscale} of its size"
            )
            return replace(capture, notes=(*capture.notes, note)), downscale
        swapped.append(replace(posed, path=path))
    return replace(capture, images=tuple(swapped)), 1


def _is_smaller_copy(posed: PosedImage, path: Path, downscale: int) -> bool:
    width, height = image_size(path)
    camera = posed.camera
    return abs(width - camera.width / downscale) <= 1 and abs(height - camera.height / downscale) <= 1


def _held_out(capture: Capture, test_every: int) -> frozenset[str]:
    if capture.test_names is not None:
        return capture.test_names
    return frozenset(posed.name for posed in capture.images[::test_every])


def _enough_points(capture: Capture, views: list[View]) -> tuple[Points, tuple[str, ...]]:
    found = _different(capture.points.positions)
    if found >= MIN_POINTS:
        return capture.points, ()
    random = fallback_points([view.camera for view in views], FALLBACK_POINTS)
    both = Points(
        np.concatenate([capture.points.positions, random.positions]),
        np.concatenate([capture.points.colors, random.colors]),
    )
    note = (
        f"{capture.points_source} has {found} points in different places, too few to start from: "
        f"{len(random)} random ones were added where the cameras look"
    )
    return both, (note,)


def _different(positions: np.ndarray) -> int:  # positions: [P, 3]
    """Number of different positions, of at least `MIN_POINTS` perhaps not all."""
    few = len(np.unique(positions[: 10 * MIN_POINTS], axis=0))
    return few if few >= MIN_POINTS else len(np.unique(positions, axis=0))


def extent_of(views: Sequence[View], points: Points) -> float:
    """World units: as `scene_extent`; of views that are all from one place, the distance of the points."""
    centers = np.stack([view.camera.center for view in views])
    extent = scene_extent(centers)
    distance = float(np.median(np.linalg.norm(points.positions - centers.mean(axis=0), axis=1)))
    # Not beside the distance to the origin, which says nothing: a capture may be in geographic coordinates.
    if extent > 1e-6 * distance:
        return extent
    # all views from one place: the distance of the points is the only length there is
    return distance
