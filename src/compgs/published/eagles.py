"""Splats of which harmonics, rotation and opacity are decoded from integers, and their file. Free of torch.

    harmonics = latents [M, L] @ (cosines [L, 3 K] * scales [3 K])      opacity logit = latents [M, 1] @ weights [1, 1]
    rotation  = latents [M, L] @ weights [L, 4]

In the file: positions, colors and scales as float32, the decoders as float32, and all integers of an attribute by one
histogram (`published/parts/histogram.py`).
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from compgs.formats.packed import Packed, splat_model
from compgs.model.degrees import MAX_DEGREE, harmonics_above_dc
from compgs.model.splats import SplatArrays, SplatModel
from compgs.published.parts.content import Content, Offset, stored_place
from compgs.published.parts.histogram import packed_symbols, unpacked_symbols

if TYPE_CHECKING:
    from compgs.devices import Device

MOST_LATENTS = 64  # of a splat's attribute


@dataclass(frozen=True, eq=False)
class Code:
    """An attribute of M splats: integers, and what makes numbers of them."""

    latents: np.ndarray  # [M, L] int32
    decoder: np.ndarray  # float32: [3 K] of harmonics, [L, 4] of rotations, [1, 1] of opacities


def cosines(latents: int, numbers: int) -> np.ndarray:  # -> [L, numbers] float32
    """The first rows of the orthonormal discrete cosine transform; zero beyond as many as there are numbers."""
    row, column = np.arange(latents)[:, None], np.arange(numbers)[None]
    basis = np.cos(np.pi * row * (2 * column + 1) / (2 * numbers)) * np.sqrt(2 / numbers)
    basis[0] /= np.sqrt(2)
    basis[numbers:] = 0
    return basis.astype(np.float32)


def decoded(
    means: np.ndarray,  # [M, 3] world units
    log_scales: np.ndarray,  # [M, 3]
    dc: np.ndarray,  # [M, 3]
    codes: Mapping[str, Code],  # rotation, opacity, harmonics (none for degree 0)
    world_offset: Offset,
) -> SplatArrays:
    """The splats of their codes."""
    count, numbers = len(means), {name: code.latents.astype(np.float32) for name, code in codes.items()}
    rest = np.zeros((count, 0, 3), np.float32)
    if "harmonics" in codes:
        scales = codes["harmonics"].decoder
        rest = numbers["harmonics"] @ (cosines(numbers["harmonics"].shape[1], len(scales)) * scales)
    with np.errstate(over="ignore", invalid="ignore"):  # a file may hold any numbers; what opens it looks
        quaternions = numbers["rotation"] @ codes["rotation"].decoder
        opacity_logits = (numbers["opacity"] @ codes["opacity"].decoder)[:, 0]
    quaternions[~quaternions.any(1), 0] = 1  # no rotation where all latents are zero
    return SplatArrays(
        means, log_scales, quaternions, opacity_logits, dc, rest.reshape(count, -1, 3), world_offset
    )


def latent_content(
    raw: Mapping[str, np.ndarray],  # means, log_scales, dc, [M, 3] float32
    codes: Mapping[str, Code],
    degree: int,
    world_offset: Offset,
    background: tuple[float, float, float],
    device: "Device",
) -> Content:
    """What a file will hold. As published, nothing but the integers is compressed."""
    facts: dict[str, Any] = {"degree": degree, "offset": list(world_offset)}
    arrays = dict(raw)
    for name, code in codes.items():
        facts[f"{name}_latents"] = code.latents.shape[1]
        arrays[f"{name}.decoder"] = code.decoder
        arrays |= packed_symbols(name, code.latents.reshape(-1))
    return Content(Packed("eagles", facts, arrays), background, opened, ("raw",), device)


def opened(packed: Packed, device: "Device", background: tuple[float, float, float]) -> SplatModel:
    """Inverse of `latent_content`. Raises SplatFileError."""
    means = packed.array("means", np.float32, (None, 3))
    count = len(means)
    harmonics = harmonics_above_dc(packed.whole_number("degree", 0, MAX_DEGREE))
    codes = {
        "rotation": _code(packed, "rotation", count, (None, 4)),
        "opacity": _code(packed, "opacity", count, (1, 1)),
    }
    if harmonics:
        codes["harmonics"] = _code(packed, "harmonics", count, (3 * harmonics,))
    log_scales = packed.array("log_scales", np.float32, (count, 3))
    dc = packed.array("dc", np.float32, (count, 3))
    arrays = decoded(means, log_scales, dc, codes, stored_place(packed))
    return splat_model(packed, arrays, device, background)


def _code(packed: Packed, name: str, count: int, decoder: tuple[int | None, ...]) -> Code:
    """Raises SplatFileError."""
    latents = packed.whole_number(f"{name}_latents", 1, MOST_LATENTS)
    shape = (latents, *decoder[1:]) if len(decoder) > 1 else decoder
    weights = packed.array(f"{name}.decoder", np.float32, shape)
    return Code(unpacked_symbols(packed, name, count * latents).reshape(count, latents), weights)
