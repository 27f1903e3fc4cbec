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
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from compgs.errors import SplatFileError
from compgs.formats import sog_first
from compgs.formats.arrays import (
    MAX_DEGREE,
    SplatArrays,
    drawable,
    harmonics_above_dc,
    logit,
    normalized,
)
from compgs.formats.palette import codebook, palette
from compgs.formats.sog_files import (
    BOOK,
    FIRST,
    META,
    MOST_ENTRIES,
    PALETTE_ROW,
    QUATERNION_TAG,
    SECOND,
    SQRT2,
    ZIP_MAGIC,
    SogFiles,
    decoded,
    entry,
    harmonics,
    names,
    numbers_or_null,
    opened,
    pixels,
    positions,
    rotations,
)
from compgs.notes import note

PLAIN_MODEL, ANTIALIASED_MODEL = "default", "antialiased"  # by newer writers, in place of `antialias`
KNOWN = {
    "version", "count", "antialias", "model", "means", "scales", "quats", "sh0", "shN",
    "asset", "extras",  # of who wrote it, and for applications: no picture depends on them
}  # fmt: skip
# Of 100, what libwebp calls the quality of lossless images. 100 tries everything, in twenty times the time: it halves
# the rotations of splats that lie alike, saves a tenth of the scales, and nothing elsewhere.
CRUNCHED, USUAL = 100, 99
# Made at no time, so that the same splats are the same bytes.
_NO_TIME = (1980, 1, 1, 0, 0, 0)


# writing -----------------------------------------------------------------------------------------------------------


def encoded(arrays: SplatArrays) -> bytes:
    """The content of a zip. Splats come in an order in which neighbours are near, for the images to compress."""
    arrays = arrays.rows(morton_order(arrays.means))
    files, meta = images(arrays)
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_STORED) as archive:
        for name, content in {META: json.dumps(meta).encode(), **files}.items():
            archive.writestr(zipfile.ZipInfo(name, _NO_TIME), content)
    return buffer.getvalue()


def images(arrays: SplatArrays) -> tuple[dict[str, bytes], dict[str, Any]]:
    """Files by name, and what meta.json says; splats stay in their order."""
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
        "version": SECOND,
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
    parts = np.clip(np.rint(255 * (others / SQRT2 + 0.5)), 0, 255)
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


def begins(head: bytes) -> bool:
    """Whether a file begins as a zip or as JSON does: the one is a .sog, the other may be a `meta.json`."""
    return head.startswith(ZIP_MAGIC) or head.lstrip().startswith(b"{")


def check(path: Path) -> None:
    """Raises SplatFileError for what can be known without decoding an image."""
    opened(path)


def read(path: Path) -> SplatArrays:
    """Read a .sog file, or a meta.json beside its images. Raises SplatFileError."""
    return drawable(path, splats(path))


def splats(path: Path) -> SplatArrays:
    """All that the file holds, also what cannot be drawn. Raises SplatFileError."""
    files = opened(path)
    found = sog_first.splats(files) if files.version == FIRST else _splats(files)
    return replace(found, antialiased=_antialiased(files))


def _splats(files: SogFiles) -> SplatArrays:
    colors, scales = pixels(files, "sh0", 0, 4), pixels(files, "scales", 0, 3)
    return SplatArrays(
        means=positions(files),
        log_scales=_codebook(files, "scales")[scales],
        quaternions=rotations(files),
        opacity_logits=logit(colors[:, 3] / 255),
        dc=_codebook(files, "sh0")[colors[:, :3]],
        rest=_palette_entries(files) if "shN" in files.meta else np.zeros((files.count, 0, 3), np.float32),
    )


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
    files = opened(path)
    sizes: dict[str, int] = {}
    for name, key in {
        "means": "positions",
        "scales": "scales",
        "quats": "rotations",
        "sh0": "colors and opacities",
        "shN": "harmonics",
    }.items():
        if name in files.meta:
            sizes[key] = sum(len(files.contents[f]) for f in names(files, name))
    return {**sizes, "container": files.bytes - sum(sizes.values())}


def _codebook(files: SogFiles, name: str) -> np.ndarray:
    """[BOOK] float32."""
    return numbers_or_null(files, name, "codebook", BOOK)


def _palette_entries(files: SogFiles) -> np.ndarray:
    """[count, K, 3] float32."""
    said = entry(files, "shN")
    bands, count = said.get("bands", 0), said.get("count", 0)
    whole = isinstance(bands, int) and isinstance(count, int)
    if not (whole and 1 <= bands <= MAX_DEGREE and 0 < count <= MOST_ENTRIES):
        raise SplatFileError(
            f"{files.place}: shN has {bands!r} bands of {count!r} entries; expected 1 to 3, 1 to {MOST_ENTRIES}"
        )
    coefficients = harmonics_above_dc(bands)
    width = PALETTE_ROW * coefficients
    table = decoded(files, "shN", 0, 3, width * MOST_ENTRIES // PALETTE_ROW)
    if table.shape[1] != width or table.shape[0] * PALETTE_ROW < count:
        raise SplatFileError(
            f"{files.place}: a palette of {table.shape[1]} x {table.shape[0]} pixels; expected {width} x "
            f"{-(-count // PALETTE_ROW)} for {count} entries of {bands} bands"
        )
    return harmonics(files, table, bands, count, _codebook(files, "shN"))
