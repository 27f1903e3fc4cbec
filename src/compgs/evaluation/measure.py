"""Rate and distortion of a file, measured on what is read from it, never on a trained model."""

import hashlib
import io
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numba
import numpy as np
from PIL import Image

from compgs import __version__, metrics
from compgs.cameras import Camera
from compgs.devices import chosen_device, device_name
from compgs.errors import SceneError
from compgs.evaluation.alignment import aligned_camera
from compgs.evaluation.camera_path import camera_entry
from compgs.evaluation.contact_sheet import contact_sheet, striped
from compgs.evaluation.error_account import ErrorSums
from compgs.evaluation.error_sheet import error_sheet
from compgs.evaluation.exposure import with_fitted_colors
from compgs.evaluation.fit import misfits
from compgs.evaluation.held_out import check_held_out, check_view, degrees_to_training
from compgs.evaluation.results import Results, ViewResult
from compgs.numerics.compiling import working_seconds
from compgs.opening import component_bytes, open_scene, scene_file, scene_name
from compgs.outputs import check_output_folder, write_bytes, write_json
from compgs.paths import as_path
from compgs.progress import counted
from compgs.render import Renderable, render
from compgs.render.depth import depth
from compgs.scene import as_scene
from compgs.scene.views import Scene, View

if TYPE_CHECKING:
    from compgs.devices import Device

SHEET_ROWS = 4  # views on the contact sheet


@counted("evaluating views")
def evaluate(
    file: str | Path,
    scene: Scene | str | Path,
    *,
    output: str | Path | None = None,
    overwrite: bool = False,
    lpips: bool | str | Path = False,
    flip: bool = False,
    errors: bool = False,
    align: bool = False,
    device: "Device | None" = None,
    progress: Callable[[int, int], None] | Literal[False] | None = None,
    method: str | None = None,
    truth: str = "photograph",
) -> Results:
    """Open a file of any known format (`compgs.formats`) and compare its renderings with a scene's held-out views.

    Metrics are of 8-bit images (`compgs.metrics`). A scene that is given as a folder is read as `load_scene(folder)`
    does. With `output`, a folder, `results.json` and `per_view.json` (their schema: `compgs.evaluation.results`),
    `cameras.json` (of the held-out views), `test/renders`, `test/gt`, `test/masks` (of views that have one: white where
    a pixel counts) and `contact_sheet.png` are written there.
    `lpips`: a path is that of the weights, else they are those that are installed. `progress(done, total)` is called
    after each view; `method` is noted: which one wrote the file. Where the file tells
    that it was made from another scene, or from views or sizes of images other than these, `notes` of the results say
    so. `truth`: what the views' images are, as the contact sheet calls them.

    Pixels that a view's mask leaves out do not count. PSNR and SSIM are measured twice: as they are, and with the
    colors of each rendering fitted to its photograph, as cameras expose and balance each photograph by themselves
    (`compgs.evaluation.exposure`). With `align`, for captures whose poses are not exact, also from where the model
    looks most like each photograph (`compgs.evaluation.alignment`). With `errors`, the results say where the error is
    (`compgs.evaluation.error_account`); `errors.json` and `errors.png` are then written, too.

    Raises BitstreamError, SplatFileError, OutputError, SceneError if the scene holds no view out or a mask leaves
    nothing, and MissingDependency where FLIP is asked for and cannot be measured.
    """
    path, scene = scene_file(as_path(file, "file")), as_scene(scene)
    if output is not None:
        check_output_folder(as_path(output, "output", "folder"), overwrite=overwrite)
    if flip:
        metrics.check_flip()
    if not scene.test_views:
        raise SceneError(
            f"{scene.name}: no view is held out, so there is nothing to evaluate on; load with hold-out"
        )
    check_held_out(scene)
    angles = degrees_to_training(scene)
    chosen = chosen_device(device)
    model, first_seconds = timed_decode(path, chosen, scene.background)
    model, decode_seconds = timed_decode(path, chosen, scene.background)

    timed_render(
        model, scene.test_views[0].camera
    )  # kernels are loaded and caches filled: not what a view costs
    network, lpips_note = lpips_or_why_not(lpips, chosen)
    sums = ErrorSums() if errors else None
    rows: list[ViewResult] = []
    images: list[np.ndarray] = []
    for i, view in enumerate(scene.test_views):
        image, seconds = timed_render(model, view.camera)
        seen, photograph, mask = compared(image, view)
        fitted = with_fitted_colors(seen, photograph, mask)
        aligned = timed_render(model, aligned_camera(model, view))[0] if align else None
        distances: metrics.LpipsDistances | None = None
        if network is not None and lpips_note is None:
            try:
                distances = metrics.lpips(seen, photograph, network, mask)
            except metrics.Unavailable as reason:
                lpips_note = f"unavailable: {reason}"
        rows.append(
            ViewResult(
                name=view.name,
                file=f"{i:05d}.png",
                psnr=metrics.psnr(seen, photograph, mask),
                ssim=metrics.ssim(seen, photograph, mask),
                psnr_colors_fitted=metrics.psnr(fitted, photograph, mask),
                ssim_colors_fitted=metrics.ssim(fitted, photograph, mask),
                psnr_poses_aligned=None if aligned is None else metrics.psnr(aligned, photograph, mask),
                ssim_poses_aligned=None if aligned is None else metrics.ssim(aligned, photograph, mask),
                lpips=None if distances is None else distances.lpips,
                lpips_3dgs=None if distances is None else distances.lpips_3dgs,
                render_seconds=seconds,
                flip=metrics.flip(seen, photograph, mask) if flip else None,
                degrees_to_training=angles[i],
            )
        )
        if sums is not None:
            distance = depth(model, view.camera)
            sums.add(view.name, seen, photograph, mask, distance)
        images.append(image)
        if progress:
            progress(i + 1, len(scene.test_views))

    components = component_bytes(path)
    results = Results(
        compgs=__version__,
        scene=scene.name,
        file=scene_name(path),
        width=scene.test_views[0].camera.width,
        height=scene.test_views[0].camera.height,
        bytes=sum(components.values()),
        components=components,
        **{"anchors": None, "coupled_primitives": None, "splats": None, **model.counts},
        first_decode_seconds=first_seconds,
        decode_seconds=decode_seconds,
        device=device_name(chosen),
        threads=numba.get_num_threads(),
        sha256=hashlib.sha256(path.read_bytes()).hexdigest(),
        lpips_note=lpips_note,
        method=method,
        per_view=tuple(rows),
        notes=misfits(model.viewpoints, scene),
        errors=None if sums is None else sums.account(),
        split=scene.split,
    )
    if output is not None:
        write_evaluation(Path(output), results, scene.test_views, images, truth)
    return results


def lpips_or_why_not(
    wanted: bool | str | Path, device: str
) -> tuple[metrics.LpipsNetwork | None, str | None]:
    """The network, or why there is none."""
    if wanted is False:
        return None, "not asked for"
    try:
        return metrics.lpips_network(None if wanted is True else wanted, device), None
    except metrics.Unavailable as reason:
        return None, f"unavailable: {reason}"


def compared(rendering: np.ndarray, view: View) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """Rendering, photograph [H, W, 3] and mask [H, W] of what is measured.

    Raises SceneError if the mask leaves nothing.
    """
    check_view(view)
    return rendering, view.image, view.mask


def timed_render(model: Renderable, camera: Camera) -> tuple[np.ndarray, float]:
    """[H, W, 3] uint8, and the seconds it took until the image was there."""
    start = working_seconds()
    image = metrics.to_8bit(render(model, camera).image)
    return image, working_seconds() - start


def write_evaluation(
    folder: Path,
    results: Results,
    views: tuple[View, ...],
    images: list[np.ndarray],
    truth: str = "photograph",
) -> None:
    """The files of an evaluation; images of an earlier one with more views are removed."""
    written: set[Path] = set()
    renders, photographs, masks = (folder / "test" / name for name in ("renders", "gt", "masks"))

    def write(path: Path, image: np.ndarray) -> None:
        write_bytes(path, encode_png(image))
        written.add(path)

    for row, view, image in zip(results.per_view, views, images, strict=True):
        write(renders / row.file, image)
        write(photographs / row.file, view.image)
        if (mask := view.mask) is not None:
            write(masks / row.file, mask.astype(np.uint8) * np.uint8(255))
    for place in (renders, photographs, masks):
        for old in place.glob("[0-9][0-9][0-9][0-9][0-9].png"):
            if old not in written:
                old.unlink(missing_ok=True)
    chosen = np.unique(np.linspace(0, len(views) - 1, min(SHEET_ROWS, len(views))).round().astype(int))
    sheet = contact_sheet(
        [
            (
                striped(views[i].image, views[i].mask),
                striped(images[i], views[i].mask),
                views[i].name,
                results.per_view[i].psnr,
            )
            for i in chosen
        ],
        f"{results.scene}: {results.bytes / 1000:.1f} kB, {results.psnr:.2f} dB, {len(views)} held-out views",
        truth,
    )
    write_bytes(folder / "contact_sheet.png", encode_png(sheet))
    write_json(folder / "cameras.json", [camera_entry(view.camera, view.name) for view in views])
    write_json(folder / "per_view.json", results.per_view_list())
    if results.errors is not None:
        title = f"{results.scene}: where the error is, {results.psnr:.2f} dB, {len(views)} held-out views"
        write_bytes(folder / "errors.png", encode_png(error_sheet(results.errors, title)))
        write_json(folder / "errors.json", results.errors.to_dict())
    write_json(folder / "results.json", results.to_dict())


def encode_png(image: np.ndarray) -> bytes:
    """Encode a [H, W, 3] or [H, W] uint8 image."""
    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, format="PNG")
    return buffer.getvalue()


def timed_decode(path: Path, device: str, background: tuple[float, float, float]) -> tuple[Renderable, float]:
    """The model, and the seconds from file to model."""
    start = working_seconds()
    model = open_scene(path, device, background)
    return model, working_seconds() - start
