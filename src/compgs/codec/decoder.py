"""A file becomes a scene that can be rendered: the mirror image of encoder.py.

Everything up to the latents is integer arithmetic (reader.py); here they become floats, once.
"""

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from compgs.codec.content import Dimensions, FileContent, Latents, Role
from compgs.codec.format import named
from compgs.codec.integer_network import FRACTION_BITS
from compgs.codec.reader import read_latents
from compgs.codec.viewpoint_cameras import camera_from_viewpoint
from compgs.devices import placed
from compgs.errors import ConfigError, CorruptSection, NotACompGSFile
from compgs.model.arrays import PrimitiveArrays
from compgs.model.constants import SHARED_RESIDUALS
from compgs.model.head_weights import HeadDimensions, HeadWeights
from compgs.model.hybrid_model import HybridModel
from compgs.paths import as_path

if TYPE_CHECKING:
    from compgs.devices import Device

# Primitives of an anchor that stands for m anchors, of which only it has arrived, are m to this power as large: their
# volume is that of all. 3 to 4 dB on a capture; other powers and wider offsets gave less.
COARSE_GROWTH = 1 / 3


def decode(path: "str | Path", device: "Device | None" = None, *, prefix: int | None = None) -> HybridModel:
    """The scene in a .cgs file, as numpy arrays; with a `device` ("cuda") it is drawn there.

    `prefix`: of the file's first bytes alone, as if the rest had not arrived yet: a coarser scene.
    Raises a BitstreamError that names the file and the section if it cannot be decoded, or read at all, and ConfigError
    for a negative `prefix`.
    """
    path = as_path(path, "path")
    if prefix is not None and prefix < 0:
        raise ConfigError(f"prefix = {prefix}: expected a number of bytes")
    try:
        with path.open("rb") as file:
            data = file.read(-1 if prefix is None else prefix)
    except OSError as error:
        raise NotACompGSFile(f"{path}: cannot be read ({error.strerror})") from error
    return decode_bytes(data, path, device, prefix=prefix is not None)


def decode_bytes(
    data: bytes,
    path: Path,  # that they are from, for messages
    device: "Device | None" = None,
    *,
    prefix: bool = False,
) -> HybridModel:
    """The scene in the bytes of a file, or in the beginning of them. Raises BitstreamError, as `decode`."""
    with named(path, prefix=prefix):
        content, latents = read_latents(data, keep_symbols=False, prefix=prefix)
        model = from_latents(content, latents)
    return placed(model, device)


def from_latents(content: FileContent, latents: Latents) -> HybridModel:
    """Integers to floats: one rounding a value, the same on every machine."""
    d = content.dimensions
    dimensions = HeadDimensions(d.reference_dim, d.residual_dim, d.width)
    stored, shapes = dict(content.heads), d.head_shapes
    if stored.keys() != shapes.keys():
        raise CorruptSection(f"prediction heads: expected {sorted(shapes)}, found {sorted(stored)}")
    values = {}
    for name, shape in shapes.items():
        tensor = stored[name]
        if tensor.values.shape != shape:
            raise CorruptSection(
                f"prediction heads: {name} has shape {tensor.values.shape}, expected {shape}"
            )
        values[name] = tensor.values.astype(np.float32) * np.float32(2.0**-tensor.exponent)
    anchor_index, slots = np.nonzero(content.mask)
    if SHARED_RESIDUALS in shapes:
        residuals = values.pop(SHARED_RESIDUALS).take(slots, axis=0)  # a twelfth of the time of `[slots]`
    else:
        residuals = _floats(d, latents, Role.RESIDUAL)
    log_scales = _floats(d, latents, Role.LOG_SCALES)
    if content.stands_for is not None:
        grown = COARSE_GROWTH * np.log(content.stands_for).astype(np.float32)
        log_scales[:, 3:] += grown[:, None].astype(np.float32)
    primitives = PrimitiveArrays(
        positions=content.coordinates.astype(np.float32) * np.float32(content.voxel_size),
        log_scales=log_scales,
        references=_floats(d, latents, Role.REFERENCE),
        residuals=residuals,
        anchor_index=anchor_index.astype(np.int64, copy=False),
        voxel_size=content.voxel_size,
    )
    model = HybridModel(
        primitives,
        HeadWeights(d.heads, dimensions, values),
        content.view_distance_scale,
        content.background,
        world_offset=content.world_offset,
        angular_dilation=content.angular_dilation,
    )
    if content.viewpoints is None:
        return model
    views, offset = content.viewpoints.views, content.world_offset
    cameras = tuple(camera_from_viewpoint(view, offset) for view in views)
    return replace(model, viewpoints=cameras, up=content.viewpoints.up)


def _floats(d: Dimensions, latents: Latents, role: Role) -> np.ndarray:
    """[rows, channels] of all groups of a role, side by side."""
    parts = []
    for shape, fixed in zip(d.groups, latents, strict=True):
        if shape.role != role:
            continue
        values = fixed.astype(np.float32)
        scale = np.array(shape.steps, np.float64) * 2.0**-FRACTION_BITS
        values *= scale.astype(np.float32)  # in place: decoding stays below three times the size of the model
        parts.append(values)
    return parts[0] if len(parts) == 1 else np.concatenate(parts, 1)
