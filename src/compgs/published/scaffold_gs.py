"""The file of Scaffold-GS: rows of the published .ply, and the networks. Nothing is compressed. Free of torch.

`anchors` [N, 9 + 3 K + F + 11] float32, of K = 10 offsets and F = 32 features 79 columns, in the published order:

| columns | what |
|---|---|
| 3 | position, world units |
| 3 | normal: zero, nothing uses it |
| 3 K | offsets: x of all, y of all, z of all; in units of the position scales |
| F | feature |
| 1 | opacity: a logit that nothing uses |
| 6 | log scales, world units: of the offsets, of the Gaussians |
| 4 | rotation: a quaternion that nothing uses |

The networks' weights and biases follow by name (`published/anchors.py`), float32.
"""

import math
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from compgs.errors import SplatFileError
from compgs.formats.packed import Packed, write_packed
from compgs.published.anchors import AnchorScene, Frame, network_shapes
from compgs.published.parts.content import stored_place

if TYPE_CHECKING:
    from compgs.devices import Device

MOST_OFFSETS, MOST_FEATURES, MOST_WIDTH = 64, 256, 256
MOST_LOG_SCALE = 88.0  # its exponential is the largest that float32 holds
UNUSED_OPACITY = math.log(0.1 / 0.9)  # as published: of the points at the start
POSITION, NORMAL, OPACITY, SCALES, ROTATION = 3, 3, 1, 6, 4


def columns(offsets: int, features: int) -> int:
    """Numbers of an anchor."""
    return POSITION + NORMAL + 3 * offsets + features + OPACITY + SCALES + ROTATION


def write_anchors(scene: AnchorScene, path: Path) -> int:
    """Write the file; the number of bytes. Raises OutputError."""
    n, k = scene.mask.shape
    log_scales = np.concatenate([scene.position_scales, scene.sizes], 1) + _log(scene.frame.voxel_size)
    rows = np.concatenate(
        [
            scene.positions,
            np.zeros((n, NORMAL)),
            scene.offsets.transpose(0, 2, 1).reshape(n, 3 * k),
            scene.features,
            np.full((n, OPACITY), UNUSED_OPACITY),
            log_scales,
            np.tile([1.0, 0.0, 0.0, 0.0], (n, 1)),
        ],
        axis=1,
    ).astype(np.float32)
    facts = {
        "offsets": k,
        "width": scene.weights["opacity_bias1"].shape[0],
        "distance_unit": scene.frame.distance_unit,
        "offset": list(scene.frame.world_offset),
    }
    return write_packed(path, Packed("scaffold-gs", facts, {"anchors": rows, **scene.weights}), ("raw",))


def opened(packed: Packed, device: "Device", background: tuple[float, float, float]) -> AnchorScene:
    """Inverse of `write_anchors`; drawn by the CPU, on whatever device. Raises SplatFileError."""
    k = packed.whole_number("offsets", 1, MOST_OFFSETS)
    width = packed.whole_number("width", 1, MOST_WIDTH)
    rows = _finite(packed, "anchors", (None, None))
    features = rows.shape[1] - columns(k, 0)
    if not len(rows) or not 1 <= features <= MOST_FEATURES:
        raise SplatFileError(
            f"{packed.path}: anchors: expected {columns(k, 32)} columns of {k} offsets and 32 features, found "
            f"{len(rows)} rows of {rows.shape[1]}"
        )
    unit = packed.number("distance_unit")
    if not 1e-30 < unit < 1e30:
        raise SplatFileError(f"{packed.path}: distance_unit: expected above 0, found {unit}")
    ends = np.cumsum([POSITION, NORMAL, 3 * k, features, OPACITY, SCALES])
    position, _, offset, feature, _, scale, _ = np.split(rows, ends, axis=1)
    if scale.max() > MOST_LOG_SCALE:
        raise SplatFileError(f"{packed.path}: anchors: a log scale of {scale.max():g}, expected up to 88")
    return AnchorScene(
        Frame(1.0, unit, background, stored_place(packed)),
        np.ascontiguousarray(position),
        np.ascontiguousarray(feature),
        np.ascontiguousarray(offset.reshape(-1, 3, k).transpose(0, 2, 1)),
        np.ascontiguousarray(scale[:, :3]),
        np.ascontiguousarray(scale[:, 3:]),
        np.ones((len(rows), k), np.bool_),
        {name: _finite(packed, name, shape) for name, shape in network_shapes(features, k, width).items()},
    )


def _finite(packed: Packed, name: str, shape: tuple[int | None, ...]) -> np.ndarray:
    """Raises SplatFileError."""
    array = packed.array(name, np.float32, shape)
    if not np.isfinite(array).all():
        raise SplatFileError(f"{packed.path}: {name}: hold what is not a finite number; copy it again")
    return array


def _log(voxel_size: float) -> np.float32:
    return np.float32(math.log(voxel_size))
