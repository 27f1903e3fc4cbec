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
from statistics import fmean

import torch

from compgs import metrics
from compgs.cameras import Camera
from compgs.errors import ConfigError, MissingDependency, NotACompGSFile, OutputError
from compgs.evaluation.camera_path import between, surround
from compgs.evaluation.importance import splat_importance
from compgs.formats import WRITERS, SplatArrays, arrays_of, format_of, open_scene, spz
from compgs.formats.baking import Baked, bake
from compgs.formats.refining import refine as refine_splats
from compgs.formats.registry import KEEP_WORLD_OFFSET
from compgs.model.hybrid_model import HybridModel
from compgs.model.spherical_harmonics import MAX_DEGREE, coefficients
from compgs.model.splats import SplatModel
from compgs.outputs import check_output_file, write_bytes
from compgs.render import Renderable, render

HTML = "html"
SAME_PICTURE = 100.0  # dB, about what one level in one pixel of one channel comes to
FITTED_CAMERAS = 96  # of baking; fewer than the coefficients leave colors between them to chance
COMPARED_CAMERAS = 12  # between the file's own, beside those: baking saw none of them
LONGEST_SIDE = 800  # pixels, of cameras that baking looks through
BUDGET_ROUNDS = 12  # of dropping splats until a file is small enough
MOST_STEPS = 100_000  # of refining
BUDGET_MARGIN = 0.995  # of the size aimed at: sizes are not quite proportional to the number of splats


@dataclass(frozen=True)
class Exported:
    """What was written, and how far its pictures are from those of the scene it was made from."""

    bytes: int
    splats: int | None  # None: the page holds the scene itself
    dropped: int  # splats that were left out for the file to be small enough
    psnr: tuple[float, ...]  # dB, 8-bit images, of each camera; infinite where nothing changed
    origin: tuple[float, float, float]  # world units: where positions in the file count from

    @property
    def mean(self) -> float:
        """dB, of the cameras; equal pictures count as SAME_PICTURE, unless all are."""
        return self.worst if self.worst == float("inf") else fmean(min(p, SAME_PICTURE) for p in self.psnr)

    @property
    def worst(self) -> float:
        """dB, of the camera from which it differs most."""
        return min(self.psnr)


def export(
    source: str | Path,
    path: str | Path,
    *,
    degree: int = 3,
    refine: int = 100,
    max_splats: int | None = None,
    max_bytes: int | None = None,
    spz_version: int = 3,
    overwrite: bool = False,
    device: str | torch.device | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Exported:
    """Write a scene as `.ply`, `.spz`, `.sog` or `.glb`, or as a web page (`.html`), by what the path ends in.

    Of a .cgs file opacity and color are baked to harmonics of `degree` over the cameras that the file holds and more
    between them. Of files of splats, harmonics above `degree` are left out. With `max_splats` or `max_bytes` those
    splats stay that contribute most to the pictures. What was changed is then fitted, in `refine` steps, to the scene's
    own renderings.
    Files of splats that nothing is asked of keep every number. `.spz` files are of version 3, or of 4,
    which fewer programs read and which needs the package zstandard. `progress(done, total)` counts cameras and steps.

    Raises ConfigError, BitstreamError, SplatFileError, OutputError, MissingDependency.
    """
    source, path = Path(source), Path(path)
    limits = Limits(degree, max_splats, max_bytes)
    limits.check(refine)
    if spz_version not in spz.WRITTEN_VERSIONS:
        raise ConfigError(f"spz_version = {spz_version}: expected one of {spz.WRITTEN_VERSIONS}")
    kind = path.suffix.lower().removeprefix(".")
    if kind not in (*WRITERS, HTML):
        kinds = ", ".join(f".{name}" for name in (*WRITERS, HTML))
        raise OutputError(f"{path}: expected a name that ends in {kinds}")
    check_output_file(path, overwrite=overwrite)
    if kind == HTML:
        return _export_page(source, path)
    write = functools.partial(spz.encoded, version=spz_version) if kind == "spz" else WRITERS[kind]
    model = open_scene(source, device or ("cuda" if torch.cuda.is_available() else "cpu"))
    cameras = own_cameras(model)
    fitted = [smaller(c) for c in (*cameras, *between(cameras, max(0, FITTED_CAMERAS - len(cameras))))]
    compared = (*cameras, *between(cameras, COMPARED_CAMERAS, seed=1))
    changed = limits.change(model)
    steps = len(compared) + (len(fitted) + refine if changed else 0)
    count = _counter(steps, progress)

    origin = (0.0, 0.0, 0.0) if kind in KEEP_WORLD_OFFSET else model.world_offset
    baked = _splats_of(model, fitted if changed else [], degree, count)
    before = len(baked.importance)
    baked = limits.keep(baked, lambda b: write(_arrays(b, model, kind)))
    if changed:
        baked = refine_splats(baked, model, fitted, refine, count)
        # Fitted numbers may compress a little worse.
        baked = limits.keep(baked, lambda b: write(_arrays(b, model, kind)))
    data = write(_arrays(baked, model, kind))
    psnr = tuple(_compared(model, _read_back(data, kind, model), compared, count))
    write_bytes(path, data)
    kept = len(baked.importance)
    return Exported(len(data), kept, before - kept, psnr, origin)


@dataclass(frozen=True)
class Limits:
    """What the splats may cost."""

    degree: int  # of the harmonics
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

    def change(self, model: Renderable) -> bool:
        """Whether a scene's splats cannot stay as they are."""
        fewer = self.most_splats is not None or self.most_bytes is not None
        return fewer or not isinstance(model, SplatModel) or self.degree < model.splats.degree

    def keep(self, baked: Baked, write: Callable[[Baked], bytes]) -> Baked:
        """The most important splats, as many as may be. Raises ConfigError if the bytes are too few for any."""
        if self.most_splats is not None:
            baked = baked.most_important(self.most_splats)
        if self.most_bytes is None:
            return baked
        for _ in range(BUDGET_ROUNDS):
            size = len(write(baked))
            if size <= self.most_bytes:
                return baked
            fewer = int(len(baked.importance) * BUDGET_MARGIN * self.most_bytes / size)
            if fewer < 1:
                break
            baked = baked.most_important(fewer)
        raise ConfigError(f"max_bytes = {self.most_bytes}: too few for any splat, expected {size} or more")


def own_cameras(model: Renderable) -> list[Camera]:
    """Of the world: those that the scene was captured with, where its file names more than one; else all around."""
    if isinstance(model, HybridModel) and len(model.viewpoints) > 1:
        return list(model.viewpoints)
    around = surround(model.bounds[0].cpu().numpy())
    return [camera.moved(tuple(-x for x in model.world_offset)) for _, camera in around]


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
    importance = splat_importance(model, cameras, count)
    rest = model.splats.rest[:, : coefficients(degree) - 1]
    return Baked(replace(model.splats, rest=rest), importance)


def _arrays(baked: Baked, model: Renderable, kind: str) -> SplatArrays:
    """With the place of the model's frame where the format has room for it."""
    return arrays_of(baked.splats, model.world_offset if kind in KEEP_WORLD_OFFSET else (0.0, 0.0, 0.0))


def _read_back(data: bytes, kind: str, model: Renderable) -> Renderable:
    """What the bytes are to a reader, in the place of the model that they are compared with."""
    device = model.bounds[0].device
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder, f"written.{kind}")
        file.write_bytes(data)
        again = open_scene(file, device, model.background)
    assert isinstance(again, SplatModel)
    return again if kind in KEEP_WORLD_OFFSET else replace(again, world_offset=model.world_offset)


def _compared(
    one: Renderable, other: Renderable, cameras: Sequence[Camera], count: Callable[[], None]
) -> Iterator[float]:
    """dB of 8-bit pictures of two scenes, camera by camera."""
    for camera in cameras:
        yield metrics.psnr(*(metrics.to_8bit(render(model, camera).image) for model in (one, other)))
        count()


def _counter(total: int, progress: Callable[[int, int], None] | None) -> Callable[[], None]:
    """To be called once for everything that is counted."""
    done = itertools.count(1)

    def count() -> None:
        if progress:
            progress(next(done), total)

    return count


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
    return Exported(len(data), None, 0, (), (0.0, 0.0, 0.0))
