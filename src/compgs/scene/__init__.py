"""What was captured: `load_scene` finds the layout of a folder and reads views, poses and points."""

import itertools
import shlex
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import Literal

import numpy as np

from compgs.errors import ConfigError, MissingSparseModel, SceneError, UnreadableImage
from compgs.scene.blender import TRAIN as SPLIT_FILE
from compgs.scene.blender import read_blender
from compgs.scene.capture import Capture, PosedImage, check_inside
from compgs.scene.colmap import find_sparse_model
from compgs.scene.colmap_capture import read_colmap
from compgs.scene.hold_out import Split, check_split, every, sector
from compgs.scene.images import (
    Progress,
    downscaled_size,
    image_size,
    load_views,
    stored_size,
    turned_as_cameras_are,
)
from compgs.scene.mask_files import with_masks, without_empty
from compgs.scene.names import Names, in_other_formats
from compgs.scene.nerfstudio import read_nerfstudio
from compgs.scene.points import MIN_POINTS, fallback_points
from compgs.scene.unused import unposed_photographs, unused_files
from compgs.scene.views import Points, Scene, View, scene_extent

__all__ = ["Points", "Scene", "View", "as_scene", "extent_of", "load_scene"]

IMAGES = "images"
AUTO = "auto"
LARGE = 2_000_000  # pixels of a photograph, from which `downscale="auto"` reduces
LONGEST_SIDE = 1_600  # pixels that it leaves of the longer side, as 3DGS does
FALLBACK_POINTS = 20_000  # random points of a scene without sparse points
MAX_DOWNSCALE = 32  # beyond it somebody means a width in pixels


def load_scene(
    path: str | Path,
    *,
    downscale: int | Literal["auto"] = 1,  # images at 1 / downscale of their size; auto: at most LONGEST_SIDE
    images: str = IMAGES,  # folder of the images, inside the scene's (COLMAP)
    test_every: int = 8,  # every n-th of the name-sorted views is held out, the first included
    holdout: bool = True,  # False: all views are trained on
    split: Split = "auto",  # which views are held out: `scene/hold_out.py`
    background: tuple[float, float, float] | None = None,  # display RGB, 0 to 1; None: the layout's
    progress: Progress | None = None,  # called with (done, total) views
    at_once: bool = True,  # photographs that all fit into memory are decoded now; False: when somebody looks
) -> Scene:
    """Reads a capture: COLMAP, nerfstudio (`transforms.json`) or a file for each split (`transforms_train.json`).

    What masks and transparent pixels leave out is in the views' `mask` (`compgs.scene.masks`); with a `background` that
    is given, and in Blender scenes, transparent pixels show it instead. Views of which nothing is left are left out.
    `notes` of the scene name whatever in its folder was not used.

    Raises SceneError or one of its kinds for missing, damaged or contradicting data, else ConfigError.
    """
    check_reading(downscale, test_every, background, split)
    folder = Path(path)
    capture = _read_layout(folder, images)
    _check_views(capture, folder)
    for posed in capture.images:
        check_inside(posed.path, (folder, folder / images), f"the image of the view {posed.name!r}")
    _check_there(capture, folder, images)
    other_formats = in_other_formats((posed.name, posed.path) for posed in capture.images)
    capture = with_masks(_turned(capture), folder, images)
    read = [*capture.files, *(p.path for p in capture.images), *(p.mask for p in capture.images if p.mask)]
    unused = unposed_photographs(folder / images, read)
    capture, factor, of_size = _sized(capture, folder, images, downscale)
    read += [posed.path for posed in capture.images]
    unused += unused_files(folder, read, (folder / images,))

    behind = background or capture.background
    cut_out = capture.cut_out and background is None
    found, decoded = load_views(
        capture.images, factor, None if cut_out else behind, progress, at_once=at_once
    )
    points, of_points = _enough_points(capture, found)
    extent = extent_of(found, points)
    held_out, rule, of_split = (
        _held_out(capture, found, points, extent, test_every, split)
        if holdout
        else (frozenset[str](), "", ())
    )
    # Of a capture larger than memory only masks are worth decoding photographs twice.
    looked_at = [decoded or (at_once and posed.mask is not None) for posed in capture.images]
    views, of_masks = without_empty(found, looked_at)
    if held_out and not any(view.name in held_out for view in views):
        held_out = every([view.name for view in views], test_every)
    if all(view.name in held_out for view in views):
        raise SceneError(f"{folder}: all {len(views)} views are held out; name some to train on ({rule})")
    return Scene(
        name=folder.resolve().name,
        train_views=tuple(v for v in views if v.name not in held_out),
        test_views=tuple(v for v in views if v.name in held_out),
        points=points,
        background=behind,
        extent=extent,
        source=folder,
        notes=(*capture.notes, *other_formats, *of_size, *of_split, *of_masks, *of_points, *unused),
        split=rule,
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


def check_reading(
    downscale: int | str,
    test_every: int,
    background: tuple[float, float, float] | None,
    split: str = "auto",
) -> None:
    """Of the arguments of `load_scene`: raises ConfigError for the first that no scene could be read by."""
    if downscale != AUTO and not (
        isinstance(downscale, int | float) and 1 <= downscale <= MAX_DOWNSCALE and int(downscale) == downscale
    ):
        raise ConfigError(
            f"downscale {downscale}: expected a whole number from 1 to {MAX_DOWNSCALE}, a factor, not a width, or "
            f"{AUTO}"
        )
    check_split(split)
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
    elif (folder / SPLIT_FILE).is_file():
        capture = read_blender(folder)
    elif (folder / "transforms.json").is_file():
        capture = read_nerfstudio(folder)
    else:
        raise MissingSparseModel(_no_poses(folder))
    if sparse is None and images != IMAGES:
        note = f"images={images} is not used: {capture.files[0].name} says where the images are"
        capture = replace(capture, notes=(*capture.notes, note))
    return replace(capture, images=tuple(sorted(capture.images, key=lambda posed: posed.name)))


# Files of poses that are not read, as patterns of their names, and whose they are.
POSES_OF_OTHERS = {
    "poses_bounds.npy": "LLFF",
    "*.nvm": "VisualSFM",
    "bundle*.out": "Bundler",
    "cameras.xml": "Metashape or RealityScan",
    "*.xmp": "RealityScan",
    "images/*.xmp": "RealityScan",
    "*.abc": "Alembic",
    "sfm_data.json": "OpenMVG",
    "cameras.sfm": "Meshroom",
    "reconstruction.json": "OpenSfM",
}


def _pattern(file: Path) -> str:
    return next(pattern for pattern in POSES_OF_OTHERS if file.match(pattern))


def _no_poses(folder: Path) -> str:
    """What to do with a folder in which no poses were found: somewhere inside it there may be some."""
    deeper = [place for pattern in ("*/", "*/*/", "*/*/*/") for place in sorted(folder.glob(pattern))]
    if (folder / "database.db").is_file():
        return (
            f"{folder}: no camera poses found; database.db has COLMAP's features and matches, but no poses: run "
            f"`colmap mapper`, which writes sparse/0, or: compgs reconstruct {shlex.quote(str(folder))} -o SCENE"
        )
    others = [file for pattern in POSES_OF_OTHERS for file in sorted(folder.glob(pattern))]
    if others:
        return (
            f"{folder}: {others[0].relative_to(folder)} is not read: poses of {POSES_OF_OTHERS[_pattern(others[0])]}; "
            f"export them from there for COLMAP (sparse/0) or nerfstudio (transforms.json), beside {IMAGES}/"
        )
    inside = [p for p in deeper if find_sparse_model(p) == p or (p / "transforms.json").is_file()]
    if inside:
        way = f"; there are some in {inside[0].relative_to(folder)}/"
        return (
            f"{folder}: no camera poses found where they are expected: a COLMAP sparse model in sparse/0, "
            f"{SPLIT_FILE} or transforms.json{way}: name the folder of that scene, or put it there, beside {IMAGES}/"
        )
    return (
        f"{folder}: no camera poses found; expected a COLMAP sparse model (cameras.bin, images.bin and "
        f"points3D.bin in sparse/0), transforms_train.json (Blender) or transforms.json (nerfstudio). "
        f"For photographs alone, or a video, run: compgs reconstruct {shlex.quote(str(folder))} -o SCENE"
    )


def _check_there(capture: Capture, folder: Path, images: str) -> None:
    """Raises UnreadableImage where photographs are missing that lie in another folder inside the scene's."""
    missing = [posed for posed in capture.images if not posed.path.is_file()]
    if not missing:
        return
    names, wanted = Names(), PurePosixPath(missing[0].name)
    for place in sorted(path for path in folder.iterdir() if path.is_dir()):
        if any(names.find(place, str(name)) for name in (wanted, wanted.name)):
            raise UnreadableImage(
                f"{missing[0].path}: this view's image does not exist; {place.name}/ has one of that name: name that "
                f"folder with images=..., or rename it to {images}"
            )


def _check_views(capture: Capture, folder: Path) -> None:
    names = [posed.name for posed in capture.images]
    for name, following in itertools.pairwise(names):
        if name == following:
            raise SceneError(f"{folder}: the view {name!r} has more than one pose; remove the others")
    first: dict[Path, str] = {}
    for posed in capture.images:
        other = first.setdefault(posed.path, posed.name)
        if other != posed.name:
            raise SceneError(
                f"{folder}: the views {other!r} and {posed.name!r} are one photograph, {posed.path.name}, with more "
                "than one pose; remove the others"
            )
    if len(names) < 2:
        raise SceneError(f"{folder}: {len(names)} view with a pose; a scene needs at least 2")


def _turned(capture: Capture) -> Capture:
    """With images turned by their orientation tag where their cameras are of turned ones, and a sentence about it."""
    images = turned_as_cameras_are(capture.images)
    count = sum(posed.turned for posed in images)
    if not count:
        return capture
    note = f"{count} of {len(images)} photographs are turned by their orientation tag: so their cameras are"
    return replace(capture, images=images, notes=(*capture.notes, note))


def _sized(
    capture: Capture, folder: Path, images: str, downscale: int | str
) -> tuple[Capture, float, tuple[str, ...]]:
    """The capture, the factor by which its images are to be reduced, and what is to be noted."""
    if downscale != AUTO:
        return *_prescaled(capture, folder, images, int(downscale)), ()
    largest = max(
        (image_size(posed.path) for posed in capture.images if posed.path.is_file()),
        key=lambda size: size[0] * size[1],
        default=(1, 1),
    )
    if largest[0] * largest[1] <= LARGE or max(largest) <= LONGEST_SIDE:
        return capture, 1, ()
    factor = max(largest) / LONGEST_SIDE
    width, height = downscaled_size(largest, factor)
    note = (
        f"photographs of {largest[0]} x {largest[1]} pixels are read at {width} x {height} (downscale=auto); "
        "downscale=1 reads all their pixels"
    )
    return capture, factor, (note,)


def _prescaled(capture: Capture, folder: Path, images: str, downscale: int) -> tuple[Capture, int]:
    """Takes the images from `images_<downscale>` where that folder has all of them in the promised size."""
    smaller = folder / f"{images}_{downscale}"
    if downscale == 1 or not smaller.is_dir():
        return capture, downscale
    swapped, names = [], Names()
    for posed in capture.images:
        if not posed.path.is_relative_to(folder / images):
            return capture, downscale
        name = posed.path.relative_to(folder / images).as_posix()
        path = names.find(smaller, name)
        if path is None or not _is_smaller_copy(posed, path, downscale):
            note = f"{smaller.name} is not used: {Path(name).name} is missing there or not 1/{downscale} of its size"
            return replace(capture, notes=(*capture.notes, note)), downscale
        swapped.append(replace(posed, path=path, turned=False))
    return replace(capture, images=turned_as_cameras_are(swapped)), 1


def _is_smaller_copy(posed: PosedImage, path: Path, downscale: int) -> bool:
    size, sideways = stored_size(path)
    camera = posed.camera
    return any(
        abs(width - camera.width / downscale) <= 1 and abs(height - camera.height / downscale) <= 1
        for width, height in (size, size[::-1])[: 1 + sideways]
    )


def _held_out(
    capture: Capture, views: Sequence[View], points: Points, extent: float, test_every: int, split: Split
) -> tuple[frozenset[str], str, tuple[str, ...]]:
    """Names of the views to hold out, by which rule, in words, and what is to be noted."""
    names = [view.name for view in views]
    if split == "auto" and capture.test_names is not None:
        return capture.test_names, f"by {capture.split}" if capture.split else "", ()
    notes = (
        ()
        if capture.test_names is None
        else (f"{capture.split}: not followed, as split={split} is asked for",)
    )
    if split == "sector":
        cameras = [view.camera for view in views]
        chosen = sector(names, cameras, points.positions, extent, test_every)
        return chosen, f"a sector of {len(chosen)} of {len(names)} views", notes
    return every(names, test_every), f"one in {test_every} by name", notes


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
