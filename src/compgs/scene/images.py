"""Photographs from disk: checked against their cameras, composited, undistorted, resized, kept as uint8."""

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass, replace
from pathlib import Path
from threading import Lock
from typing import TypeVar

import numpy as np
from PIL import Image

from compgs.cameras import Camera
from compgs.errors import ConfigError, SceneError, UnreadableImage, UnsupportedCamera
from compgs.scene.capture import PosedImage
from compgs.scene.image_cache import ImageCache
from compgs.scene.masks import OPAQUE, mask_of_brightness, resized_mask, undistorted_mask
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

Progress = Callable[[int, int], None]  # done, total
_Result = TypeVar("_Result")


def image_size(file: Path) -> tuple[int, int]:
    """(width, height) in pixels, from the header alone. Raises UnreadableImage."""
    try:
        with open_image(file) as image:
            return image.size
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
    downscale: int,
    background: tuple[float, float, float] | None,  # behind transparent pixels; None: these do not count
    progress: Progress | None = None,
    cache: ImageCache[Photograph] | None = None,
    *,
    at_once: bool = True,
) -> list[View]:
    """The views at 1 / downscale of their images' size, in the given order, with their masks.

    Headers, sizes and cameras are checked. Images that all fit into the cache are decoded at once, and so checked; of a
    larger capture, or if not `at_once`, each is decoded when its view is looked at.
    """
    cache = cache or ImageCache()
    cameras = _checked_cameras(images)
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
        return View(images[index].name, camera.resized(width, height), stored.image, stored.mask)

    views = _in_threads(view, len(images), None)
    if at_once and sum(3 * view.camera.width * view.camera.height for view in views) <= cache.most_bytes:
        _in_threads(lambda index: views[index].image.shape, len(images), progress)
    return views


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


def downscaled_size(size: tuple[int, int], downscale: int) -> tuple[int, int]:
    """(width, height) of an image at 1 / downscale of its size, rounded to whole pixels."""
    return max(1, round(size[0] / downscale)), max(1, round(size[1] / downscale))


def read_photograph(posed: PosedImage, background: tuple[float, float, float] | None) -> Photograph:
    """The pixels of an image, and which of them count by its transparency and its mask. Raises UnreadableImage."""
    image, mask = read_image(posed.path, background)
    if posed.mask is not None:
        size = image.shape[1], image.shape[0]
        own = resized_mask(_read_mask(posed.mask, posed.path, size), size)
        mask = own if mask is None else mask & own
    return Photograph(image, None if mask is None or mask.all() else mask)


def read_image(
    file: Path, background: tuple[float, float, float] | None
) -> tuple[np.ndarray, np.ndarray | None]:
    """[H, W, 3] uint8 RGB, and [H, W] bool, True where more than half opaque. Raises UnreadableImage.

    With a background, transparent images are composited on it, and there is no mask; nor is there for opaque images.
    The orientation tag is ignored, as structure from motion ignores it: poses belong to the stored pixels.
    """
    try:
        with open_image(file) as image:
            image.load()
            return _rgb(image, background)
    except DAMAGED as error:
        raise UnreadableImage(_reason(file, error)) from error


def _read_mask(file: Path, photograph: Path, size: tuple[int, int]) -> np.ndarray:
    """[H, W] bool, of the file's own size, which must have the proportions of `size`. Raises UnreadableImage."""
    try:
        with open_image(file) as image:
            width, height = image.size
            if abs(width / size[0] - height / size[1]) > 1 / size[0] + 1 / size[1]:
                raise UnreadableImage(
                    f"{file}: the mask has {width}x{height} pixels, its photograph {photograph.name} "
                    f"{size[0]}x{size[1]}; make a mask of the photograph's proportions"
                )
            gray = image if image.mode.startswith("I") or image.mode == "F" else image.convert("L")
            return mask_of_brightness(np.asarray(gray))
    except DAMAGED as error:
        raise UnreadableImage(_reason(file, error)) from error


def open_image(file: Path) -> Image.Image:
    """Opened, if of one of the FORMATS that this Pillow has; only the header is read. Raises what is in DAMAGED."""
    Image.init()
    return Image.open(file, formats=[name for name in FORMATS if name in Image.OPEN])


def _rgb(
    image: Image.Image, background: tuple[float, float, float] | None
) -> tuple[np.ndarray, np.ndarray | None]:
    if image.mode.startswith("I") or image.mode == "F":  # 16 bits per sample, gray
        gray = np.asarray(image).astype(np.float64)
        eight = np.clip(np.round(gray / 257), 0, 255).astype(np.uint8)
        return np.repeat(eight[:, :, None], 3, axis=2), None
    if "A" in image.getbands() or "transparency" in image.info:
        rgba = np.asarray(image.convert("RGBA"))
        if background is None:
            return np.ascontiguousarray(rgba[:, :, :3]), rgba[:, :, 3] > OPAQUE
        alpha = rgba[:, :, 3:].astype(np.float32) / 255
        behind = np.asarray(background, dtype=np.float32) * 255
        return np.round(rgba[:, :, :3] * alpha + behind * (1 - alpha)).astype(np.uint8), None
    return np.array(image.convert("RGB")), None


def _checked_cameras(images: Sequence[PosedImage]) -> list[Camera]:
    """The cameras at the sizes of the files. Raises for missing or unreadable files and for wrong sizes."""
    missing = [posed for posed in images if not posed.path.is_file()]
    if missing:
        raise UnreadableImage(
            f"{missing[0].path}: this view's image does not exist{_more(len(missing) - 1, 'missing')}; "
            f"put the images there, or name their folder with images=..."
        )
    sizes = _in_threads(lambda index: image_size(images[index].path), len(images), None)
    wrong = [i for i, posed in enumerate(images) if not fits(sizes[i], posed.camera)]
    if wrong:
        posed, (width, height) = images[wrong[0]], sizes[wrong[0]]
        raise UnreadableImage(
            f"{posed.path}: the image has {width}x{height} pixels, but its camera was calibrated for "
            f"{posed.camera.width}x{posed.camera.height}{_more(len(wrong) - 1, 'of the wrong size')}; "
            f"use the images that the poses were computed from, or a uniformly smaller copy of them"
        )
    return [posed.camera.resized(*size) for posed, size in zip(images, sizes, strict=True)]


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
    reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
    return f"{file}: the image cannot be read ({reason}); restore it, or remove the view from the poses"
