"""The file of Compact3D: splats in ascending order of their rotation's code.

| array | type | bytes a splat |
|---|---|---|
| `means` | float32 [M, 3] (16 bits: `x`, `y`, `z`, uint16 [M]) | 12 (6) |
| `opacity_logits` | float32 [M] (8 bits: uint8) | 4 (1) |
| `dc_labels`, `log_scales_labels`, `rest_labels` | bits, ceil(log2 K) each | 1/8 of a bit's |
| `quaternions_counts` | uint32 [K] | none: 4 bytes a code |
| `dc_codes` [K, 3], `log_scales_codes` [K, 3], `quaternions_codes` [K, 4], `rest_codes` [L, 45] | float32 | none |

Facts: `degree` of the harmonics, `bit_quantized` (0 or 1), `offset` of the positions, world units. Without harmonics
above degree 0 there are no `rest_*`. Nothing is compressed: that is how its sizes are published.
"""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from compgs.formats.arrays import SplatArrays, harmonics_above_dc
from compgs.formats.packed import Packed, splat_model
from compgs.model.splats import SplatModel
from compgs.published.parts.content import stored_place
from compgs.published.parts.indices import (
    index_bits,
    label_counts,
    packed_indices,
    stored_counts,
    stored_indices,
)
from compgs.published.parts.levels import Levels, stored_levels

if TYPE_CHECKING:
    from compgs.devices import Device

NAME = "compact3d"  # of the method, as its files have it
SORTED = "quaternions"  # what splats are sorted by
LABELED = ("dc", "log_scales", "rest")
POSITION_BITS, OPACITY_BITS = 16, 8  # of BitQ


def packed_splats(
    splats: SplatArrays,  # means and opacities count
    labels: Mapping[str, np.ndarray],  # [M] int64 by name: of SORTED and LABELED
    codes: Mapping[str, np.ndarray],  # [K, C] float32, likewise
    *,
    bit_quantized: bool,
) -> Packed:
    """The content of a file."""
    order = np.argsort(labels[SORTED], kind="stable")
    facts: dict[str, int | float | str | list[Any]] = {
        "degree": splats.degree,
        "bit_quantized": int(bit_quantized),
        "offset": list(splats.world_offset),
    }
    means, logits = splats.means[order], splats.opacity_logits[order]
    arrays: dict[str, np.ndarray] = {}
    if bit_quantized:
        columns = {"x": means[:, 0], "y": means[:, 1], "z": means[:, 2]}
        stored = {name: Levels.of(column, POSITION_BITS) for name, column in columns.items()}
        stored["opacity_logits"] = Levels.of(logits, OPACITY_BITS)
        for name, levels in stored.items():
            arrays[name] = levels.codes
            facts |= levels.facts(name)
    else:
        arrays |= {"means": means, "opacity_logits": logits}
    arrays[f"{SORTED}_counts"] = label_counts(labels[SORTED][order], len(codes[SORTED]))
    for name in codes:
        if name != SORTED:
            arrays[f"{name}_labels"] = packed_indices(labels[name][order], len(codes[name]))
        arrays[f"{name}_codes"] = codes[name]
    return Packed(NAME, facts, arrays)


def opened(packed: Packed, device: "Device", background: tuple[float, float, float]) -> SplatModel:
    """The scene of such a file. Raises SplatFileError."""
    return splat_model(packed, splats_of(packed), device, background)


def splats_of(packed: Packed) -> SplatArrays:
    """Inverse of `packed_splats`. Raises SplatFileError."""
    degree = packed.whole_number("degree", 0, 3)
    if packed.whole_number("bit_quantized", 0, 1):
        x = stored_levels(packed, "x", (None,), POSITION_BITS)
        count = len(x)
        y, z = (stored_levels(packed, name, (count,), POSITION_BITS) for name in "yz")
        means = np.stack([x, y, z], 1)
        logits = stored_levels(packed, "opacity_logits", (count,), OPACITY_BITS)
    else:
        means = packed.array("means", np.float32, (None, 3))
        count = len(means)
        logits = packed.array("opacity_logits", np.float32, (count,))
    columns = {"dc": 3, "log_scales": 3, SORTED: 4, "rest": 3 * harmonics_above_dc(degree)}
    values: dict[str, np.ndarray] = {}
    for name, channels in columns.items():
        if not channels:
            values[name] = np.zeros((count, 0), np.float32)
            continue
        codes = packed.array(f"{name}_codes", np.float32, (None, channels))
        read = stored_counts if name == SORTED else stored_indices
        kind = "counts" if name == SORTED else "labels"
        values[name] = codes[read(packed, f"{name}_{kind}", count, len(codes))]
    return SplatArrays(
        means,
        values["log_scales"],
        values[SORTED],
        logits,
        values["dc"],
        values["rest"].reshape(count, -1, 3),
        stored_place(packed),
    )


def splat_bytes(codes: int, harmonics_codes: int, degree: int, *, bit_quantized: bool) -> float:
    """The law: bytes a splat."""
    columns = 2 * index_bits(codes) + (index_bits(harmonics_codes) if degree else 0)
    return (7 if bit_quantized else 16) + columns / 8


def codebook_bytes(codes: int, harmonics_codes: int, degree: int) -> int:
    """Count the bytes of the four codebooks, and of how many splats have each rotation."""
    return 4 * (11 * codes + (3 * harmonics_above_dc(degree) * harmonics_codes))
