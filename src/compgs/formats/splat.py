"""Splats as a .splat file (antimatter15's viewer): 32 bytes each, no header, no harmonics. Only read here.

| bytes | what |
|---|---|
| 12 | mean, float32 |
| 12 | standard deviations, float32, world units |
| 4 | color in all directions (red, green, blue) and opacity, / 255 |
| 4 | quaternion w-x-y-z, (byte - 128) / 128 |

Nothing marks such a file: it is known by its size and by its first splats being possible ones.
"""

from pathlib import Path

import numpy as np

from compgs.errors import SplatFileError
from compgs.formats.arrays import COLOR_OFFSET, Y0, SplatArrays, drawable, log_scales, logit

ROW = np.dtype([("mean", "<f4", 3), ("scale", "<f4", 3), ("color", "u1", 4), ("rotation", "u1", 4)])
# A quaternion of bytes is of length one to within this; of random bytes few are.
_LENGTH_ERROR = 0.1
_LARGEST = 1e6  # world units, of what is believed to be a splat
# A file is believed to be one where this part of its first splats are possible: a few that are odd spoil no file.
_POSSIBLE = 0.75


def begins(head: bytes) -> bool:
    """Whether the first bytes are whole splats, most of which could be."""
    possible = _possible(head)
    return len(possible) > 0 and float(possible.mean()) >= _POSSIBLE


def doubt(head: bytes) -> str:
    """What speaks against a .splat file that `begins` does not believe in."""
    possible = _possible(head)
    if not len(possible):
        return f"a .splat holds {ROW.itemsize} bytes a splat, this file has {len(head)}"
    return (
        f"as a .splat, {(~possible).sum()} of its first {len(possible)} splats, the first of them number "
        f"{int(np.argmin(possible))}, have a size or a rotation that no splat has"
    )


def _possible(head: bytes) -> np.ndarray:
    """[M] bool: of the splats that these bytes would be, those whose size and rotation a splat may have."""
    rows = np.frombuffer(head[: len(head) // ROW.itemsize * ROW.itemsize], ROW)
    lengths = np.linalg.norm((rows["rotation"].astype(np.float64) - 128) / 128, axis=1)
    with np.errstate(invalid="ignore"):
        return (
            (np.abs(rows["mean"]).max(1) < _LARGEST)
            & (rows["scale"].min(1) >= 0)
            & (rows["scale"].max(1) < _LARGEST)
            & (np.abs(lengths - 1) < _LENGTH_ERROR)
        )


def check(path: Path) -> None:
    """Raises SplatFileError for what can be known without reading the splats."""
    size = path.stat().st_size
    if not size or size % ROW.itemsize:
        raise SplatFileError(
            f"{path}: {size} bytes are not whole splats of {ROW.itemsize} bytes; copy it again"
        )


def read(path: Path) -> SplatArrays:
    """Raises SplatFileError."""
    check(path)
    rows = np.fromfile(path, ROW)
    colors = rows["color"] / 255
    return drawable(
        path,
        SplatArrays(
            means=rows["mean"].copy(),
            log_scales=log_scales(rows["scale"]),
            quaternions=(rows["rotation"].astype(np.float32) - 128) / 128,
            opacity_logits=logit(colors[:, 3]),
            dc=((colors[:, :3] - COLOR_OFFSET) / Y0).astype(np.float32),
            rest=np.zeros((len(rows), 0, 3), np.float32),
        ),
    )


def component_bytes(path: Path) -> dict[str, int]:
    """Bytes of each component of a file; they sum to its size."""
    count = path.stat().st_size // ROW.itemsize
    names = {"mean": "positions", "scale": "scales", "color": "colors and opacities", "rotation": "rotations"}
    return {label: count * ROW[name].itemsize for name, label in names.items()}
