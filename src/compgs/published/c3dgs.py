"""The file of c3dgs: splats in Morton order, each with two indices; arrays by DEFLATE where that makes them smaller.

| array | type | bytes a splat |
|---|---|---|
| `means` | float16 [M, 3], from `center` | 6 |
| `opacities` | uint8 [M], levels | 1 |
| `log_factors` | uint8 [M], levels: the size is exp of it | 1 |
| `colors`, `shapes` | int32 [M] each: rows of the entries | 8 |
| `dc` [P, 3], `rest` [P, K, 3] | uint8, levels: entries of colors | none |
| `scales` [Q, 3], `quaternions` [Q, 4] | uint8, levels: entries of shapes | none |

Facts: `degree` of the harmonics, `offset` of the positions and `center`, world units, and `low` and `step` of levels.
The scales of a splat are the positive ones of its entry, normalized to length 1, times its size.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from compgs.formats.arrays import SplatArrays, harmonics_above_dc, logit
from compgs.formats.packed import Packed, splat_model
from compgs.formats.sog import morton_order
from compgs.model.splats import SplatModel
from compgs.published.parts.content import Offset, stored_place
from compgs.published.parts.indices import checked_labels
from compgs.published.parts.levels import Levels, stored_levels

if TYPE_CHECKING:
    from compgs.devices import Device

NAME = "c3dgs"  # of the method, as its files have it
THINNEST = 1e-4  # of a splat's size: an axis that 8 bits show as 0 is this long
SPLAT_BYTES = 6 + 1 + 1 + 4 + 4  # the law, before DEFLATE


@dataclass(frozen=True, eq=False)
class Shared:
    """M splats, which share P colors and Q shapes; unrounded."""

    means: np.ndarray  # [M, 3] from the center
    opacities: np.ndarray  # [M] in 0 to 1
    log_factors: np.ndarray  # [M] of sizes in world units
    colors: np.ndarray  # [M] int64, rows of the entries
    shapes: np.ndarray  # [M] int64
    dc: np.ndarray  # [P, 3]
    rest: np.ndarray  # [P, K, 3]
    scales: np.ndarray  # [Q, 3]
    quaternions: np.ndarray  # [Q, 4]


LEVELS = ("opacities", "log_factors", "dc", "rest", "scales", "quaternions")


def packed_splats(shared: Shared, degree: int, center: Offset, offset: Offset) -> Packed:
    """The content of a file."""
    most = float(np.finfo(np.float16).max)
    means = np.clip(shared.means, -most, most).astype(np.float16)
    order = morton_order(means.astype(np.float32))
    facts: dict[str, int | float | str | list[Any]] = {
        "degree": degree,
        "offset": list(offset),
        "center": list(center),
    }
    arrays: dict[str, np.ndarray] = {
        "means": means[order],
        "colors": shared.colors[order].astype(np.int32),
        "shapes": shared.shapes[order].astype(np.int32),
    }
    for name in LEVELS:
        values = getattr(shared, name)
        if values.size:
            levels = Levels.of(values)
            arrays[name] = levels.codes[order] if values.ndim == 1 else levels.codes
            facts |= levels.facts(name)
    return Packed(NAME, facts, arrays)


def opened(packed: Packed, device: "Device", background: tuple[float, float, float]) -> SplatModel:
    """The scene of such a file. Raises SplatFileError."""
    return splat_model(packed, splats_of(packed), device, background)


def splats_of(packed: Packed) -> SplatArrays:
    """Inverse of `packed_splats`, as rounded. Raises SplatFileError."""
    harmonics = harmonics_above_dc(packed.whole_number("degree", 0, 3))
    means = packed.array("means", np.float16, (None, 3)).astype(np.float32)
    count = len(means)
    dc = stored_levels(packed, "dc", (None, 3))
    rest = (
        stored_levels(packed, "rest", (len(dc), harmonics, 3))
        if harmonics
        else np.zeros((len(dc), 0, 3), np.float32)
    )
    scales = stored_levels(packed, "scales", (None, 3))
    quaternions = stored_levels(packed, "quaternions", (len(scales), 4))
    colors, shapes = (
        checked_labels(packed, name, packed.array(name, np.int32, (count,)), entries)
        for name, entries in (("colors", len(dc)), ("shapes", len(scales)))
    )
    log_factors = stored_levels(packed, "log_factors", (count,))
    return SplatArrays(
        means + np.array(stored_place(packed, "center"), np.float32),
        log_factors[:, None] + log_shapes(scales)[shapes],
        quaternions[shapes],
        logit(stored_levels(packed, "opacities", (count,))),
        dc[colors],
        rest[colors],
        stored_place(packed),
    )


def log_shapes(scales: np.ndarray) -> np.ndarray:
    """[Q, 3] logs of scales of length 1."""
    positive = np.maximum(scales, np.float32(0))
    lengths = np.maximum(np.linalg.norm(positive, axis=1, keepdims=True), np.float32(1e-12))
    return np.log(np.maximum(positive / lengths, np.float32(THINNEST)))


def entry_bytes(degree: int) -> int:
    """The law: of an entry of the colors and one of the shapes, before DEFLATE."""
    return 3 + 3 * harmonics_above_dc(degree) + 3 + 4
