"""A file becomes a scene that can be rendered: the mirror image of encoder.py.

Everything up to the latents is integer arithmetic (reader.py); here they become floats, once.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from compgs.codec.content import Dimensions, FileContent, Latents, Role
from compgs.codec.integer_network import FRACTION_BITS
from compgs.codec.reader import read_latents
from compgs.codec.viewpoint_cameras import camera_from_viewpoint
from compgs.errors import BitstreamError, CorruptSection, NotACompGSFile
from compgs.model.constants import SHARED_RESIDUALS
from compgs.model.heads import HeadDimensions, make_heads
from compgs.model.hybrid_model import HybridModel
from compgs.model.primitives import Primitives

# Primitives of an anchor that stands for m anchors, of which only it has arrived, are m to this power as large: their
# volume is that of all. 3 to 4 dB on a capture; other powers and wider offsets gave less.
COARSE_GROWTH = 1 / 3


def decode(
    path: str | Path, device: str | torch.device | None = None, *, prefix: int | None = None
) -> HybridModel:
    """The scene in a .cgs file, on the CPU unless a device is given.

    `prefix`: of the file's first bytes alone, as if the rest had not arrived yet: a coarser scene.
    Raises a BitstreamError that names the file and the section if it cannot be decoded, or read at all.
    """
    path = Path(path)
    try:
        with path.open("rb") as file:
            data = file.read(-1 if prefix is None else max(0, prefix))
    except OSError as error:
        raise NotACompGSFile(f"{path}: cannot be read ({error.strerror})") from error
    try:
        content, latents = read_latents(data, keep_symbols=False, prefix=prefix is not None)
        return from_latents(content, latents, torch.device(device or "cpu"))
    except BitstreamError as error:
        raise type(error)(f"{path}: {error}") from error


def from_latents(content: FileContent, latents: Latents, device: torch.device) -> HybridModel:
    """Integers to floats: one rounding a value, the same on every machine."""
    d = content.dimensions
    heads = make_heads(d.heads, HeadDimensions(d.reference_dim, d.residual_dim, d.width))
    stored = dict(content.heads)
    shapes = {name: tuple(p.shape) for name, p in heads.named_parameters()}
    if d.channels(Role.RESIDUAL) == 0:
        shapes[SHARED_RESIDUALS] = (d.coupled_primitives, d.residual_dim)
    if stored.keys() != shapes.keys():
        raise CorruptSection(f"prediction heads: expected {sorted(shapes)}, found {sorted(stored)}")
    values = {}
    for name, shape in shapes.items():
        tensor = stored[name]
        if tensor.values.shape != shape:
            raise CorruptSection(
                f"prediction heads: {name} has shape {tensor.values.shape}, expected {shape}"
            )
        values[name] = torch.from_numpy(tensor.values.astype(np.float32) * np.float32(2.0**-tensor.exponent))
    with torch.no_grad():
        for name, parameter in heads.named_parameters():
            parameter.copy_(values[name])
    anchor_index, slots = np.nonzero(content.mask)
    if SHARED_RESIDUALS in shapes:
        residuals = values[SHARED_RESIDUALS][torch.from_numpy(slots)]
    else:
        residuals = _floats(d, latents, Role.RESIDUAL)
    log_scales = _floats(d, latents, Role.LOG_SCALES)
    if content.stands_for is not None:
        log_scales[:, 3:] += COARSE_GROWTH * torch.from_numpy(np.log(content.stands_for)).float()[:, None]
    primitives = Primitives(
        positions=torch.from_numpy(
            content.coordinates.astype(np.float32) * np.float32(content.voxel_size)
        ).to(device),
        log_scales=log_scales.to(device),
        references=_floats(d, latents, Role.REFERENCE).to(device),
        residuals=residuals.to(device),
        anchor_index=torch.from_numpy(anchor_index).to(device),
        voxel_size=content.voxel_size,
    )
    model = HybridModel(
        primitives,
        heads.requires_grad_(False).to(device),
        content.view_distance_scale,
        content.background,
        world_offset=content.world_offset,
    )
    if content.viewpoints is None:
        return model
    views, offset = content.viewpoints.views, content.world_offset
    cameras = tuple(camera_from_viewpoint(view, offset) for view in views)
    return replace(model, viewpoints=cameras, up=content.viewpoints.up)


def _floats(d: Dimensions, latents: Latents, role: Role) -> torch.Tensor:
    """[rows, channels] of all groups of a role, side by side."""
    parts = []
    for shape, fixed in zip(d.groups, latents, strict=True):
        if shape.role != role:
            continue
        values = fixed.astype(np.float32)
        scale = np.array(shape.steps, np.float64) * 2.0**-FRACTION_BITS
        values *= scale.astype(np.float32)  # in place: decoding stays below three times the size of the model
        parts.append(values)
    return torch.from_numpy(parts[0] if len(parts) == 1 else np.concatenate(parts, 1))
