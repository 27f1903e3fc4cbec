"""Where to look at a scene from: a few of the photographs' cameras, in some dozens of bytes.

All numbers are little-endian.

| field | type | what |
|---|---|---|
| up | 3 x i8 | direction of the sky, unit vector x 127; -127 to 127, not all zero; a decoder normalizes it |
| centre | 3 x f32 | of the cameras, local frame, world units; finite |
| radius | f32 | world units; finite, above 0 |
| lens count | u8 | 1 to 16 |
| each lens | u16, u16, f32, f32 | width and height in pixels, at least 1; fx and fy in pixels, finite, above 0 |
| view count | u8 | 1 to 255 |
| each view | u8 | its lens, below the lens count |
| | 3 x i16 | position p: the camera is at centre + radius p / 32767; -32767 to 32767 |
| | u48 | rotation, world to camera, a unit quaternion |

Rotation: q and -q are the same, so the largest of w, x, y, z is taken as positive and left out. Bits 0-1 say which it
is (0: w). Bits 2-16, 17-31 and 32-46 are the other three in the order w, x, y, z: each x 16383 sqrt(2), rounded, two's
complement, -16383 to 16383. Bit 47 is 0. The one that is left out is at least 1/2, so the squares of the three numbers
sum to at most 3 x 2^27, with room for rounding; it is the square root of what the three leave to 1.

A decoder refuses whatever is outside of these ranges, and bytes after the last view. The principal point is the middle
of the image. An angle is off by less than 0.02 degrees, a position by less than radius / 30000.
"""

import math
import struct
from dataclasses import dataclass

import numpy as np

from compgs.codec.fields import FieldReader
from compgs.errors import CorruptSection, NotEncodable

MAX_LENSES = 16
MAX_VIEWS = 255
MAX_SIDE = (1 << 16) - 1  # pixels
UP_SCALE = 127
POSITION_SCALE = 32767
ROTATION_LIMIT = 16383
ROTATION_SCALE = ROTATION_LIMIT * math.sqrt(2)  # the three smaller parts are at most sqrt(1/2)
MAX_SQUARES = 3 << 27  # of three such parts: 3/4 of (16384 sqrt(2))^2

Quaternion = tuple[float, float, float, float]
Vector = tuple[float, float, float]


@dataclass(frozen=True)
class Viewpoint:
    """A place to look from, and through which lens."""

    rotation: Quaternion  # w-x-y-z, world to camera (OpenCV axes), of length 1
    center: Vector  # of the camera, world units, local frame (world minus the model's world_offset)
    width: int  # pixels
    height: int  # pixels
    fx: float  # pixels
    fy: float  # pixels

    @property
    def lens(self) -> tuple[int, int, float, float]:
        """Width, height, fx and fy, in pixels."""
        return self.width, self.height, self.fx, self.fy


@dataclass(frozen=True)
class Viewpoints:
    """Places that a scene is good to look at from, the best first, and where its sky is."""

    up: Vector  # unit vector in world axes
    views: tuple[Viewpoint, ...]  # 1 to 255


def encode_viewpoints(viewpoints: Viewpoints) -> bytes:
    """The section's bytes. Raises NotEncodable for values that it cannot hold."""
    if not 1 <= len(viewpoints.views) <= MAX_VIEWS:
        raise NotEncodable(f"viewpoints: {len(viewpoints.views)} views, expected 1 to {MAX_VIEWS}")
    lenses = _lenses(viewpoints.views)
    center, radius = _box(viewpoints.views)
    parts = [
        _up_bytes(viewpoints.up),
        struct.pack("<4f", *center, radius),
        struct.pack("<B", len(lenses)),
        *(struct.pack("<2H2f", *lens) for lens in lenses),
        struct.pack("<B", len(viewpoints.views)),
    ]
    for view in viewpoints.views:
        position = np.rint((np.array(view.center) - center) / radius * POSITION_SCALE).astype(int).tolist()
        parts.append(struct.pack("<B3h", lenses.index(_single(view.lens)), *position))
        parts.append(_packed_rotation(view.rotation).to_bytes(6, "little"))
    return b"".join(parts)


def decode_viewpoints(data: bytes, section_name: str) -> Viewpoints:
    """Inverse of `encode_viewpoints`. Raises CorruptSection with the section's name for anything else."""
    reader = FieldReader(data, section_name)
    up = _read_up(reader)
    *center, radius = reader.struct("<4f", "centre and radius")
    _check(reader, np.isfinite(center).all(), "centre", center, "finite numbers")
    _check(reader, 0 < radius < math.inf, "radius", radius, "a finite number above 0")
    lenses = [_read_lens(reader) for _ in range(_read_count(reader, "lens count", MAX_LENSES))]
    views = []
    for _ in range(_read_count(reader, "view count", MAX_VIEWS)):
        (lens,) = reader.struct("<B", "lens of a view")
        _check(reader, lens < len(lenses), "lens of a view", lens, f"below {len(lenses)}")
        p = reader.struct("<3h", "position of a view")
        _check(reader, min(p) >= -POSITION_SCALE, "position of a view", p, f"{-POSITION_SCALE} or more")
        x, y, z = (c + radius * number / POSITION_SCALE for c, number in zip(center, p, strict=True))
        views.append(Viewpoint(_read_rotation(reader), (x, y, z), *lenses[lens]))
    reader.end()
    return Viewpoints(up, tuple(views))


# the fields, what is written beside what is read ---------------------------------------------------------------------


def _up_bytes(up: Vector) -> bytes:
    length = math.hypot(*up)
    if not 0 < length < math.inf:
        raise NotEncodable(f"viewpoints: up is {up}, expected a direction")
    return struct.pack("<3b", *(round(UP_SCALE * (part / length)) for part in up))


def _read_up(reader: FieldReader) -> Vector:
    x, y, z = reader.struct("<3b", "up")
    _check(reader, min(x, y, z) >= -UP_SCALE, "up", (x, y, z), f"{-UP_SCALE} or more")
    length = math.hypot(x, y, z)
    _check(reader, length > 0, "up", (x, y, z), "a direction")
    return x / length, y / length, z / length


def _lenses(views: tuple[Viewpoint, ...]) -> list[tuple[int, int, float, float]]:
    """The different ones, in the order in which they come; focal lengths in single precision."""
    lenses = list(dict.fromkeys(_single(view.lens) for view in views))
    if len(lenses) > MAX_LENSES:
        raise NotEncodable(f"viewpoints: {len(lenses)} different lenses, at most {MAX_LENSES} fit")
    for width, height, fx, fy in lenses:
        if not (1 <= min(width, height) <= max(width, height) <= MAX_SIDE and min(fx, fy) > 0) or not (
            np.isfinite([fx, fy]).all()
        ):
            raise NotEncodable(
                f"viewpoints: a lens of {width} x {height} pixels, fx {fx}, fy {fy}; expected 1 to {MAX_SIDE} pixels "
                "and finite focal lengths above 0"
            )
    return lenses


def _single(lens: tuple[int, int, float, float]) -> tuple[int, int, float, float]:
    width, height, fx, fy = lens
    with np.errstate(over="ignore"):  # becomes infinite, which is refused
        return width, height, float(np.float32(fx)), float(np.float32(fy))


def _read_lens(reader: FieldReader) -> tuple[int, int, float, float]:
    width, height, fx, fy = reader.struct("<2H2f", "lens")
    _check(reader, min(width, height) >= 1, "size of a lens", (width, height), "at least 1 pixel")
    sound = 0 < fx < math.inf and 0 < fy < math.inf
    _check(reader, sound, "focal lengths", (fx, fy), "finite numbers above 0")
    return width, height, fx, fy


def _box(views: tuple[Viewpoint, ...]) -> tuple[np.ndarray, float]:
    """Middle [3] and half the longest side of the box of the cameras, as single precision will hold them."""
    positions = np.array([view.center for view in views], dtype=np.float64)
    with np.errstate(over="ignore", invalid="ignore"):
        center = ((positions.min(axis=0) + positions.max(axis=0)) / 2).astype(np.float32).astype(np.float64)
        radius = float(np.float32(np.abs(positions - center).max()))  # from the rounded middle
    if not (np.isfinite(center).all() and radius < math.inf):
        raise NotEncodable("viewpoints: a camera's position is not finite in single precision")
    # All in one place: any radius does; one that single precision holds only roughly would not.
    return center, radius if radius >= np.finfo(np.float32).tiny else 1.0


def _packed_rotation(rotation: Quaternion) -> int:
    """The 48 bits of a unit quaternion."""
    quaternion = np.array(rotation, dtype=np.float64)
    length = float(np.linalg.norm(quaternion))
    if not 0 < length < math.inf:
        raise NotEncodable(f"viewpoints: the rotation {rotation} is not a quaternion")
    largest = int(np.abs(quaternion).argmax())
    scale = math.copysign(ROTATION_SCALE / length, quaternion[largest])
    bits = largest
    for slot, part in enumerate(np.delete(quaternion, largest) * scale):
        number = min(max(round(float(part)), -ROTATION_LIMIT), ROTATION_LIMIT)  # rounding errors of sqrt(1/2)
        bits |= (number & 0x7FFF) << (2 + 15 * slot)
    return bits


def _read_rotation(reader: FieldReader) -> Quaternion:
    bits = int.from_bytes(reader.bytes(6, "rotation of a view"), "little")
    _check(reader, bits >> 47 == 0, "rotation of a view", hex(bits), "bit 47 to be 0")
    fields = [bits >> (2 + 15 * slot) & 0x7FFF for slot in range(3)]
    parts = [field - (field >> 14 << 15) for field in fields]
    _check(reader, min(parts) >= -ROTATION_LIMIT, "rotation of a view", parts, f"{-ROTATION_LIMIT} or more")
    squares = sum(part * part for part in parts)
    _check(reader, squares <= MAX_SQUARES, "rotation of a view", parts, "three that are not the largest")
    quaternion = [part / ROTATION_SCALE for part in parts]
    quaternion.insert(bits & 3, math.sqrt(1.0 - sum(part * part for part in quaternion)))
    w, x, y, z = quaternion
    return w, x, y, z


def _read_count(reader: FieldReader, field: str, highest: int) -> int:
    (count,) = reader.struct("<B", field)
    _check(reader, 1 <= count <= highest, field, count, f"1 to {highest}")
    return int(count)


def _check(reader: FieldReader, sound: object, field: str, found: object, expected: str) -> None:
    if not sound:
        raise CorruptSection(f"{reader.section}: {field} is {found}, expected {expected}")
