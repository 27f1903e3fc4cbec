"""What a .sog file holds, of either version: `meta.json` and images, in a zip or in a folder, down to their pixels.

`sog` has the layout of version 2, `sog_first` that of version 1; what both share is read here. Counts are checked
against the size of the file before anything is taken for them.
"""

import io
import json
import math
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from compgs.errors import SplatFileError
from compgs.formats.arrays import check_count, harmonics_above_dc

FIRST, SECOND = 1, 2  # versions
META = "meta.json"
ZIP_MAGIC = b"PK\x03\x04"
BOOK = 256  # entries of a codebook
PALETTE_ROW = 64  # entries in a row of the palette's image
MOST_ENTRIES = 1 << 16
MOST_MEMBERS = 64  # files in a zip
MOST_META_BYTES = 1 << 20
# Images are about as large as the splats need; 16 384 pixels is the longest side of a WebP.
SPARE_PIXELS = 1 << 16
QUATERNION_TAG = 252
_LARGEST = 1 << 1023  # of whole numbers that are floats, too
SQRT2 = math.sqrt(2)


@dataclass(frozen=True, eq=False)
class SogFiles:
    """What a zip or a folder holds, unpacked no further than to the files."""

    place: Path
    version: int
    meta: dict[str, Any]
    contents: Mapping[str, bytes]
    bytes: int  # of everything
    count: int  # splats


def opened(path: Path) -> SogFiles:
    """Everything but the pixels, checked. Raises SplatFileError."""
    with open(path, "rb") as file:
        zipped = file.read(4) == ZIP_MAGIC
    contents = _zip_contents(path) if zipped else _folder_contents(path)
    if META not in contents:
        raise SplatFileError(f"{path}: is a zip without {META}, so not a .sog file")
    try:
        meta = json.loads(contents[META])
    except (ValueError, RecursionError) as error:
        raise SplatFileError(f"{path}: {META} is not JSON ({error}); copy it again") from error
    if not isinstance(meta, dict) or "means" not in meta:
        raise SplatFileError(f"{path}: {META} does not describe splats")
    version, count = _version_and_count(path, meta)
    if not zipped:
        contents |= _folder_images(path, meta)
    size = path.stat().st_size if zipped else sum(map(len, contents.values()))
    check_count(path, count, size)
    files = SogFiles(path, version, meta, contents, size, count)
    for name in ("means", "scales", "quats", "sh0", *(["shN"] if "shN" in meta else [])):
        for file_name in names(files, name):
            if file_name not in contents:
                raise SplatFileError(f"{path}: {file_name}, which {META} names, is missing")
    return files


def _version_and_count(path: Path, meta: dict[str, Any]) -> tuple[int, int]:
    """Files of the first version have neither field: they say of each image which shape its content has."""
    version = meta.get("version", FIRST)
    if version not in (FIRST, SECOND):
        raise SplatFileError(f"{path}: version {version!r} of SOG; expected {FIRST} or {SECOND}")
    name, count = "count", meta.get("count")
    if version == FIRST:
        shape = meta["means"].get("shape") if isinstance(meta["means"], dict) else None
        name, count = "means.shape", shape[0] if isinstance(shape, list) and shape else None
    if type(count) is not int or count < 0:
        raise SplatFileError(f"{path}: {name} is {count!r}, expected a number of splats")
    return version, count


def _zip_contents(path: Path) -> dict[str, bytes]:
    size = path.stat().st_size
    try:
        with zipfile.ZipFile(path) as archive:
            members = archive.infolist()
            if len(members) > MOST_MEMBERS:
                raise SplatFileError(f"{path}: {len(members)} files inside; expected at most {MOST_MEMBERS}")
            contents: dict[str, bytes] = {}
            room = size + MOST_META_BYTES  # images are compressed already; meta.json may be a little larger
            for member in members:
                with archive.open(member) as file:
                    content = file.read(room + 1)
                room -= len(content)
                if room < 0:
                    raise SplatFileError(f"{path}: {member.filename} is larger than the whole file may hold")
                contents[member.filename] = content
            return contents
    except (zipfile.BadZipFile, zipfile.LargeZipFile, OSError, EOFError, ValueError, RuntimeError) as error:
        raise SplatFileError(f"{path}: is damaged ({error}); copy it again") from error
    except Exception as error:  # zlib.error and NotImplementedError: methods that nobody writes
        if isinstance(error, SplatFileError):
            raise
        raise SplatFileError(f"{path}: is damaged ({error}); copy it again") from error


def _folder_contents(path: Path) -> dict[str, bytes]:
    if path.stat().st_size > MOST_META_BYTES:
        raise SplatFileError(f"{path}: expected a {META} of at most {MOST_META_BYTES} bytes")
    return {META: path.read_bytes()}


def _folder_images(path: Path, meta: dict[str, Any]) -> dict[str, bytes]:
    """Read the images of a meta.json: those beside it, and nowhere else."""
    contents: dict[str, bytes] = {}
    for entry in meta.values():
        for name in entry.get("files", []) if isinstance(entry, dict) else []:
            if not isinstance(name, str) or Path(name).name != name or len(contents) >= MOST_MEMBERS:
                raise SplatFileError(f"{path}: {name!r} is not the name of a file beside it")
            image = path.parent / name
            if image.is_file():
                contents[name] = image.read_bytes()
    return contents


def entry(files: SogFiles, name: str) -> dict[str, Any]:
    entry = files.meta.get(name)
    if not isinstance(entry, dict):
        raise SplatFileError(f"{files.place}: {META} has no {name}")
    return entry


def names(files: SogFiles, name: str) -> list[str]:
    found = entry(files, name).get("files")
    expected = 2 if name in ("means", "shN") else 1
    if not isinstance(found, list) or len(found) != expected or not all(isinstance(f, str) for f in found):
        raise SplatFileError(f"{files.place}: {name} names files {found!r}; expected {expected}")
    return found


def numbers(files: SogFiles, name: str, key: str, count: int) -> np.ndarray:
    """[count] float32 of meta.json, finite."""
    found = numbers_or_null(files, name, key, count)
    if not np.isfinite(found).all():
        raise SplatFileError(f"{files.place}: {name}.{key}: expected {count} finite numbers")
    return found


def numbers_or_null(files: SogFiles, name: str, key: str, count: int) -> np.ndarray:
    """[count] float32 of meta.json; null, by which JSON writes what is not finite, is not-a-number."""
    found = entry(files, name).get(key)
    if not isinstance(found, list) or len(found) != count:
        raise SplatFileError(f"{files.place}: {name}.{key}: expected {count} numbers")
    values = np.array([_number(files, name, key, each) for each in found], np.float64)
    with np.errstate(over="ignore"):
        return values.astype(np.float32)


def number(files: SogFiles, name: str, key: str) -> float:
    """One of meta.json, finite."""
    found = _number(files, name, key, entry(files, name).get(key))
    if not math.isfinite(found):
        raise SplatFileError(f"{files.place}: {name}.{key}: expected a finite number")
    return found


def _number(files: SogFiles, name: str, key: str, found: object) -> float:
    """Integers that are too large for any float are infinite; null is not-a-number."""
    if found is None:
        return math.nan
    if isinstance(found, bool) or not isinstance(found, int | float):
        raise SplatFileError(f"{files.place}: {name}.{key}: expected numbers, found {found!r:.40}")
    if isinstance(found, float) or abs(found) < _LARGEST:
        return float(found)
    return math.inf if found > 0 else -math.inf


def pixels(files: SogFiles, name: str, index: int, channels: int) -> np.ndarray:
    """[count, channels] uint8 of one image."""
    image = decoded(files, name, index, channels, 4 * files.count + SPARE_PIXELS)
    flat = image.reshape(-1, channels)
    if len(flat) < files.count:
        raise SplatFileError(
            f"{files.place}: {names(files, name)[index]} has {len(flat)} pixels for {files.count} splats"
        )
    return flat[: files.count]


def decoded(files: SogFiles, name: str, index: int, channels: int, most_pixels: int) -> np.ndarray:
    """[H, W, channels] uint8; the size is looked at before the pixels are decoded."""
    file_name = names(files, name)[index]
    place = f"{files.place}: {file_name}"
    try:
        with Image.open(io.BytesIO(files.contents[file_name]), formats=["WEBP", "PNG"]) as image:
            if image.width * image.height > most_pixels:
                raise SplatFileError(
                    f"{place}: {image.width} x {image.height} pixels for {files.count} splats"
                )
            return np.asarray(image.convert("RGBA"))[:, :, :channels]
    except (OSError, ValueError, SyntaxError, EOFError, Image.DecompressionBombError) as error:
        raise SplatFileError(f"{place}: is not an image ({error}); copy it again") from error


def positions(files: SogFiles) -> np.ndarray:
    """[count, 3] float32."""
    low_bytes, high_bytes = (pixels(files, "means", i, 3).astype(np.int64) for i in range(2))
    low, high = (numbers(files, "means", key, 3).astype(np.float64) for key in ("mins", "maxs"))
    logs = low + (high - low) * (low_bytes + (high_bytes << 8)) / 65535
    with np.errstate(over="ignore"):  # what is too far is left out for its infinity
        return (np.sign(logs) * np.expm1(np.abs(logs))).astype(np.float32)


def rotations(files: SogFiles) -> np.ndarray:
    """[count, 4] w-x-y-z; zero, which is no rotation, where the tag names no part."""
    stored = pixels(files, "quats", 0, 4)
    others = (stored[:, :3] / 255 - 0.5) * SQRT2
    largest = (stored[:, 3] & 3).astype(np.int64)  # tags are 252 to 255
    wxyz = np.empty((len(stored), 4))
    wxyz[np.arange(4) != largest[:, None]] = others.reshape(-1)
    missing = np.sqrt(np.maximum(1 - (others**2).sum(1), 0))
    np.put_along_axis(wxyz, largest[:, None], missing[:, None], 1)
    wxyz[stored[:, 3] < QUATERNION_TAG] = 0
    return wxyz.astype(np.float32)


def harmonics(files: SogFiles, palette: np.ndarray, bands: int, count: int, book: np.ndarray) -> np.ndarray:
    """[count of splats, K, 3] float32 of a palette's image of `count` entries; `book` [256] is what its bytes mean."""
    coefficients = harmonics_above_dc(bands)
    labels = pixels(files, "shN", 1, 2).astype(np.int64) @ np.array([1, 256])
    rest = book[palette.reshape(-1, coefficients, 3)[np.minimum(labels, count - 1)]]
    rest[labels >= count] = np.nan  # a label that names no entry says nothing of the splat's color
    return rest
