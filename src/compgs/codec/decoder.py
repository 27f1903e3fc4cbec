"""A file becomes a scene that can be rendered: the mirror image of encoder.py.

Everything up to the latents is integer arithmetic (reader.py); here they become floats, once.
"""

from pathlib import Path

import numpy as np
import torch

from compgs.codec.content import FileContent, Latents
from compgs.codec.integer_network import FRACTION_BITS
from compgs.codec.reader import read_latents
from compgs.errors import BitstreamError, CorruptSection, NotACompGSFile
from compgs.model.hybrid_model import HybridModel
from compgs.model.prediction import PredictionHeads
from compgs.model.primitives import Primitives


def decode(path: str | Path, device: str | torch.device | None = None) -> HybridModel:
    """The scene in a .cgs file, on the CPU unless a device is given.

    Raises a BitstreamError that names the file and the section if it cannot be decoded, or read at all.
    """
    path = Path(path)
    try:
        data = path.read_bytes()
    except OSError as error:
        raise NotACompGSFile(f"{path}: cannot be read ({error.strerror})") from error
    try:
        content, latents = read_latents(data, keep_symbols=False)
        return from_latents(content, latents, torch.device(device or "cpu"))
    except BitstreamError as error:
        raise type(error)(f"{path}: {error}") from error


def from_latents(content: FileContent, latents: Latents, device: torch.device) -> HybridModel:
    """Integers to floats: one rounding a value, the same on every machine."""
    d = content.dimensions
    scale = 2.0**-FRACTION_BITS

    def floats(fixed: np.ndarray, step: float) -> torch.Tensor:
        values = fixed.astype(np.float32)
        values *= np.float32(scale * step)  # in place: decoding stays below three times the size of the model
        return torch.from_numpy(values).to(device)

    anchor_index = np.repeat(np.arange(len(content.mask)), content.mask.sum(1))
    heads = PredictionHeads(d.reference_dim, d.residual_dim, d.width, d.heads)
    stored = dict(content.heads)
    expected = {name: p.shape for name, p in heads.named_parameters()}
    if stored.keys() != expected.keys():
        raise CorruptSection(f"prediction heads: expected {sorted(expected)}, found {sorted(stored)}")
    with torch.no_grad():
        for name, parameter in heads.named_parameters():
            tensor = stored[name]
            if tensor.values.shape != tuple(parameter.shape):
                raise CorruptSection(
                    f"prediction heads: {name} has shape {tensor.values.shape}, expected {tuple(parameter.shape)}"
                )
            parameter.copy_(
                torch.from_numpy(tensor.values.astype(np.float32) * np.float32(2.0**-tensor.exponent))
            )
    primitives = Primitives(
        positions=torch.from_numpy(
            content.coordinates.astype(np.float32) * np.float32(content.voxel_size)
        ).to(device),
        log_scales=floats(latents.covariance, content.covariance_step),
        references=floats(latents.reference, content.reference_step),
        residuals=floats(latents.residual, content.residual_step),
        anchor_index=torch.from_numpy(anchor_index).to(device),
        voxel_size=content.voxel_size,
    )
    return HybridModel(
        primitives, heads.requires_grad_(False).to(device), content.view_distance_scale, content.background
    )
