"""The file of LightGaussian: half precision, but for positions; arrays by DEFLATE where that makes them smaller.

| array | type | bytes a splat |
|---|---|---|
| `means` | float32 [M, 3] | 12 |
| `log_scales` | float16 [M, 3] | 6 |
| `quaternions` | float16 [M, 4], of length 1 | 8 |
| `opacity_logits` | float16 [M] | 2 |
| `coded` | bits [M]: whether the color is of the codebook | 1/8 |
| `labels` | bits, ceil(log2 K) of each of those that are, in their order | 1/8 of a bit's |
| `colors` | float16 [others, C], in their order | 2 C each |
| `codes` | float16 [K, C] | none |

C = 3 (degree + 1)^2: coefficients of degree 0 first, RGB each. Facts: `degree`, `offset` of the positions, world units.
"""

from typing import TYPE_CHECKING

import numpy as np

from compgs.formats.arrays import SplatArrays, harmonics_above_dc, normalized
from compgs.formats.packed import Packed, packed_bits, splat_model, unpacked_bits
from compgs.model.splats import SplatModel
from compgs.published.parts.content import stored_place
from compgs.published.parts.indices import index_bits, packed_indices, stored_indices

if TYPE_CHECKING:
    from compgs.devices import Device

NAME = "lightgaussian"  # of the method, as its files have it
GEOMETRY_BYTES = 12 + 6 + 8 + 2
MOST_HALF = float(np.finfo(np.float16).max)


def packed_splats(
    splats: SplatArrays,
    coded: np.ndarray,  # [M] bool
    labels: np.ndarray,  # [coded] int64
    codes: np.ndarray,  # [K, C] float32
) -> Packed:
    """The content of a file."""
    colors = np.concatenate([splats.dc, splats.rest.reshape(len(splats), -1)], 1)
    arrays = {
        "means": splats.means,
        "log_scales": half(splats.log_scales),
        "quaternions": half(normalized(splats.quaternions)),
        "opacity_logits": half(splats.opacity_logits),
        "coded": packed_bits(coded.astype(np.int64), 1),
        "labels": packed_indices(labels, len(codes)),
        "colors": half(colors[~coded]),
        "codes": half(codes),
    }
    return Packed(NAME, {"degree": splats.degree, "offset": list(splats.world_offset)}, arrays)


def opened(packed: Packed, device: "Device", background: tuple[float, float, float]) -> SplatModel:
    """The scene of such a file. Raises SplatFileError."""
    return splat_model(packed, splats_of(packed), device, background)


def splats_of(packed: Packed) -> SplatArrays:
    """Inverse of `packed_splats`, as rounded. Raises SplatFileError."""
    channels = 3 + 3 * harmonics_above_dc(packed.whole_number("degree", 0, 3))
    means = packed.array("means", np.float32, (None, 3))
    count = len(means)
    coded = unpacked_bits(packed.array("coded", np.uint8, (-(-count // 8),)), 1, count).astype(bool)
    codes = packed.array("codes", np.float16, (None, channels))
    shared = int(coded.sum())
    colors = np.empty((count, channels), np.float32)
    colors[coded] = codes[stored_indices(packed, "labels", shared, len(codes))]
    colors[~coded] = packed.array("colors", np.float16, (count - shared, channels))
    return SplatArrays(
        means,
        packed.array("log_scales", np.float16, (count, 3)).astype(np.float32),
        packed.array("quaternions", np.float16, (count, 4)).astype(np.float32),
        packed.array("opacity_logits", np.float16, (count,)).astype(np.float32),
        colors[:, :3],
        colors[:, 3:].reshape(count, -1, 3),
        stored_place(packed),
    )


def half(values: np.ndarray) -> np.ndarray:
    """Round to half precision; larger values than that can hold are its largest."""
    return np.clip(values, -MOST_HALF, MOST_HALF).astype(np.float16)


def splat_bytes(coded: float, codes: int, degree: int) -> float:
    """The law: bytes a splat, before DEFLATE, where a share `coded` of them has colors of a codebook."""
    color = 2 * (3 + 3 * harmonics_above_dc(degree))
    return GEOMETRY_BYTES + 1 / 8 + coded * index_bits(codes) / 8 + (1 - coded) * color


def codebook_bytes(codes: int, degree: int) -> int:
    """Likewise, of the codebook."""
    return 2 * (3 + 3 * harmonics_above_dc(degree)) * codes
