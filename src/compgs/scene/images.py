"""Photographs from disk: checked against their cameras, composited, undistorted, resized, kept as uint8."""

import os
import warnings
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from threading import Lock
from typing import TypeVar

import numpy as np
from PIL import Image, ImageOps, UnidentifiedImageError

from compgs.cameras import Camera
from compgs.errors import ConfigError, SceneError, UnreadableImage, UnsupportedCamera
from compgs.scene.capture import PosedImage
from compgs.scene.headers import stops_in
from compgs.scene.image_cache import ImageCache
from compgs.scene.masks import mask_of, resized_mask, undistorted_mask
from compgs.scene.pixels import REMEDY, UnusableSamples, has_alpha, is_wide, rgb
from compgs.scene.undistort import sample_bicubic, undistorted_camera, undistortion_map
from compgs.scene.views import View

# What photographs are stored as. Pillow would open more by their content, whatever they are called: PostScript, which
# is a program, and others of which a decoder is an unneeded risk. (MPO: JPEG of cameras that store several images.)
FORMATS = ("JPEG", "MPO", "PNG", "WEBP", "TIFF", "BMP", "GIF", "PPM", "TGA", "JPEG2000", "AVIF")

# Of HEIF files whose pictures are HEVC; Pillow has no decoder for them.
HEIC_BRANDS = (b"heic", b"heix", b"heim", b"heis", b"hevc", b"hevx", b"mif1", b"msf1")

# What Pillow raises for damaged files, besides OSError
DAMAGED = (OSError, ValueError, SyntaxError, EOFError, IndexError, MemoryError, Image.DecompressionBombError)

MIN_SIDE = 4  # pixels: what downscaling must leave of an image

# The tag of how a picture is to be turned, and its values that swap width and height.
ORIENTATION, SIDEWAYS = 0x0112, (5, 6, 7, 8)

_opening = Lock()  # filters of warnings belong to the process

Progress = Callable[[int, int], None]  # done, total
_Result = TypeVar("_Result")


def image_size(file: Path) -> tuple[int, int]:
    """(width, height) in pixels, from the header alone. Raises UnreadableImage."""
    return stored_size(file)[0]


def stored_size(file: Path) -> tuple[tuple[int, int], bool]:
    """(width, height) in pixels, and whether the orientation tag swaps the two. Raises UnreadableImage."""
    try:
        with open_image(file) as image:
            return image.size, image.getexif().get(ORIENTATION) in SIDEWAYS
    except DAMAGED as error:
        raise UnreadableImage(_reason(file, error)) from error


def stops_of(file: Path) -> float | None:
    """Log2 of the light that the header says was let in (`headers`). Raises UnreadableImage."""
    try:
        with open_image(file) as image:
            return stops_in(image.getexif())
    except DAMAGED as error:
        raise UnreadableImage(_reason(file, error)) from error


@dataclass(frozen=True, eq=False)
class Photograph:
    """What a view shows."""

    image: np.ndarray  # [H, W, 3] uint8, display RGB
    mask: np.ndarray | None  # [H, W] bool, True where a pixel counts; None: all do

    @property
    def nbytes(self) -> int:
        return self.image.nbytes + (0 if self.mask is None else self.mask.nbytes)


def load_views(
    images: Sequence[PosedImage],
    downscale: float,
    background: tuple[float, float, float] | None,  # behind transparent pixels; None: these do not count
    progress: Progress | None = None,
    cache: ImageCache[Photograph] | None = None,
    *,
    at_once: bool = True,
) -> tuple[list[View], bool]:
    """The views at 1 / downscale of their images' size, in the given order, with their masks; whether all are decoded.

    Headers, sizes and cameras are checked. Images that all fit into the cache are decoded at once, and so checked; of a
    larger capture, or if not `at_once`, each is decoded when its view is looked at.
    """
    cache = cache or ImageCache()
    sizes = _checked_sizes(images)
    cameras = [posed.camera.resized(*size) for posed, size in zip(images, sizes, strict=True)]
    for posed, camera in zip(images, cameras, strict=True):
        width, height = downscaled_size((camera.width, camera.height), downscale)
        if downscale > 1 and min(width, height) < MIN_SIDE:
            raise ConfigError(
                f"downscale {downscale}: leaves {width}x{height} pixels of {posed.path}, which has "
                f"{camera.width}x{camera.height}; use a smaller factor"
            )
    maps = _Maps()

    def undistorted(index: int) -> tuple[Camera, np.ndarray | None]:
        """The camera of the undistorted image, and where its pixels are in the photograph."""
        posed, camera = images[index], cameras[index]
        if posed.distortion is None or posed.distortion.is_identity:
            return camera, None
        return maps.get(replace(posed, camera=camera))

    def read(index: int) -> Photograph:
        photograph = read_photograph(images[index], background)
        pixels, mask = photograph.image, photograph.mask
        camera, positions = undistorted(index)
        if positions is not None:
            pixels = sample_bicubic(pixels, positions)
            mask = None if mask is None else undistorted_mask(mask, positions)
        size = downscaled_size((camera.width, camera.height), downscale)
        if size != (camera.width, camera.height):
            pixels = np.asarray(Image.fromarray(pixels).resize(size, Image.Resampling.BOX))
            mask = None if mask is None else resized_mask(mask, size)
        return Photograph(np.ascontiguousarray(pixels), mask)

    def view(index: int) -> View:
        camera, _ = undistorted(index)
        width, height = downscaled_size((camera.width, camera.height), downscale)
        stored = _Stored(cache, index, read)
        header = partial(stops_of, images[index].path)
        return View(images[index].name, camera.resized(width, height), stored.image, stored.mask, header)

    views = _in_threads(view, len(images), None)
    fit = sum(3 * view.camera.width * view.camera.height for view in views) <= cache.most_bytes
    if at_once and fit:
        _in_threads(lambda index: views[index].image.shape, len(images), progress)
    return views, at_once and fit


@dataclass(frozen=True, eq=False)
class _Stored:
    """A photograph of a cache, read when it is wanted."""

    cache: ImageCache[Photograph]
    index: int
    read: Callable[[int], Photograph]

    def image(self) -> np.ndarray:
        return self.cache.get(self.index, lambda: self.read(self.index)).image

    def mask(self) -> np.ndarray | None:
        return self.cache.get(self.index, lambda: self.read(self.index)).mask


def downscaled_size(size: tuple[int, int], downscale: float) -> tuple[int, int]:
    """(width, height) of an image at 1 / downscale of its size, rounded to whole pixels."""
    return max(1, round(size[0] / downscale)), max(1, round(size[1] / downscale))


def read_photograph(posed: PosedImage, background: tuple[float, float, float] | None) -> Photograph:
    """The pixels of an image, and which of them count by its transparency and its mask. Raises UnreadableImage."""
    image, mask = read_image(posed.path, background, turned=posed.turned)
    if posed.mask is not None:
        size = image.shape[1], image.shape[0]
        own = resized_mask(_read_mask(posed.mask, posed.path, size), size)
        mask = own if mask is None else mask & own
    return Photograph(image, None if mask is None or mask.all() else mask)


def read_image(
    file: Path, background: tuple[float, float, float] | None, *, turned: bool = False
) -> tuple[np.ndarray, np.ndarray | None]:
    """[H, W, 3] uint8 RGB, and [H, W] bool, True where more than half opaque (`rgb`). Raises UnreadableImage.

    The orientation tag is ignored unless `turned`, as structure from motion ignores it: poses belong to the stored
    pixels.
    """
    try:
        with open_image(file) as image:
            wide = is_wide(image)
            image.load()
            return rgb(ImageOps.exif_transpose(image) if turned else image, background, wide=wide)
    except DAMAGED as error:
        raise UnreadableImage(_reason(file, error)) from error


def _read_mask(file: Path, photograph: Path, size: tuple[int, int]) -> np.ndarray:
    """[H, W] bool, of the file's own size, which must have the proportions of `size`. Raises UnreadableImage."""
    try:
        with open_image(file) as image:
            upright = ImageOps.exif_transpose(image)
            if _stretch(upright.size, size) < _stretch(image.size, size):
                image = upright  # as its photograph, whose camera is of the turned picture
            width, height = image.size
            if _stretch(image.size, size) > 1 / size[0] + 1 / size[1]:
                raise UnreadableImage(
                    f"{file}: the mask has {width}x{height} pixels, its photograph {photograph.name} "
                    f"{size[0]}x{size[1]}; make a mask of the photograph's proportions"
                )
            return mask_of(*_gray_and_alpha(image))
    except DAMAGED as error:
        raise UnreadableImage(_reason(file, error)) from error


def _stretch(size: tuple[int, int], other: tuple[int, int]) -> float:
    """How far two sizes are from the same proportions."""
    return abs(size[0] / other[0] - size[1] / other[1])


def _gray_and_alpha(image: Image.Image) -> tuple[np.ndarray, np.ndarray | None]:
    """[H, W] each, of any type; no alpha where the image has none."""
    if image.mode.startswith("I") or image.mode == "F":
        return np.asarray(image), None
    if not has_alpha(image):
        return np.asarray(image.convert("L")), None
    rgba = image.convert("RGBA")
    return np.asarray(rgba.convert("RGB").convert("L")), np.asarray(rgba)[..., 3]


def open_image(file: Path) -> Image.Image:
    """Opened, if of one of the FORMATS that this Pillow has; only the header is read. Raises what is in DAMAGED.

    Pillow refuses images of more than 179 megapixels. It warns of those of half as many, which are usual: not shown.
    """
    Image.init()
    formats = [name for name in FORMATS if name in Image.OPEN]
    with _opening, warnings.catch_warnings():
        warnings.simplefilter("ignore", Image.DecompressionBombWarning)
        return Image.open(file, formats=formats)


def _checked_sizes(images: Sequence[PosedImage]) -> list[tuple[int, int]]:
    """(width, height) of the files, as the cameras see them. Raises for missing or unreadable files and wrong sizes."""
    missing = [posed for posed in images if not posed.path.is_file()]
    if missing:
        raise UnreadableImage(
            f"{missing[0].path}: this view's image does not exist{_more(len(missing) - 1, 'missing')}; "
            f"put the images there, or name their folder with images=..."
        )
    found = _in_threads(lambda index: stored_size(images[index].path), len(images), None)
    sizes = [size[::-1] if posed.turned else size for posed, (size, _) in zip(images, found, strict=True)]
    wrong = [i for i, posed in enumerate(images) if not fits(sizes[i], posed.camera)]
    if wrong:
        posed, (width, height) = images[wrong[0]], sizes[wrong[0]]
        raise UnreadableImage(
            f"{posed.path}: the image has {width}x{height} pixels, but its camera was calibrated for "
            f"{posed.camera.width}x{posed.camera.height}{_more(len(wrong) - 1, 'of the wrong size')}; "
            f"use the images that the poses were computed from, or a uniformly smaller copy of them"
        )
    return sizes


def turned_as_cameras_are(images: Sequence[PosedImage]) -> tuple[PosedImage, ...]:
    """The images; those whose cameras fit them only as their orientation tag turns them, so turned.

    Structure from motion mostly ignores the tag, and cameras are of the images as stored; some programs heed it.
    """
    there = [index for index, posed in enumerate(images) if posed.path.is_file()]
    sizes = _in_threads(lambda i: stored_size(images[there[i]].path), len(there), None)
    turned = {i for i, found in zip(there, sizes, strict=True) if _only_turned(images[i].camera, *found)}
    return tuple(replace(posed, turned=True) if i in turned else posed for i, posed in enumerate(images))


def _only_turned(camera: Camera, size: tuple[int, int], sideways: bool) -> bool:
    return sideways and not fits(size, camera) and fits(size[::-1], camera)


def fits(size: tuple[int, int], camera: Camera) -> bool:
    """True if an image of that size is the camera's, scaled by one factor up to the rounding of each side."""
    across, down = size[0] / camera.width, size[1] / camera.height
    return abs(across - down) <= 1 / camera.width + 1 / camera.height


class _Maps:
    """Undistortion maps, made once per lens and size: the views of a capture mostly share one."""

    def __init__(self) -> None:
        self.lock = Lock()
        self.known: dict[tuple, tuple[Camera, np.ndarray]] = {}

    def get(self, posed: PosedImage) -> tuple[Camera, np.ndarray]:
        assert posed.distortion is not None
        camera = posed.camera
        key = (camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height, posed.distortion)
        with self.lock:
            if key not in self.known:
                try:
                    target = undistorted_camera(camera, posed.distortion)
                except UnsupportedCamera as error:
                    raise UnsupportedCamera(f"{posed.path}: {error}") from error
                self.known[key] = target, undistortion_map(camera, target, posed.distortion)
            target, positions = self.known[key]
        return replace(target, world_to_camera=camera.world_to_camera), positions


def _in_threads(work: Callable[[int], _Result], count: int, progress: Progress | None) -> list[_Result]:
    """[work(0), work(1), ...]. Of the images' errors the first is raised; it says how many more there are."""
    results: dict[int, _Result] = {}
    errors: dict[int, SceneError] = {}
    with ThreadPoolExecutor(max_workers=min(8, os.cpu_count() or 1)) as pool:
        futures = {pool.submit(work, index): index for index in range(count)}
        try:
            for done, future in enumerate(as_completed(futures), start=1):
                try:
                    results[futures[future]] = future.result()
                except SceneError as error:
                    errors[futures[future]] = error
                if progress is not None:
                    progress(done, count)
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
    if errors:
        first = errors[min(errors)]
        raise type(first)(f"{first}{_more(len(errors) - 1, 'affected')}") from first
    return [results[index] for index in range(count)]


def _more(count: int, what: str) -> str:
    return f" ({count} more {'is' if count == 1 else 'are'} {what})" if count else ""


def is_heic(file: Path) -> bool:
    """Whether a file is a photograph as iPhones store it, whatever it is called."""
    try:
        with file.open("rb") as content:
            head = content.read(12)
    except OSError:
        return False
    return head[4:8] == b"ftyp" and head[8:] in HEIC_BRANDS


def _reason(file: Path, error: BaseException) -> str:
    if is_heic(file):
        return (
            f"{file}: HEIC images are not read; convert all of them to JPEG, as with heif-convert, and name those "
            "files in the poses"
        )
    if isinstance(error, Image.DecompressionBombError):
        return f"{file}: the image is too large ({error}); give smaller copies of all images"
    if isinstance(error, UnusableSamples):
        return f"{file}: {error}"
    if isinstance(error, UnidentifiedImageError) and (kind := kind_of(file)):
        return f"{file}: {kind} is not read; {REMEDY}"
    reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
    return f"{file}: the image cannot be read ({reason}); restore it, or remove the view from the poses"


# How files begin that are whole, and not among the FORMATS or not of a kind of them that Pillow opens.
KINDS = {
    b"II*\0": "a TIFF of this kind (perhaps of floating-point or 32-bit samples)",
    b"MM\0*": "a TIFF of this kind (perhaps of floating-point or 32-bit samples)",
    b"\x76\x2f\x31\x01": "OpenEXR",
    b"#?RADIANCE": "Radiance HDR",
    b"#?RGBE": "Radiance HDR",
    b"PF\n": "a portable float map",
    b"Pf\n": "a portable float map",
    b"8BPS": "a Photoshop document",
    b"\xff\x0a": "JPEG XL",
    b"\0\0\0\x0cJXL ": "JPEG XL",
    b"FUJIFILM": "a raw photograph",
    b"<svg": "a drawing (SVG)",
    b"%PDF": "a PDF",
}


def kind_of(file: Path) -> str:
    """What a file is that cannot be opened although it is whole; empty where that is not known."""
    try:
        with file.open("rb") as content:
            head = content.read(12)
    except OSError:
        return ""
    return next((name for start, name in KINDS.items() if head.startswith(start)), "")
