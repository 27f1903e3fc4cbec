"""What was captured: `load_scene` finds the layout of a folder and reads views, poses and points.

| file | does |
|---|---|
| `views`, `points`, `world` | what a scene is: views, points, and the frame that it is trained in |
| `capture` | what the reader of each layout hands over, before any pixel is read |
| `colmap`, `colmap_capture`, `colmap_writer` | COLMAP's models and data sets |
| `blender`, `nerfstudio`, `transforms`, `frames`, `points_of_frames`, `ply_points` | layouts with poses in JSON |
| `images`, `image_cache`, `pixels`, `sizes`, `headers` | photographs: read, kept, converted, reduced; their headers |
| `lenses`, `undistort` | lens distortion, and how it is taken out |
| `masks`, `mask_files` | which pixels count |
| `names`, `text_files` | names and texts as other programs write them |
| `hold_out`, `split_names`, `angles` | which views are held out, and how far they are from the others |
| `doubt` | whether poses may be off by a pixel |
| `agreement` | whether the cameras took the photographs that they are said to have taken |
| `sight`, `viewpoints` | what cameras see, and the few that stand for all |
| `no_poses`, `unused` | what to say of folders without poses, and of files that are not used |
| `generated`, `ray_tracing` | a generated scene |
"""

import itertools
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np

from compgs.errors import ConfigError, MissingSparseModel, SceneError
from compgs.paths import as_path
from compgs.progress import counted
from compgs.scene.blender import TRAIN as SPLIT_FILE
from compgs.scene.blender import read_blender
from compgs.scene.capture import Capture, check_inside
from compgs.scene.colmap import find_sparse_model
from compgs.scene.colmap_capture import read_colmap
from compgs.scene.doubt import poses_in_doubt
from compgs.scene.hold_out import Split, check_split, every, sector
from compgs.scene.images import Progress, load_views
from compgs.scene.mask_files import with_masks, without_empty
from compgs.scene.names import in_other_formats
from compgs.scene.nerfstudio import read_nerfstudio
from compgs.scene.no_poses import check_there, no_poses
from compgs.scene.points import MIN_POINTS, fallback_points
from compgs.scene.sizes import AUTO, sized, turned
from compgs.scene.unused import unposed_photographs, unused_files
from compgs.scene.views import Points, Scene, View, scene_extent

__all__ = ["Points", "Scene", "View", "as_scene", "extent_of", "load_scene"]

IMAGES = "images"
FALLBACK_POINTS = 20_000  # random points of a scene without sparse points
MAX_DOWNSCALE = 32  # beyond it somebody means a width in pixels


@counted("reading views")
def load_scene(
    path: str | Path,
    *,
    downscale: int | Literal["auto"] = 1,  # images at 1 / downscale of their size; auto: at most LONGEST_SIDE
    images: str = IMAGES,  # folder of the images, inside the scene's (COLMAP)
    test_every: int = 8,  # every n-th of the name-sorted views is held out, the first included
    holdout: bool = True,  # False: all views are trained on
    split: Split = "auto",  # which views are held out: `scene/hold_out.py`
    background: tuple[float, float, float] | None = None,  # display RGB, 0 to 1; None: the layout's
    progress: Progress | Literal[False] | None = None,  # called with (done, total) views
    at_once: bool = True,  # photographs that all fit into memory are decoded now; False: when somebody looks
) -> Scene:
    """Reads a capture: COLMAP, nerfstudio (`transforms.json`) or a file for each split (`transforms_train.json`).

    What masks and transparent pixels leave out is in the views' `mask` (`compgs.scene.masks`); with a `background` that
    is given, and in Blender scenes, transparent pixels show it instead. Views of which nothing is left are left out.
    `notes` of the scene name whatever in its folder was not used.

    Raises SceneError or one of its kinds for missing, damaged or contradicting data, else ConfigError.
    """
    check_reading(downscale, test_every, background, split)
    folder = as_path(path, "path", "folder")
    capture = as_given = _read_layout(folder, images)
    _check_views(capture, folder)
    for posed in capture.images:
        check_inside(posed.path, (folder, folder / images), f"the image of the view {posed.name!r}")
    check_there(capture, folder, images)
    other_formats = in_other_formats((posed.name, posed.path) for posed in capture.images)
    capture = with_masks(turned(capture), folder, images)
    read = [*capture.files, *(p.path for p in capture.images), *(p.mask for p in capture.images if p.mask)]
    unused = unposed_photographs(folder / images, read)
    capture, factor, of_size = sized(capture, folder, images, downscale)
    read += [posed.path for posed in capture.images]
    unused += unused_files(folder, read, (folder / images,))

    behind = background or capture.background
    cut_out = capture.cut_out and background is None
    found, decoded = load_views(
        capture.images, factor, None if cut_out else behind, progress or None, at_once=at_once
    )
    points, of_points = _enough_points(capture, found)  # with a note, if they are random
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
    return Scene(
        name=folder.resolve().name,
        train_views=tuple(v for v in views if v.name not in held_out),
        test_views=tuple(v for v in views if v.name in held_out),
        points=points,
        background=behind,
        extent=extent,
        source=folder,
        notes=(*capture.notes, *other_formats, *of_size, *of_split, *of_masks, *of_points, *unused),
        poses_in_doubt=poses_in_doubt(folder, as_given, found),
        split=rule,
        guessed=bool(of_points),
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
    """Check the arguments of `load_scene`. Raises ConfigError for the first that no scene could be read by."""
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
        raise MissingSparseModel(no_poses(folder))
    if sparse is None and images != IMAGES:
        note = f"images={images} is not used: {capture.files[0].name} says where the images are"
        capture = replace(capture, notes=(*capture.notes, note))
    return replace(capture, images=tuple(sorted(capture.images, key=lambda posed: posed.name)))


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
