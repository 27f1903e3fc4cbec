"""Splats as a .sog file (PlayCanvas, version 2): lossless WebP images and `meta.json`, in a zip or in a folder.

Pixel i, row by row, is splat i in every image but the palette's.

| image | channels | value |
|---|---|---|
| means: low, high | RGB | 16 bits between `mins` and `maxs` of sign(x) log(1 + abs(x)), for each axis |
| scales | RGB | index in `codebook`, of log scales |
| quats | RGB A | w-x-y-z without the largest, (byte / 255 - 1/2) sqrt(2); 252 + which is missing |
| sh0 | RGB A | index in `codebook`, of coefficients of degree 0; opacity / 255 |
| shN: centroids | RGB | a palette of the coefficients of degree 1 to `bands`: 64 entries a row, index in `codebook` |
| shN: labels | RG | 16 bits: which entry |

`antialias` in meta.json, and in newer files `"model": "antialiased"`, say that the splats are antialiased
(`SplatArrays.antialiased`); both are written. What else meta.json says is named in a note.

Axes are those of .ply files. There is no place for where positions count from: they are written as they are, in the
model's own frame.
"""

import io
import json
import math
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from compgs.errors import SplatFileError
from compgs.formats.arrays import (
    MAX_DEGREE,
    SplatArrays,
    check_count,
    drawable,
    harmonics_above_dc,
    logit,
    normalized,
)
from compgs.formats.palette import codebook, palette
from compgs.notes import note

VERSION = 2
META = "meta.json"
PLAIN_MODEL, ANTIALIASED_MODEL = "default", "antialiased"  # by newer writers, in place of `antialias`
KNOWN = {
    "version", "count", "antialias", "model", "means", "scales", "quats", "sh0", "shN",
    "asset", "extras",  # of who wrote it, and for applications: no picture depends on them
}  # fmt: skip
ZIP_MAGIC = b"PK\x03\x04"
BOOK = 256  # entries of a codebook
PALETTE_ROW = 64  # entries in a row of the palette's image
MOST_ENTRIES = 1 << 16
MOST_MEMBERS = 64  # files in a zip
MOST_META_BYTES = 1 << 20
# Images are about as large as the splats need; 16 384 pixels is the longest side of a WebP.
SPARE_PIXELS = 1 << 16
QUATERNION_TAG = 252
# Of 100, what libwebp calls the quality of lossless images. 100 tries everything, in twenty times the time: it halves
# the rotations of splats that lie alike, saves a tenth of the scales, and nothing elsewhere.
CRUNCHED, USUAL = 100, 99
_SQRT2 = math.sqrt(2)
# Made at no time, so that the same splats are the same bytes.
_NO_TIME = (1980, 1, 1, 0, 0, 0)


# writing -----------------------------------------------------------------------------------------------------------


def encoded(arrays: SplatArrays) -> bytes:
    """The content of a zip. Splats come in an order in which neighbours are near, for the images to compress."""
    arrays = arrays.rows(morton_order(arrays.means))
    files, meta = _images(arrays)
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_STORED) as archive:
        for name, content in {META: json.dumps(meta).encode(), **files}.items():
            archive.writestr(zipfile.ZipInfo(name, _NO_TIME), content)
    return buffer.getvalue()


def _images(arrays: SplatArrays) -> tuple[dict[str, bytes], dict[str, Any]]:
    """Files by name, and what meta.json says."""
    logs = np.sign(arrays.means) * np.log1p(np.abs(arrays.means.astype(np.float64)))
    low, high = logs.min(0), logs.max(0)
    steps = np.rint(65535 * (logs - low) / np.where(high > low, high - low, 1)).astype(np.uint16)
    scale_book, scales = codebook(arrays.log_scales, BOOK)
    color_book, colors = codebook(arrays.dc, BOOK)
    opacities = np.rint(255 * arrays.opacities).astype(np.uint8)
    files = {
        "means_l.webp": _image(steps & 255),
        "means_u.webp": _image(steps >> 8),
        "scales.webp": _image(scales, CRUNCHED),
        "quats.webp": _image(_packed_rotations(arrays.quaternions), CRUNCHED),
        "sh0.webp": _image(np.column_stack([colors, opacities])),
    }
    meta: dict[str, Any] = {
        "version": VERSION,
        "asset": {"generator": "compgs"},
        "count": len(arrays),
        "antialias": arrays.antialiased,
        "means": {"mins": low.tolist(), "maxs": high.tolist(), "files": ["means_l.webp", "means_u.webp"]},
        "scales": {"codebook": _short(scale_book), "files": ["scales.webp"]},
        "quats": {"files": ["quats.webp"]},
        "sh0": {"codebook": _short(color_book), "files": ["sh0.webp"]},
    }
    if arrays.antialiased:
        meta["model"] = ANTIALIASED_MODEL
    if arrays.degree:
        files |= _harmonics(arrays, meta)
    return files, meta


def _harmonics(arrays: SplatArrays, meta: dict[str, Any]) -> dict[str, bytes]:
    """The images of the palette; what they are goes into meta."""
    entries, labels = palette(arrays.rest.reshape(len(arrays), -1), palette_size(len(arrays)))
    book, indices = codebook(entries, BOOK)
    count, coefficients = len(entries), arrays.rest.shape[1]
    rows = -(-count // PALETTE_ROW)
    pixels = np.zeros((rows * PALETTE_ROW, coefficients, 3), np.uint8)
    pixels[:count] = indices.reshape(count, coefficients, 3)
    names = ["shN_centroids.webp", "shN_labels.webp"]
    meta["shN"] = {"count": count, "bands": arrays.degree, "codebook": _short(book), "files": names}
    halves = np.column_stack([labels & 255, labels >> 8, np.zeros_like(labels)])
    return {
        names[0]: _webp(pixels.reshape(rows, PALETTE_ROW * coefficients, 3)),
        names[1]: _image(halves),
    }


def _short(book: np.ndarray) -> list[float]:
    """Numbers of seven digits: all that float32 knows, in half the text."""
    return [float(f"{number:.7g}") for number in book]


def palette_size(count: int) -> int:
    """Entries for so many splats: half of them, as far as 16 bits go. Fewer save little and cost quality."""
    return min(MOST_ENTRIES, max(count // 2, 1024))


def morton_order(means: np.ndarray) -> np.ndarray:
    """[M] rows by the interleaved bits of their positions, 21 of each axis."""
    low, high = means.min(0).astype(np.float64), means.max(0).astype(np.float64)
    cells = ((means - low) / np.where(high > low, high - low, 1) * ((1 << 21) - 1)).astype(np.uint64)
    code = np.zeros(len(means), np.uint64)
    for bit in range(21):
        for axis in range(3):
            code |= ((cells[:, axis] >> np.uint64(bit)) & np.uint64(1)) << np.uint64(3 * bit + axis)
    return np.argsort(code, kind="stable")


def _packed_rotations(quaternions: np.ndarray) -> np.ndarray:
    """[M, 4] bytes: the three smaller parts, and which is missing."""
    wxyz = normalized(quaternions)
    largest = np.abs(wxyz).argmax(1)
    wxyz *= np.where(np.take_along_axis(wxyz, largest[:, None], 1) < 0, -1, 1)
    others = wxyz[np.arange(4) != largest[:, None]].reshape(-1, 3)
    parts = np.clip(np.rint(255 * (others / _SQRT2 + 0.5)), 0, 255)
    return np.column_stack([parts, QUATERNION_TAG + largest]).astype(np.uint8)


def _image(values: np.ndarray, effort: int = USUAL) -> bytes:
    """[M, 3 or 4] as the pixels of an image that is about square."""
    width = 4 * max(1, math.ceil(math.sqrt(len(values)) / 4))
    height = -(-len(values) // width)
    pixels = np.zeros((height * width, values.shape[1]), np.uint8)
    pixels[: len(values)] = values
    return _webp(pixels.reshape(height, width, -1), effort)


def _webp(pixels: np.ndarray, effort: int = USUAL) -> bytes:
    """Lossless, and exact: colors of transparent pixels are kept, too."""
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, "WEBP", lossless=True, exact=True, quality=effort, method=6)
    return buffer.getvalue()


# reading -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class SogFiles:
    """What a zip or a folder holds, unpacked no further than to the files."""

    place: Path
    meta: dict[str, Any]
    contents: Mapping[str, bytes]
    bytes: int  # of everything
    count: int  # splats


def begins(head: bytes) -> bool:
    """Whether a file begins as a zip or as JSON does: the one is a .sog, the other may be a `meta.json`."""
    return head.startswith(ZIP_MAGIC) or head.lstrip().startswith(b"{")


def check(path: Path) -> None:
    """Raises SplatFileError for what can be known without decoding an image."""
    _files(path)


def read(path: Path) -> SplatArrays:
    """Of a .sog file, or of a meta.json beside its images. Raises SplatFileError."""
    files = _files(path)
    low, high = (_pixels(files, "means", i, 3) for i in range(2))
    colors = _pixels(files, "sh0", 0, 4)
    scales = _pixels(files, "scales", 0, 3)
    found = SplatArrays(
        means=_positions(files, low.astype(np.int64) + (high.astype(np.int64) << 8)),
        log_scales=_codebook(files, "scales")[scales],
        quaternions=_rotations(_pixels(files, "quats", 0, 4)),
        opacity_logits=logit(colors[:, 3] / 255),
        dc=_codebook(files, "sh0")[colors[:, :3]],
        rest=np.zeros((files.count, 0, 3), np.float32),
        antialiased=_antialiased(files),
    )
    if "shN" in files.meta:
        found = replace(found, rest=_palette_entries(files))
    return drawable(path, found)


def _antialiased(files: SogFiles) -> bool:
    """What meta.json says of how the splats are drawn; of what else it says and nothing here uses, a note."""
    model = files.meta.get("model", PLAIN_MODEL)
    unused = [name for name in files.meta if name not in KNOWN]
    if model not in (PLAIN_MODEL, ANTIALIASED_MODEL):
        unused.append(f"model {model!r:.40}: drawn as plain splats")
    if unused:
        note(files.place, f"{META}: not used: {', '.join(unused)}")
    return model == ANTIALIASED_MODEL or files.meta.get("antialias") is True


def component_bytes(path: Path) -> dict[str, int]:
    """Bytes of each component of a file; they sum to its size, of a meta.json to that of all files."""
    files = _files(path)
    sizes: dict[str, int] = {}
    for name, key in {
        "means": "positions",
        "scales": "scales",
        "quats": "rotations",
        "sh0": "colors and opacities",
        "shN": "harmonics",
    }.items():
        if name in files.meta:
            sizes[key] = sum(len(files.contents[f]) for f in _names(files, name))
    return {**sizes, "container": files.bytes - sum(sizes.values())}


def _files(path: Path) -> SogFiles:
    """Everything but the pixels, checked."""
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
    if meta.get("version") != VERSION:
        raise SplatFileError(f"{path}: version {meta.get('version')} of SOG; expected {VERSION}")
    count = meta.get("count")
    if not isinstance(count, int) or isinstance(count, bool) or count < 0:
        raise SplatFileError(f"{path}: count is {count!r}, expected a number of splats")
    if not zipped:
        contents |= _folder_images(path, meta)
    size = path.stat().st_size if zipped else sum(map(len, contents.values()))
    check_count(path, count, size)
    files = SogFiles(path, meta, contents, size, count)
    for name in ("means", "scales", "quats", "sh0", *(["shN"] if "shN" in meta else [])):
        for file_name in _names(files, name):
            if file_name not in contents:
                raise SplatFileError(f"{path}: {file_name}, which {META} names, is missing")
    return files


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
    """Of a meta.json: images beside it, and nowhere else."""
    contents: dict[str, bytes] = {}
    for entry in meta.values():
        for name in entry.get("files", []) if isinstance(entry, dict) else []:
            if not isinstance(name, str) or Path(name).name != name or len(contents) >= MOST_MEMBERS:
                raise SplatFileError(f"{path}: {name!r} is not the name of a file beside it")
            image = path.parent / name
            if image.is_file():
                contents[name] = image.read_bytes()
    return contents


def _entry(files: SogFiles, name: str) -> dict[str, Any]:
    entry = files.meta.get(name)
    if not isinstance(entry, dict):
        raise SplatFileError(f"{files.place}: {META} has no {name}")
    return entry


def _names(files: SogFiles, name: str) -> list[str]:
    found = _entry(files, name).get("files")
    expected = 2 if name in ("means", "shN") else 1
    if not isinstance(found, list) or len(found) != expected or not all(isinstance(f, str) for f in found):
        raise SplatFileError(f"{files.place}: {name} names files {found!r}; expected {expected}")
    return found


def _numbers(files: SogFiles, name: str, key: str, count: int) -> np.ndarray:
    """[count] float32 of meta.json, finite."""
    values = _values(files, name, key, count)
    if not np.isfinite(values).all():
        raise SplatFileError(f"{files.place}: {name}.{key}: expected {count} finite numbers")
    return values


def _codebook(files: SogFiles, name: str) -> np.ndarray:
    """[BOOK] float32; null, by which JSON writes what is not finite, is not-a-number."""
    return _values(files, name, "codebook", BOOK)


def _values(files: SogFiles, name: str, key: str, count: int) -> np.ndarray:
    """[count] float32 of meta.json."""
    found = _entry(files, name).get(key)
    numbers = isinstance(found, list) and all(x is None or type(x) in (int, float) for x in found)
    if not isinstance(found, list) or not numbers or len(found) != count:
        raise SplatFileError(f"{files.place}: {name}.{key}: expected {count} numbers")
    with np.errstate(over="ignore"):
        return np.array([np.nan if x is None else x for x in found], np.float64).astype(np.float32)


def _pixels(files: SogFiles, name: str, index: int, channels: int) -> np.ndarray:
    """[count, channels] uint8 of one image."""
    pixels = _decoded(files, name, index, channels, 4 * files.count + SPARE_PIXELS)
    flat = pixels.reshape(-1, channels)
    if len(flat) < files.count:
        raise SplatFileError(
            f"{files.place}: {_names(files, name)[index]} has {len(flat)} pixels for {files.count} splats"
        )
    return flat[: files.count]


def _decoded(files: SogFiles, name: str, index: int, channels: int, most_pixels: int) -> np.ndarray:
    """[H, W, channels] uint8; the size is looked at before the pixels are decoded."""
    file_name = _names(files, name)[index]
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


def _positions(files: SogFiles, steps: np.ndarray) -> np.ndarray:
    low, high = (_numbers(files, "means", key, 3).astype(np.float64) for key in ("mins", "maxs"))
    logs = low + (high - low) * steps / 65535
    with np.errstate(over="ignore"):  # what is too far is refused by its infinity
        return (np.sign(logs) * np.expm1(np.abs(logs))).astype(np.float32)


def _rotations(pixels: np.ndarray) -> np.ndarray:
    """[M, 4] bytes -> [M, 4] w-x-y-z; zero, which is no rotation, where the tag names no part."""
    others = (pixels[:, :3] / 255 - 0.5) * _SQRT2
    largest = (pixels[:, 3] & 3).astype(np.int64)  # tags are 252 to 255
    wxyz = np.empty((len(pixels), 4))
    wxyz[np.arange(4) != largest[:, None]] = others.reshape(-1)
    missing = np.sqrt(np.maximum(1 - (others**2).sum(1), 0))
    np.put_along_axis(wxyz, largest[:, None], missing[:, None], 1)
    wxyz[pixels[:, 3] < QUATERNION_TAG] = 0
    return wxyz.astype(np.float32)


def _palette_entries(files: SogFiles) -> np.ndarray:
    """[count, K, 3] float32."""
    entry = _entry(files, "shN")
    bands, count = entry.get("bands", 0), entry.get("count", 0)
    whole = isinstance(bands, int) and isinstance(count, int)
    if not (whole and 1 <= bands <= MAX_DEGREE and 0 < count <= MOST_ENTRIES):
        raise SplatFileError(
            f"{files.place}: shN has {bands!r} bands of {count!r} entries; expected 1 to 3, 1 to {MOST_ENTRIES}"
        )
    coefficients = harmonics_above_dc(bands)
    width = PALETTE_ROW * coefficients
    pixels = _decoded(files, "shN", 0, 3, width * MOST_ENTRIES // PALETTE_ROW)
    if pixels.shape[1] != width or pixels.shape[0] * PALETTE_ROW < count:
        raise SplatFileError(
            f"{files.place}: a palette of {pixels.shape[1]} x {pixels.shape[0]} pixels; expected {width} x "
            f"{-(-count // PALETTE_ROW)} for {count} entries of {bands} bands"
        )
    labels = _pixels(files, "shN", 1, 2).astype(np.int64) @ np.array([1, 256])
    book = _codebook(files, "shN")
    rest = book[pixels.reshape(-1, coefficients, 3)[np.minimum(labels, count - 1)]]
    rest[labels >= count] = np.nan  # a label that names no entry says nothing of the splat's color
    return rest
