"""A scene for other programs: baked to plain splats where it is a neural one, written, read again and compared.

    file ──open──► model ──bake, refine──► splats ──encode──► bytes ──read──► splats'
                     └───────────── rendered from its own cameras ──────────────┘  PSNR

What is measured is what the new file holds, so that the loss of quantization is in it.
"""

import functools
import importlib
import itertools
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from compgs import metrics
from compgs.cameras import Camera
from compgs.devices import chosen_device
from compgs.errors import ConfigError, MissingDependency, NotACompGSFile, OutputError, SplatFileError
from compgs.evaluation.camera_path import between, surround
from compgs.evaluation.importance import splat_importance
from compgs.formats import WRITERS, SplatArrays, levels, sog_streamed, sog_streamed_writer, spz, told
from compgs.formats.baking import Baked, bake
from compgs.formats.refining import refine as refine_splats
from compgs.formats.tiled import SUFFIX as TILES
from compgs.formats.tiled_division import divide_file
from compgs.formats.tiled_ground import parse_grid
from compgs.formats.tiled_scene import TiledScene
from compgs.formats.writing import KEEP_WORLD_OFFSET
from compgs.model.degrees import MAX_DEGREE
from compgs.model.hybrid_model import HybridModel
from compgs.model.splats import SplatModel
from compgs.notes import note
from compgs.opening import format_of, open_scene, scene_file
from compgs.outputs import check_output_file, check_output_folder, write_bytes
from compgs.paths import as_path
from compgs.progress import counted
from compgs.render import RasterSettings, Renderable, render, settings_of
from compgs.render.render_model import Trained
from compgs.render.settings import DEFAULT_SETTINGS, as_angle

if TYPE_CHECKING:
    from compgs.devices import Device

HTML = "html"
FITTED_CAMERAS = 96  # of baking; fewer than the coefficients leave colors between them to chance
COMPARED_CAMERAS = 12  # between the file's own, beside those: baking saw none of them
LONGEST_SIDE = 800  # pixels, of cameras that baking looks through
VIEWING_SIDE = 1280  # pixels, the longer side of pictures as people look at them
VIEWED_CAMERAS = 6  # that are compared at this size
SOFTER = 0.5  # of what other programs dilate splats by; who has less is sharper to the eye
LEAST_DEGREE = 1  # of harmonics, before splats are left out for a file to be small enough
MOST_STEPS = 100_000  # of refining
MOST_COMPARED = 2_000_000  # splats of a scene of levels that is read again as a whole
BUDGET_MARGIN = 0.995  # of the size aimed at: sizes are not quite proportional to the number of splats


@dataclass(frozen=True)
class Exported:
    """What was written, and how far its pictures are from those of the scene it was made from."""

    bytes: int
    splats: int | None  # None: the page, or the folder of tiles, holds the scene itself
    degree: int | None  # of their harmonics
    dropped: int  # splats that were left out for the file to be small enough
    psnr: tuple[float, ...]  # dB, 8-bit images, of each camera; infinite where nothing changed
    origin: tuple[float, float, float]  # world units: where positions in the file count from
    viewing_psnr: tuple[float, ...] = ()  # dB, at VIEWING_SIDE, where the photographs are smaller than that
    softer: bool = False  # whether other programs draw the splats softer than the scene is
    # Steps in which splats that were made anew were fitted to the scene's pictures; None: none were made anew.
    refined: int | None = None
    tiles: int = 0  # of a folder of tiles

    @property
    def mean(self) -> float:
        """dB, of the cameras, as `metrics.mean_psnr` has it."""
        return metrics.mean_psnr(self.psnr)

    @property
    def viewing_mean(self) -> float:
        """dB, of pictures as people look at them: of VIEWING_SIDE, or of the photographs' size where that is larger."""
        return metrics.mean_psnr(self.viewing_psnr or self.psnr)

    @property
    def worst(self) -> float:
        """dB, of the camera from which it differs most."""
        return min(self.psnr)


@counted("baking and comparing")
def export(
    source: "str | Path | Renderable | Trained",
    path: str | Path,
    *,
    degree: int | None = None,
    refine: int = 100,
    max_splats: int | None = None,
    max_bytes: int | None = None,
    spz_version: int = 3,
    level: int | None = None,
    grid: str | None = None,
    overwrite: bool = False,
    device: "Device | None" = None,
    progress: Callable[[int, int], None] | Literal[False] | None = None,
) -> Exported:
    """Write a scene, or the one in a file, as `.ply`, `.spz`, `.sog` or `.glb`, or as a web page (`.html`), by what the
    path ends in; as `lod-meta.json`, a streamed .sog of several levels of detail, with its parts in folders beside it;
    as a folder `.tiles`, of which viewers fetch what they look at: it has the primitives of a .cgs file as they are.

    Of a .cgs file opacity and color are baked to harmonics of `degree` over the cameras that the file holds and more
    between them. Of files of splats, harmonics above `degree` are left out. With `max_splats` or `max_bytes` those
    splats stay that contribute most to the pictures. Without a `degree` it is 3, or, where `max_bytes` are too few for
    that, the highest with which all splats fit, 1 at least. What was changed is then fitted, in `refine` steps, to the
    scene's own renderings. Files of splats that nothing is asked of keep every number.

    `.spz` files are of version 3, or of 4, which fewer programs read and which needs the package zstandard.
    `level` is that of a streamed .sog (`lod-meta.json`), 0 the finest. `grid`: columns and rows of tiles ("4x2").
    `progress(done, total)` counts cameras and steps.

    Raises ConfigError, BitstreamError, SplatFileError, OutputError, MissingDependency.
    """
    path = as_path(path, "path")
    limits = Limits(degree, max_splats, max_bytes)
    limits.check(refine)
    if spz_version not in spz.WRITTEN_VERSIONS:
        raise ConfigError(f"spz_version = {spz_version}: expected one of {spz.WRITTEN_VERSIONS}")
    kind = path.suffix.lower().removeprefix(".")
    is_streamed, is_tiled = path.name == sog_streamed.NAME, path.suffix == TILES
    if kind not in (*WRITERS, HTML) and not is_streamed and not is_tiled:
        kinds = ", ".join(f".{name}" for name in (*WRITERS, HTML))
        raise OutputError(f"{path}: expected a name that ends in {kinds} or {TILES}, or {sog_streamed.NAME}")
    if is_tiled:
        limits.check_none(path)
        check_output_folder(path, overwrite=overwrite)
        return _export_tiles(as_path(source, "source"), path, grid or "auto")
    if grid is not None:
        raise ConfigError(
            f"grid = {grid}: only folders of tiles have one; give it with a name that ends in {TILES}"
        )
    check_output_file(path, overwrite=overwrite)
    if kind == HTML:
        limits.check_none(path)
        return _export_page(as_path(source, "source"), path)
    if is_streamed:
        limits.check_whole(path)
        most = MAX_DEGREE if degree is None else degree
        return _export_levels(
            as_path(source, "source"), path, most, refine, chosen_device(device), progress or None
        )
    write = functools.partial(spz.encoded, version=spz_version) if kind == "spz" else WRITERS[kind]
    chosen = chosen_device(device)
    model = _opened(source, chosen, level)
    if isinstance(model, TiledScene):
        tile = scene_file(as_path(source, "source")).parent / model.manifest.tiles[0].file
        raise SplatFileError(
            f"{source}: tiles are exported one by one, as {tile}: together they may not fit in memory"
        )
    if not isinstance(model, HybridModel | SplatModel):
        raise SplatFileError(
            f"{source!s:.200}: its splats are made anew for each camera, by networks that no other format holds; it "
            "can be rendered, compared and evaluated as it is"
        )
    cameras = own_cameras(model)
    fitted = _fitted(cameras)
    compared = (*cameras, *between(cameras, COMPARED_CAMERAS, seed=1))
    viewed = viewing_cameras(compared)
    changed = limits.change(model)
    steps = len(compared) + len(viewed) + (len(fitted) + refine if changed else 0)
    settings = as_others_draw(model, cameras)
    count = _counter(steps, progress or None)

    origin = (0.0, 0.0, 0.0) if kind in KEEP_WORLD_OFFSET else model.world_offset

    # Splats that are within the limits are asked for their size more than once, and then written: .sog takes seconds.
    @functools.lru_cache(maxsize=1)
    def written(splats: Baked) -> bytes:
        return write(_arrays(splats, model, kind))

    if changed:
        baked, dropped = _limited(model, fitted, limits, refine, lambda b: len(written(b)), count, settings)
    else:
        baked, dropped = _splats_of(model, (), MAX_DEGREE, count), 0
    data = written(baked)
    if text := told(baked.splats, kind):
        note(path, text)
    again = _read_back(data, kind, model, chosen)
    psnr = tuple(_compared(model, again, compared, count))
    viewing_psnr = tuple(_compared(model, again, viewed, count))
    write_bytes(path, data)
    # Others add the same number of pixels to pictures of every size.
    sharp = settings_of(model).dilation_of(cameras[0]) < SOFTER * DEFAULT_SETTINGS.dilation
    return Exported(
        len(data),
        again.counts["splats"],
        baked.splats.degree,
        dropped,
        psnr,
        origin,
        viewing_psnr,
        sharp,
        refine if changed else None,
    )


@dataclass(frozen=True)
class Limits:
    """What the splats may cost."""

    degree: int | None  # of the harmonics; None: what the bytes allow
    most_splats: int | None
    most_bytes: int | None  # of the file

    def check(self, refine: int) -> None:
        """Raises ConfigError for what cannot be."""
        for name, value, low, high in (
            ("degree", self.degree, 0, MAX_DEGREE),
            ("refine", refine, 0, MOST_STEPS),
            ("max_splats", self.most_splats, 1, None),
            ("max_bytes", self.most_bytes, 1, None),
        ):
            if value is not None and (value < low or (high is not None and value > high)):
                raise ConfigError(f"{name} = {value}: expected {low} to {high or 'any number'}")

    def check_none(self, path: Path) -> None:
        """Raises ConfigError if there is any, for a file that holds the scene as it is."""
        for name, value in (
            ("degree", self.degree),
            ("max_splats", self.most_splats),
            ("max_bytes", self.most_bytes),
        ):
            if value is not None:
                raise ConfigError(
                    f"{name} = {value}: {path} will hold the .cgs file as it is, no splats; leave it out, or make the "
                    "file smaller first (compgs encode --drop)"
                )

    def check_whole(self, path: Path) -> None:
        """Raises ConfigError if splats should be left out, of a scene of levels."""
        for name, value in (("max_splats", self.most_splats), ("max_bytes", self.most_bytes)):
            if value is not None:
                raise ConfigError(
                    f"{name} = {value}: {path} holds the scene at every level of detail, viewers choose; "
                    "leave it out"
                )

    def change(self, model: Renderable) -> bool:
        """Whether a scene's splats cannot stay as they are."""
        fewer = self.most_splats is not None or self.most_bytes is not None
        if fewer or not isinstance(model, SplatModel):
            return True
        return self.degree is not None and self.degree < model.splats.degree

    def by_number(self, baked: Baked) -> Baked:
        """The most important splats, as many as may be."""
        return baked if self.most_splats is None else baked.most_important(self.most_splats)

    def by_bytes(self, baked: Baked, size: Callable[[Baked], int]) -> Baked:
        """The same, as many as fit; `size` is that of a file. Raises ConfigError if the bytes are too few for any."""
        if self.most_bytes is None:
            return baked
        least = None  # of a file with one splat
        while (found := size(baked)) > self.most_bytes:
            least = least or size(baked.most_important(1))
            if least > self.most_bytes:
                raise ConfigError(
                    f"max_bytes = {self.most_bytes}: too few for any splat, expected {least} or more"
                )
            # As if all others were of one size.
            share = BUDGET_MARGIN * (self.most_bytes - least) / (found - least)
            baked = baked.most_important(1 + int((len(baked.importance) - 1) * share))
        return baked

    def affordable_degree(self, baked: Baked, size: Callable[[Baked], int]) -> int:
        """Choose the degree of the harmonics: the one asked for, else the highest with which all splats fit,
        LEAST_DEGREE at least.

        All splats of degree 1 are 15 dB nearer to a scene than half of them of degree 3, in a file of one size.
        """
        highest = baked.splats.degree
        if self.degree is not None or self.most_bytes is None:
            return highest
        for degree in range(highest, LEAST_DEGREE, -1):
            if size(_cut(baked, degree)) <= self.most_bytes:
                return degree
        return min(highest, LEAST_DEGREE)


def _limited(
    model: Renderable,
    cameras: Sequence[Camera],
    limits: Limits,
    refine: int,  # steps
    size: Callable[[Baked], int],  # bytes of a file
    count: Callable[[], None],
    settings: RasterSettings,  # with which the splats are drawn
) -> tuple[Baked, int]:
    """The splats of a model within limits, and how many were left out."""
    baked = _splats_of(model, cameras, MAX_DEGREE if limits.degree is None else limits.degree, count)
    total = len(baked.importance)
    baked = limits.by_number(baked)
    degree = limits.affordable_degree(baked, size)
    if degree < baked.splats.degree:
        # Anew: harmonics that are fitted alone are not those that are fitted with higher ones.
        baked = limits.by_number(_splats_of(model, cameras, degree, lambda: None))
    baked = refine_splats(limits.by_bytes(baked, size), model, cameras, refine, count, settings)
    # Fitted numbers may compress a little worse.
    baked = limits.by_bytes(baked, size)
    return baked, total - len(baked.importance)


def _cut(baked: Baked, degree: int) -> Baked:
    """Return the splats without harmonics above a degree; the same where there are none."""
    if degree >= baked.splats.degree:
        return baked
    return replace(baked, splats=baked.splats.of_degree(degree))


def own_cameras(model: Renderable) -> list[Camera]:
    """Return cameras of the world: those that the scene was captured with, where its file names more than one; else all
    around.
    """
    if isinstance(model, HybridModel | TiledScene) and len(model.viewpoints) > 1:
        return list(model.viewpoints)
    around = surround(model.bounds[0])
    return [camera.moved(tuple(-x for x in model.world_offset)) for _, camera in around]


def as_others_draw(model: Renderable, cameras: Sequence[Camera]) -> RasterSettings:
    """How other programs draw splats in pictures of VIEWING_SIDE; so that they can be fitted in smaller ones.

    They add the same number of pixels in every size. Splats that are fitted as they are drawn in small photographs make
    up for it, and are wrong in all larger pictures: 38 dB in place of 53.
    """
    if model.angular_dilation is None:
        return RasterSettings(background=model.background, antialiased=model.antialiased)
    angle = as_angle(DEFAULT_SETTINGS.dilation, [at_least(VIEWING_SIDE, camera) for camera in cameras])
    return RasterSettings(background=model.background, angular_dilation=angle)


def viewing_cameras(cameras: Sequence[Camera]) -> tuple[Camera, ...]:
    """Some of the cameras in the size in which people look at pictures; none, where theirs is as large."""
    longest = max(max(camera.width, camera.height) for camera in cameras)
    if longest >= VIEWING_SIDE:
        return ()
    chosen = cameras[:: max(1, -(-len(cameras) // VIEWED_CAMERAS))]
    return tuple(at_least(VIEWING_SIDE, camera) for camera in chosen)


def at_least(side: int, camera: Camera) -> Camera:
    """The same view, its longer side of so many pixels at least."""
    grow = max(1.0, side / max(camera.width, camera.height))
    return camera.resized(round(camera.width * grow), round(camera.height * grow))


def smaller(camera: Camera) -> Camera:
    """The same view in at most LONGEST_SIDE pixels."""
    shrink = min(1.0, LONGEST_SIDE / max(camera.width, camera.height))
    return camera.resized(max(1, round(camera.width * shrink)), max(1, round(camera.height * shrink)))


def _splats_of(
    model: Renderable,
    cameras: Sequence[Camera],  # to look from, where the splats are to be chosen or made
    degree: int,
    count: Callable[[], None],
) -> Baked:
    if isinstance(model, HybridModel):
        return bake(model, cameras, degree, count)
    assert isinstance(model, SplatModel), type(model)
    return _cut(Baked(model.splats, splat_importance(model, cameras, count)), degree)


def _arrays(baked: Baked, model: Renderable, kind: str) -> SplatArrays:
    """Return the arrays, with the place of the model's frame where the format has room for it."""
    origin = model.world_offset if kind in KEEP_WORLD_OFFSET else (0.0, 0.0, 0.0)
    return replace(baked.splats, world_offset=origin)


def _read_back(data: bytes, kind: str, model: Renderable, device: str) -> Renderable:
    """What the bytes are to a reader, in the place of the model that they are compared with."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder, f"written.{kind}")
        file.write_bytes(data)
        again = open_scene(file, device, model.background)
    assert isinstance(again, SplatModel)
    if kind in KEEP_WORLD_OFFSET:
        return again
    return again.at(model.world_offset)


def _compared(
    one: Renderable, other: Renderable, cameras: Sequence[Camera], count: Callable[[], None]
) -> Iterator[float]:
    """dB of 8-bit pictures of two scenes, camera by camera."""
    for camera in cameras:
        yield metrics.psnr(*(metrics.to_8bit(render(model, camera).image) for model in (one, other)))
        count()


def _counter(total: int, progress: Callable[[int, int], None] | None) -> Callable[[], None]:
    """Return a function to be called once for everything that is counted."""
    done = itertools.count(1)

    def count() -> None:
        if progress:
            progress(next(done), total)

    return count


def _opened(source: "str | Path | Renderable | Trained", device: str, level: int | None) -> Renderable:
    """A scene, of a file, of a training, or as it is. Raises ConfigError for what is none."""
    if isinstance(source, Trained):
        return source.as_hybrid_model()
    if isinstance(source, Renderable):
        return source
    return open_scene(as_path(source, "source"), device, level=level)


def _export_levels(
    source: Path,
    path: Path,
    degree: int,
    refine: int,
    device: str,
    progress: Callable[[int, int], None] | None,
) -> Exported:
    """A lod-meta.json and its parts. Raises as `export` does."""
    source = scene_file(source)
    found = format_of(source)
    found.check(source)
    baked = 0

    def bake_level(model: HybridModel, whole: HybridModel) -> SplatArrays:
        nonlocal baked
        cameras = own_cameras(whole)
        fitted = _fitted(cameras)
        level = bake(model, fitted, degree)
        splats = refine_splats(level, whole, fitted, refine, settings=as_others_draw(whole, cameras)).splats
        baked += 1
        if progress:
            progress(baked, total)
        return splats

    total = levels.levels_in(source)
    model = open_scene(source, device)
    if found.name == "cgs":
        levels.export_file(source, path, device, bake_level)
    elif found.name == "tiles":
        levels.export_tiles(source, path, device, bake_level)
    elif isinstance(model, SplatModel):
        sog_streamed_writer.write_levels(path, 1, iter([[model.splats.of_degree(degree)]]))
    else:
        raise SplatFileError(
            f"{source}: its splats are made anew for each camera; no level of them can be written"
        )
    files = [path, *(file for part in sog_streamed.parts(path) for file in part.parent.iterdir())]
    splats = sog_streamed.read_meta(path).counts[0]
    psnr: tuple[float, ...] = ()
    if splats <= MOST_COMPARED:
        again = SplatModel(sog_streamed.read(path), model.background).at(model.world_offset)
        psnr = tuple(
            _compared(model, again, between(own_cameras(model), COMPARED_CAMERAS, seed=1), lambda: None)
        )
    return Exported(sum(file.stat().st_size for file in files), splats, degree, 0, psnr, model.world_offset)


def _fitted(cameras: Sequence[Camera]) -> list[Camera]:
    """Cameras to bake through: a scene's own, and more between them."""
    more = between(cameras, max(0, FITTED_CAMERAS - len(cameras)))
    return [smaller(camera) for camera in (*cameras, *more)]


def _export_tiles(source: Path, path: Path, grid: str) -> Exported:
    """A folder of tiles with the primitives of a .cgs file. Raises BitstreamError, ConfigError, OutputError."""
    found = format_of(source)
    if found.name != "cgs":
        raise NotACompGSFile(f"{source}: tiles are made of a .cgs file, found a .{found.name}")
    count = divide_file(source.read_bytes(), source, path, parse_grid(grid))
    size = sum(file.stat().st_size for file in path.iterdir())
    return Exported(size, None, None, 0, (), (0.0, 0.0, 0.0), tiles=count)


def _export_page(source: Path, path: Path) -> Exported:
    """A web page that holds the file itself, and the decoder. Raises BitstreamError, MissingDependency."""
    found = format_of(source)
    if found.name != "cgs":
        raise NotACompGSFile(f"{source}: a page shows a .cgs file, found a .{found.name}")
    found.check(source)
    try:
        viewer = importlib.import_module("compgs.viewer")
    except ImportError as error:
        raise MissingDependency(
            f"{path}: this build of compgs has no viewer for web pages ({error})"
        ) from error
    page = viewer.html_page(source.read_bytes(), source.stem)
    data = page.encode("utf-8") if isinstance(page, str) else page
    write_bytes(path, data)
    return Exported(len(data), None, None, 0, (), (0.0, 0.0, 0.0))
