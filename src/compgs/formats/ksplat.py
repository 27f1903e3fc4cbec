"""Splats as a .ksplat file (mkkellogg, GaussianSplats3D): quantized within buckets of neighbours. Only read here.

    header, 4096 bytes | a header of 1024 bytes for each section | sections

| header: at byte | type | what |
|---|---|---|
| 0, 1 | 2 uint8 | version: 0 and 1 |
| 4, 8 | 2 uint32 | sections for which there is room; sections |
| 12, 16 | 2 uint32 | splats for which there is room; splats |
| 20 | uint16 | level of compression: 0, 1 or 2 |
| 24 | 3 float32 | center of the scene, which nothing here needs |
| 36, 40 | 2 float32 | range of the harmonics, level 2; zeros stand for -1.5 and 1.5 |

| header of a section: at byte | type | what |
|---|---|---|
| 0, 4 | 2 uint32 | splats; splats for which there is room |
| 8, 12 | 2 uint32 | splats in a full bucket; buckets |
| 16 | float32 | side of a bucket, world units |
| 20 | uint16 | bytes of a bucket: 12 |
| 24 | uint32 | steps in half a side; zero stands for 32767 |
| 32, 36 | 2 uint32 | full buckets; others, which come after them |
| 40 | uint16 | degree of the harmonics |

A section is the number of splats of each bucket that is not full (uint32), the centers of the buckets (3 float32), and
the splats, bucket by bucket. At level 0 there are no buckets, or they mean nothing.

| of a splat | level 0 | 1 | 2 |
|---|---|---|---|
| mean: world units; in steps from the lower side of its bucket | 3 float32 | 3 uint16 | 3 uint16 |
| standard deviations, world units | 3 float32 | 3 float16 | 3 float16 |
| quaternion w-x-y-z | 4 float32 | 4 float16 | 4 float16 |
| color in all directions and opacity, / 255 | 4 uint8 | 4 uint8 | 4 uint8 |
| harmonics, degree by degree, in each channel by channel | float32 | float16 | uint8 |

Little endian. Axes are those of .ply files.
"""

import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from compgs.errors import SplatFileError
from compgs.formats.arrays import (
    COLOR_OFFSET,
    MAX_DEGREE,
    Y0,
    SplatArrays,
    drawable,
    harmonics_above_dc,
    log_scales,
    logit,
)

HEADER_BYTES, SECTION_HEADER_BYTES = 1 << 12, 1 << 10
_HEADER = struct.Struct("<BB2xIIIIHxx3fff")
_SECTION = struct.Struct("<IIIIfHxxI4xIIH")
_BUCKET_BYTES = 12
_HALF_RANGE = 1.5  # of harmonics, where a file does not say
_STEPS = 32767  # in half a bucket's side, where a file does not say


@dataclass(frozen=True)
class _Level:
    """What the columns are stored as."""

    mean: str
    scale: str
    rotation: str
    harmonic: str

    def row(self, degree: int) -> np.dtype:
        """Return the row of a splat."""
        columns: list[tuple[str, str, int]] = [
            ("mean", self.mean, 3),
            ("scale", self.scale, 3),
            ("rotation", self.rotation, 4),
            ("color", "u1", 4),
        ]
        return np.dtype([*columns, ("harmonics", self.harmonic, 3 * harmonics_above_dc(degree))])


_LEVELS = (
    _Level("<f4", "<f4", "<f4", "<f4"),
    _Level("<u2", "<f2", "<f2", "<f2"),
    _Level("<u2", "<f2", "<f2", "u1"),
)


@dataclass(frozen=True)
class Section:
    """Where in the file its parts are, checked against the file's size."""

    count: int  # splats
    row: np.dtype  # of a splat
    degree: int
    full_buckets: int
    full_size: int  # splats in each of them
    other_buckets: int
    step: float  # world units
    center: int  # steps from the lower side of a bucket to its center
    start: int  # bytes before it
    splats_start: int
    end: int

    @property
    def buckets(self) -> int:
        return self.full_buckets + self.other_buckets

    @property
    def centers_start(self) -> int:
        return self.start + 4 * self.other_buckets


@dataclass(frozen=True)
class Layout:
    """What a file's headers say."""

    level: int
    harmonic_range: tuple[float, float]  # of level 2
    sections: tuple[Section, ...]
    bytes: int  # of the whole file


def begins(head: bytes) -> bool:
    """Whether a file begins as a .ksplat does: nothing marks it but its version, its counts and many zeros."""
    if (
        len(head) < HEADER_BYTES
        or head[0] != 0
        or head[1] == 0
        or any(head[2:4])
        or any(head[44:HEADER_BYTES])
    ):
        return False
    _, _, room, sections, _, count, level, *_ = _HEADER.unpack_from(head)
    return sections <= room > 0 and count > 0 and level < len(_LEVELS)


def check(path: Path) -> None:
    """Raises SplatFileError for what can be known without reading the splats."""
    _layout(path)


def read(path: Path) -> SplatArrays:
    """Raises SplatFileError."""
    layout = _layout(path)
    data = np.memmap(path, np.uint8, "r")
    rows = [
        np.ndarray((section.count,), section.row, data, section.splats_start) for section in layout.sections
    ]
    degree = max(section.degree for section in layout.sections)

    def joined(name: str) -> np.ndarray:
        return np.concatenate([part[name] for part in rows]).astype(np.float32)

    colors = joined("color") / 255
    found = SplatArrays(
        means=np.concatenate([_means(path, data, *pair) for pair in zip(layout.sections, rows, strict=True)]),
        log_scales=log_scales(joined("scale")),
        quaternions=joined("rotation"),
        opacity_logits=logit(colors[:, 3]),
        dc=((colors[:, :3] - COLOR_OFFSET) / Y0).astype(np.float32),
        rest=np.concatenate(
            [
                _harmonics(layout, section.degree, degree, part["harmonics"])
                for section, part in zip(layout.sections, rows, strict=True)
            ]
        ),
    )
    return drawable(path, found)


def component_bytes(path: Path) -> dict[str, int]:
    """Bytes of each component of a file; they sum to its size."""
    layout = _layout(path)
    labels = {
        "mean": "positions",
        "scale": "scales",
        "rotation": "rotations",
        "color": "colors and opacities",
        "harmonics": "harmonics",
    }
    sizes = dict.fromkeys(["headers", "buckets", *labels.values()], 0)
    for section in layout.sections:
        sizes["buckets"] += section.splats_start - section.start
        for name, label in labels.items():
            sizes[label] += section.count * section.row[name].itemsize
    sizes["headers"] = layout.bytes - sum(sizes.values())
    return {label: size for label, size in sizes.items() if size}


def _layout(path: Path) -> Layout:
    """Everything but the splats. Raises SplatFileError."""
    size = path.stat().st_size
    with open(path, "rb") as file:
        head = file.read(HEADER_BYTES)
        if len(head) < HEADER_BYTES:
            raise SplatFileError(f"{path}: ends after {len(head)} bytes, within its header; copy it again")
        major, minor, room, _, _, count, level, _, _, _, low, high = _HEADER.unpack_from(head)
        if major != 0 or minor < 1 or level >= len(_LEVELS):
            raise SplatFileError(
                f"{path}: version {major}.{minor} of .ksplat at level {level}; expected 0.1 at level 0 to 2"
            )
        start = HEADER_BYTES + room * SECTION_HEADER_BYTES
        if start > size:
            raise SplatFileError(f"{path}: promises {room} sections in {size} bytes; copy it again")
        headers = file.read(room * SECTION_HEADER_BYTES)
    sections = []
    for i in range(room):
        section = _section(path, headers, i, level, start)
        start = section.end
        if start > size:
            raise SplatFileError(
                f"{path}: section {i} ends at byte {start}, the file after {size}; copy it again"
            )
        if section.count:
            sections.append(section)
    found = sum(section.count for section in sections)
    if found != count:
        raise SplatFileError(f"{path}: {count} splats are promised, its sections have {found}; copy it again")
    if not count:
        raise SplatFileError(f"{path}: holds no splats")
    ends = low or -_HALF_RANGE, high or _HALF_RANGE
    return Layout(level, ends, tuple(sections), size)


def _section(path: Path, headers: bytes, index: int, level: int, start: int) -> Section:
    numbers = _SECTION.unpack_from(headers, index * SECTION_HEADER_BYTES)
    count, most, full_size, buckets, side, bucket_bytes, steps, full, others, degree = numbers
    if degree > MAX_DEGREE:
        raise SplatFileError(f"{path}: harmonics of degree {degree}; expected 0 to {MAX_DEGREE}")
    if count > most:
        raise SplatFileError(f"{path}: {count} splats in a section with room for {most}; copy it again")
    wrong = buckets != full + others or full * full_size > most or (buckets and bucket_bytes != _BUCKET_BYTES)
    if level and wrong:
        raise SplatFileError(
            f"{path}: {full} full buckets of {full_size} splats and {others} others of {bucket_bytes} bytes do not "
            f"make a section of {buckets} buckets and {most} splats; copy it again"
        )
    row = _LEVELS[level].row(degree)
    steps = steps or _STEPS
    splats_start = start + 4 * others + bucket_bytes * buckets
    end = splats_start + most * row.itemsize
    step = side / 2 / steps
    return Section(count, row, degree, full, full_size, others, step, steps, start, splats_start, end)


def _means(path: Path, data: np.ndarray, section: Section, rows: np.ndarray) -> np.ndarray:
    """[M, 3] float32 of a section."""
    if rows["mean"].dtype.kind == "f":
        return rows["mean"].astype(np.float32)
    sizes = np.ndarray((section.other_buckets,), "<u4", data, section.start).astype(np.int64)
    centers = np.ndarray((section.buckets, 3), "<f4", data, section.centers_start)
    ends = section.full_buckets * section.full_size + np.cumsum(sizes)
    held = int(ends[-1]) if len(ends) else section.full_buckets * section.full_size
    if held < section.count:
        raise SplatFileError(f"{path}: {held} splats lie in buckets, expected {section.count}; copy it again")
    index = np.arange(section.count)
    inside = index // max(section.full_size, 1)
    bucket = np.where(
        inside < section.full_buckets,
        inside,
        section.full_buckets + np.searchsorted(ends, index, side="right"),
    )
    steps = rows["mean"].astype(np.float64) - section.center
    with np.errstate(
        invalid="ignore", over="ignore"
    ):  # centers that are not finite are refused by what comes of them
        return (steps * section.step + centers[bucket]).astype(np.float32)


def _harmonics(layout: Layout, held: int, degree: int, stored: np.ndarray) -> np.ndarray:
    """[M, K, 3] float32 of a section of degree `held`, with zeros up to `degree`."""
    values = stored.astype(np.float32)
    if stored.dtype == np.uint8:
        low, high = layout.harmonic_range
        values = (values / 255 * (high - low) + low).astype(np.float32)
    rest = np.zeros((len(values), harmonics_above_dc(degree), 3), np.float32)
    for l in range(1, held + 1):
        band = slice(harmonics_above_dc(l - 1), harmonics_above_dc(l))
        columns = values[:, 3 * band.start : 3 * band.stop]
        rest[:, band] = columns.reshape(len(values), 3, -1).transpose(0, 2, 1)
    return rest
