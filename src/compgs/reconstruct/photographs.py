"""Photographs of a folder, stored upright beside each other: what structure from motion and training both read."""

import os
import shutil
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from PIL import ExifTags, Image, ImageOps

from compgs.errors import SceneError, UnreadableImage
from compgs.scene.images import DAMAGED, open_image
from compgs.scene.masks import FOLDER, find_mask, mask_beside
from compgs.scene.names import Names
from compgs.scene.pixels import UnusableSamples, is_wide, rgb

SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp")
KEPT = (".jpg", ".jpeg", ".png")  # all others become .png, which every reader of a scene opens
HEIC = (".heic", ".heif")
JPEG_QUALITY = 95  # of photographs that must be turned, and so encoded again
PNG_MODES = ("1", "L", "LA", "P", "RGB", "RGBA")
ROTATED = 0x0112  # the tag of the orientation; 1: upright


@dataclass(frozen=True)
class Photograph:
    """A photograph, and what its header says of the camera."""

    path: Path
    name: str  # in the scene: relative, "/" between its parts
    size: tuple[int, int]  # (width, height) in pixels, upright
    upright: bool  # as stored; else its orientation tag asks for a turn
    camera: tuple[str, ...]  # maker, model, lens and focal length, as far as they are known
    mask: Path | None = None  # file that says which of its pixels count, found beside the photographs


def holds_photographs(folder: Path) -> bool:
    """Whether a folder has photographs in it, or in folders inside it."""
    return folder.is_dir() and any(path.suffix.lower() in SUFFIXES for path in _files(folder))


def find_photographs(folder: Path) -> list[Photograph]:
    """All photographs in a folder and the folders inside it, by name.

    Raises SceneError where there are too few of them or their names clash, UnreadableImage for what cannot be opened.
    """
    if not folder.is_dir():
        raise SceneError(f"{folder}: expected a folder of photographs, or a video, found nothing there")
    paths, masks = _without_masks(folder)
    if len(paths) < 3:
        heic = sum(path.suffix.lower() in HEIC for path in _files(folder))
        found = f"{len(paths)} photographs ({', '.join(s[1:] for s in SUFFIXES)})"
        raise SceneError(
            f"{folder}: {found}; poses can be found from 3 on, and some 30 are needed to see a scene from all sides"
            + (f". {heic} HEIC files are not read: convert them, e.g. with heif-convert" if heic else "")
        )
    photographs = [replace(_photograph(path, folder), mask=masks.get(path)) for path in paths]
    names: dict[str, Path] = {}
    for photograph in photographs:
        other = names.setdefault(photograph.name, photograph.path)
        if other != photograph.path:
            raise SceneError(
                f"{photograph.path}: would be stored as {photograph.name}, like {other}; rename one"
            )
    return photographs


def size_and_turn(path: Path) -> tuple[tuple[int, int], bool]:
    """(width, height) in pixels as a photograph is stored, and whether its orientation tag asks for a turn. Raises
    UnreadableImage.
    """
    try:
        with open_image(path) as image:
            return image.size, image.getexif().get(ROTATED, 1) not in (0, 1)
    except DAMAGED as error:
        raise UnreadableImage(f"{path}: cannot be read ({error}); remove it or save it again") from error


def store_upright(photographs: Sequence[Photograph], folder: Path) -> None:
    """Writes the photographs to `folder` by their names: files as they are, unless they must be turned or converted."""
    for photograph in photographs:
        target = folder / photograph.name
        target.parent.mkdir(parents=True, exist_ok=True)
        if photograph.upright and photograph.path.suffix.lower() in KEPT:
            shutil.copyfile(photograph.path, target)
        else:
            _store_turned(photograph.path, target)


def store_masks(photographs: Sequence[Photograph], folder: Path) -> int:
    """Writes the masks of photographs to `folder`, upright as those are, as scenes have them; how many there are.

    Raises UnreadableImage.
    """
    masked = [photograph for photograph in photographs if photograph.mask is not None]
    for photograph in masked:
        target = folder / f"{photograph.name}.png"
        target.parent.mkdir(parents=True, exist_ok=True)
        assert photograph.mask is not None
        try:
            with open_image(photograph.mask) as mask, open_image(photograph.path) as image:
                own, stored = mask.getexif().get(ROTATED, 1), image.getexif().get(ROTATED, 1)
                # Without a tag of its own, a mask of the stored picture's size was drawn on that.
                _turned(mask, stored if own == 1 and mask.size == image.size else own).save(
                    target, format="PNG"
                )
        except DAMAGED as error:
            raise UnreadableImage(
                f"{photograph.mask}: the mask cannot be read ({error}); remove it or save it again"
            ) from error
    return len(masked)


def _without_masks(folder: Path) -> tuple[list[Path], dict[Path, Path]]:
    """Photographs by path, and the masks of those that have one: in a folder `masks`, or beside them by name."""
    paths = sorted(path for path in _files(folder) if path.suffix.lower() in SUFFIXES)
    places = {
        path
        for path in paths
        if path.relative_to(folder).parts[0].lower() == FOLDER and path.parent != folder
    }
    names, masks = Names(), dict[Path, Path]()
    for path in paths:
        mask = mask_beside(path, names)
        if mask is None and places:
            inside = folder / next(iter(places)).relative_to(folder).parts[0]
            mask = find_mask(inside, path.relative_to(folder).as_posix(), names)
        if mask is not None and path not in places:
            masks[path] = mask
    left_out = places | set(masks.values())
    return [path for path in paths if path not in left_out], masks


def _files(folder: Path) -> list[Path]:
    """Files in a folder and the folders inside it; hidden ones, such as thumbnails, are left alone."""
    found = []
    for place, folders, names in os.walk(folder):
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        found += [Path(place, name) for name in names if not name.startswith(".")]
    return found


def _photograph(path: Path, folder: Path) -> Photograph:
    relative = path.relative_to(folder)
    name = relative if path.suffix.lower() in KEPT else relative.with_suffix(".png")
    try:
        name.as_posix().encode("utf-8")
    except UnicodeEncodeError as error:
        raise SceneError(f"{os.fsencode(path)!r}: the name is not UTF-8; rename the file") from error
    try:
        with open_image(path) as image:
            exif = image.getexif()
            width, height = image.size
            if image.mode not in PNG_MODES or is_wide(image):
                _storable(image)
    except UnusableSamples as error:
        raise UnreadableImage(f"{path}: {error}") from error
    except DAMAGED as error:
        raise UnreadableImage(f"{path}: cannot be read ({error}); remove it or save it again") from error
    orientation = exif.get(ROTATED, 1)
    size = (height, width) if orientation in (5, 6, 7, 8) else (width, height)
    return Photograph(path, name.as_posix(), size, orientation in (0, 1), _camera(exif))


def _camera(exif: Image.Exif) -> tuple[str, ...]:
    details = exif.get_ifd(ExifTags.IFD.Exif)
    tags = (ExifTags.Base.LensModel, ExifTags.Base.FocalLength, ExifTags.Base.FocalLengthIn35mmFilm)
    found = [exif.get(ExifTags.Base.Make), exif.get(ExifTags.Base.Model), *(details.get(tag) for tag in tags)]
    return tuple(str(value) for value in found if value is not None)


def _store_turned(source: Path, target: Path) -> None:
    try:
        with open_image(source) as image:
            exif = image.getexif()
            turned = _turned(_storable(image), exif.get(ROTATED, 1))
    except UnusableSamples as error:
        raise UnreadableImage(f"{source}: {error}") from error
    exif.pop(ROTATED, None)  # the rest stays: the focal length is in it
    if target.suffix.lower() == ".png":
        turned.save(target, format="PNG", exif=exif)
    else:
        turned.convert("RGB").save(target, format="JPEG", quality=JPEG_QUALITY, subsampling=0, exif=exif)


def _storable(image: Image.Image) -> Image.Image:
    """The image, in 8 bits where its samples are of a type that PNG does not have. Raises UnusableSamples."""
    wide = is_wide(image)
    image.load()
    if image.mode in PNG_MODES and not wide:
        return image
    return Image.fromarray(rgb(image, (0.0, 0.0, 0.0), wide=wide)[0])


def _turned(image: Image.Image, orientation: int) -> Image.Image:
    """Turn an image as an orientation tag asks for."""
    image.getexif()[ROTATED] = orientation
    return ImageOps.exif_transpose(image)
