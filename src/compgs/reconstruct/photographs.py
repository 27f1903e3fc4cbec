"""Photographs of a folder, stored upright beside each other: what structure from motion and training both read."""

import os
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from PIL import ExifTags, Image, ImageOps

from compgs.errors import SceneError, UnreadableImage
from compgs.scene.images import DAMAGED, open_image

SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp")
KEPT = (".jpg", ".jpeg", ".png")  # all others become .png, which every reader of a scene opens
HEIC = (".heic", ".heif")
JPEG_QUALITY = 95  # of photographs that must be turned, and so encoded again
ROTATED = 0x0112  # the tag of the orientation; 1: upright


@dataclass(frozen=True)
class Photograph:
    """A photograph, and what its header says of the camera."""

    path: Path
    name: str  # in the scene: relative, "/" between its parts
    size: tuple[int, int]  # (width, height) in pixels, upright
    upright: bool  # as stored; else its orientation tag asks for a turn
    camera: tuple[str, ...]  # maker, model, lens and focal length, as far as they are known


def holds_photographs(folder: Path) -> bool:
    """Whether a folder has photographs in it, or in folders inside it."""
    return folder.is_dir() and any(path.suffix.lower() in SUFFIXES for path in _files(folder))


def find_photographs(folder: Path) -> list[Photograph]:
    """All photographs in a folder and the folders inside it, by name.

    Raises SceneError where there are too few of them or their names clash, UnreadableImage for what cannot be opened.
    """
    if not folder.is_dir():
        raise SceneError(f"{folder}: expected a folder of photographs, or a video, found nothing there")
    paths = sorted(path for path in _files(folder) if path.suffix.lower() in SUFFIXES)
    if len(paths) < 3:
        heic = sum(path.suffix.lower() in HEIC for path in _files(folder))
        found = f"{len(paths)} photographs ({', '.join(s[1:] for s in SUFFIXES)})"
        raise SceneError(
            f"{folder}: {found}; poses can be found from 3 on, and some 30 are needed to see a scene from all sides"
            + (f". {heic} HEIC files are not read: convert them, e.g. with heif-convert" if heic else "")
        )
    photographs = [_photograph(path, folder) for path in paths]
    names: dict[str, Path] = {}
    for photograph in photographs:
        other = names.setdefault(photograph.name, photograph.path)
        if other != photograph.path:
            raise SceneError(
                f"{photograph.path}: would be stored as {photograph.name}, like {other}; rename one"
            )
    return photographs


def store_upright(photographs: Sequence[Photograph], folder: Path) -> None:
    """Writes the photographs to `folder` by their names: files as they are, unless they must be turned or converted."""
    for photograph in photographs:
        target = folder / photograph.name
        target.parent.mkdir(parents=True, exist_ok=True)
        if photograph.upright and photograph.path.suffix.lower() in KEPT:
            shutil.copyfile(photograph.path, target)
        else:
            _store_turned(photograph.path, target)


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
    with open_image(source) as image:
        turned = ImageOps.exif_transpose(image)
        exif = turned.getexif()
        exif.pop(ROTATED, None)  # the rest stays: the focal length is in it
        if target.suffix.lower() == ".png":
            turned.save(target, format="PNG", exif=exif)
        else:
            turned.convert("RGB").save(target, format="JPEG", quality=JPEG_QUALITY, subsampling=0, exif=exif)
