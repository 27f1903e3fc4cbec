"""Two files of one scene beside each other: their bytes, and their pictures from the same cameras.

The files that it writes are described in `compgs.evaluation.compared_files`.
"""

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import fmean, median
from typing import TYPE_CHECKING, Literal

import numba
import numpy as np

from compgs import __version__, metrics
from compgs.cameras import Camera
from compgs.devices import chosen_device, device_name
from compgs.errors import SceneError, UnsupportedCamera
from compgs.evaluation.camera_path import camera_entry, read_cameras, surround
from compgs.evaluation.compared_files import ComparedFile, ComparedView, Comparison
from compgs.evaluation.held_out import check_held_out
from compgs.evaluation.measure import compared, encode_png, lpips_or_why_not, timed_decode, timed_render
from compgs.evaluation.reports.comparison_page import ComparisonPage
from compgs.evaluation.reports.pictures import difference_picture, levels_between, scale_for
from compgs.formats.tiled_scene import TiledScene
from compgs.model.hybrid_model import HybridModel
from compgs.model.splats import SplatModel
from compgs.opening import check_scene, component_bytes, format_of, scene_file, scene_name
from compgs.outputs import check_output_folder, filling, write_bytes, write_json
from compgs.paths import as_path
from compgs.progress import counted
from compgs.render import Renderable
from compgs.scene import as_scene
from compgs.scene.views import Scene, View

if TYPE_CHECKING:
    from compgs.devices import Device

PAGE_NAME = "comparison.html"
AROUND_EVERY = 3  # of the cameras around a scene: 24 of 72
LEAST_OWN = 2  # cameras that a file must keep for them to be enough to look from

Background = tuple[float, float, float]


@counted("comparing views")
def compare(
    a: str | Path,
    b: str | Path,
    *,
    scene: Scene | str | Path | None = None,
    cameras: Sequence[tuple[str, Camera]] | str | Path | None = None,
    background: Background | None = None,
    output: str | Path | None = None,
    overwrite: bool = False,
    lpips: bool | str | Path = False,
    device: "Device | None" = None,
    progress: Callable[[int, int], None] | Literal[False] | None = None,
) -> Comparison:
    """Open two files of any known formats (`compgs.formats`) and compare what they show.

    With a `scene` (or its folder, read as `load_scene(folder)` does) both are compared with its held-out photographs,
    too. Else they are seen from `cameras` (names and cameras, or a camera file), else from those that a file keeps,
    else from all around. Metrics are of 8-bit images (`compgs.metrics`).

    `background`, RGB, 0 to 1: behind both; by default that of the scene, of a .cgs file, or black. With a scene, a
    .cgs file keeps its own, as in an evaluation. With `output`, a folder, `results.json` and `per_view.json` (their
    schema: `compgs.evaluation.compared_files`), `cameras.json`, the pictures (`a`, `b`, `difference`, `gt`) and
    `comparison.html` are written there. `lpips`: as in `evaluate`. `progress(done, total)` is called after each view.

    Raises BitstreamError, SplatFileError, SceneError, OutputError.
    """
    paths = scene_file(as_path(a, "a")), scene_file(as_path(b, "b"))
    for path in paths:
        check_scene(path)
    if scene is not None and cameras is not None:
        raise SceneError("a scene and cameras were both given; give one")
    if output is not None:
        check_output_folder(Path(output), overwrite=overwrite)
    chosen = chosen_device(device)
    read = None if scene is None else as_scene(scene)
    sides, notes = _opened(paths, chosen, read, background)
    places, origin = _places(sides, read, cameras)
    if output is None:
        return _compared(sides, places, origin, read, notes, chosen, lpips, progress or None)
    with filling(Path(output)) as folder:
        page = ComparisonPage(scene_name(paths[0]), scene_name(paths[1]))

        def keep(row: ComparedView, pictures: dict[str, np.ndarray]) -> None:
            for name, picture in pictures.items():
                write_bytes(folder / name / row.file, encode_png(picture))
            page.keep(row, pictures)

        found = _compared(sides, places, origin, read, notes, chosen, lpips, progress or None, keep)
        write_json(folder / "cameras.json", [camera_entry(place.camera, place.name) for place in places])
        write_json(folder / "per_view.json", found.per_view_list())
        write_json(folder / "results.json", found.to_dict())
        write_bytes(folder / PAGE_NAME, page.html(found))
    return found


@dataclass(frozen=True, eq=False)
class _Side:
    """A file that is open."""

    path: Path
    model: Renderable
    decode_seconds: float


@dataclass(frozen=True, eq=False)
class _Place:
    """Where both are looked at from."""

    name: str
    camera: Camera
    view: View | None  # with a photograph


def _opened(
    paths: tuple[Path, Path], device: str, scene: Scene | None, background: Background | None
) -> tuple[tuple[_Side, _Side], tuple[str, ...]]:
    """Both files, over one background and in one place; and what was decided for that."""
    behind = background or (scene.background if scene else (0.0, 0.0, 0.0))
    opened = []
    for path in paths:
        timed_decode(path, device, behind)  # kernels are loaded: not what a file costs
        opened.append(_Side(path, *timed_decode(path, device, behind)))
    models, notes = [side.model for side in opened], []
    own = [model.background for model in models if isinstance(model, HybridModel | TiledScene)]
    if background is None and scene is None and own:
        models, behind = [model.over(own[0]) for model in models], own[0]
        if len(set(own)) > 1:
            notes.append(f"backgrounds differ, {own[0]} and {own[1]}: both are shown over the first")
    elif background is not None:
        models = [model.over(background) for model in models]
    for i, (model, other) in enumerate(zip(models, models[::-1], strict=True)):
        if _counts_from_the_other(model, other):
            assert isinstance(model, SplatModel)
            models[i] = model.at(other.world_offset)
            place = " ".join(f"{x:.12g}" for x in other.world_offset)
            notes.append(f"{paths[i].name} does not say where its positions count from: taken as {place}")
    one, two = (replace(side, model=model) for side, model in zip(opened, models, strict=True))
    return (one, two), tuple(notes)


def _counts_from_the_other(model: Renderable, other: Renderable) -> bool:
    """Splats whose positions are those of the other's local frame, which most formats have no place to say."""
    if not isinstance(model, SplatModel) or any(model.world_offset) or not any(other.world_offset):
        return False
    middle, others = (np.median(m.bounds[0].astype(np.float64), 0) for m in (model, other))
    world = others + np.array(other.world_offset)
    return bool(np.linalg.norm(middle - others) < np.linalg.norm(middle - world))


def _places(
    sides: tuple[_Side, _Side],
    scene: Scene | None,
    cameras: Sequence[tuple[str, Camera]] | str | Path | None,
) -> tuple[list[_Place], str]:
    """Where to look from, and in words where that comes from. Raises SceneError."""
    if scene is not None:
        if not scene.test_views:
            raise SceneError(f"{scene.name}: no view is held out to compare with; load with hold-out")
        check_held_out(scene)
        places = [_Place(view.name, view.camera, view) for view in scene.test_views]
        return places, f"held-out views of {scene.name}"
    if cameras is not None:
        given = read_cameras(Path(cameras)) if isinstance(cameras, str | Path) else cameras
        if not given:
            raise UnsupportedCamera("no cameras were given to compare from")
        origin = f"cameras of {Path(cameras).name}" if isinstance(cameras, str | Path) else "given cameras"
        return [_Place(name, camera, None) for name, camera in given], origin
    for side in sides:
        kept = side.model.viewpoints
        if len(kept) >= LEAST_OWN:
            return [
                _Place(f"camera {i}", camera, None) for i, camera in enumerate(kept)
            ], f"cameras that {scene_name(side.path)} keeps"
    model = sides[0].model
    around = surround(model.bounds[0])[::AROUND_EVERY]
    back = -np.array(model.world_offset)
    return [_Place(name, camera.moved(back), None) for name, camera in around], "cameras around the scene"


def _compared(
    sides: tuple[_Side, _Side],
    places: Sequence[_Place],
    origin: str,
    scene: Scene | None,
    notes: tuple[str, ...],
    device: str,
    lpips: bool | str | Path,
    progress: Callable[[int, int], None] | None,
    keep: Callable[[ComparedView, dict[str, np.ndarray]], None] | None = None,
) -> Comparison:
    """`keep` is given each view and its pictures: a, b, difference and, where there is one, the photograph as gt."""
    for side in sides:
        timed_render(side.model, places[0].camera)  # caches are filled: not what a view costs
    network, lpips_note = lpips_or_why_not(lpips, device)
    rows: list[ComparedView] = []
    seconds: list[list[float]] = []
    for i, place in enumerate(places):
        (a, a_seconds), (b, b_seconds) = (timed_render(side.model, place.camera) for side in sides)
        photograph = None if place.view is None else place.view.image
        levels = levels_between(a, b)
        scale = scale_for([levels])
        a_quality, b_quality = (_quality(image, place.view, network) for image in (a, b))
        between = None if network is None else metrics.lpips(b, a, network)
        rows.append(
            ComparedView(
                name=place.name,
                file=f"{i:05d}.png",
                psnr=metrics.psnr(a, b),
                ssim=metrics.ssim(b, a),
                lpips=None if between is None else between.lpips,
                lpips_3dgs=None if between is None else between.lpips_3dgs,
                **{f"a_{name}": value for name, value in a_quality.items()},
                **{f"b_{name}": value for name, value in b_quality.items()},
                difference_scale=scale,
            )
        )
        seconds.append([a_seconds, b_seconds])
        if keep:
            pictures = {"a": a, "b": b, "difference": difference_picture(levels, scale)}
            keep(rows[-1], pictures if photograph is None else {**pictures, "gt": photograph})
        if progress:
            progress(i + 1, len(places))
    return Comparison(
        compgs=__version__,
        a=_described(sides[0], "a", rows, [pair[0] for pair in seconds]),
        b=_described(sides[1], "b", rows, [pair[1] for pair in seconds]),
        scene=scene.name if scene else None,
        cameras=origin,
        width=places[0].camera.width,
        height=places[0].camera.height,
        device=device_name(device),
        threads=numba.get_num_threads(),
        lpips_note=lpips_note,
        notes=notes,
        per_view=tuple(rows),
    )


QUALITY = ("psnr", "ssim", "lpips", "lpips_3dgs")  # against the photographs


def _quality(
    image: np.ndarray, view: View | None, network: metrics.LpipsNetwork | None
) -> dict[str, float | None]:
    """Against the photograph, where there is one and its mask counts; LPIPS, where there is a network."""
    if view is None:
        return dict.fromkeys(QUALITY)
    seen, photograph, mask = compared(image, view)
    distances = (None, None) if network is None else metrics.lpips(seen, photograph, network, mask)
    values = (metrics.psnr(seen, photograph, mask), metrics.ssim(seen, photograph, mask), *distances)
    return dict(zip(QUALITY, values, strict=True))


def _described(
    side: _Side,
    name: str,  # "a" or "b"
    rows: Sequence[ComparedView],
    seconds: Sequence[float],
) -> ComparedFile:
    components = component_bytes(side.path)
    counts = side.model.counts
    return ComparedFile(
        file=scene_name(side.path),
        format=format_of(side.path).name,
        bytes=sum(components.values()),  # of a meta.json that of its pictures, too
        sha256=hashlib.sha256(side.path.read_bytes()).hexdigest(),
        components=components,
        primitives=counts.get("splats") or counts.get("coupled_primitives") or 0,
        anchors=counts.get("anchors"),
        coupled_primitives=counts.get("coupled_primitives"),
        splats=counts.get("splats"),
        **{key: _mean([getattr(row, f"{name}_{key}") for row in rows]) for key in QUALITY},
        decode_seconds=side.decode_seconds,
        render_seconds=median(seconds),
    )


def _mean(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return fmean(known) if known else None
