"""What a file holds, as integers: between the trained model (floats, torch) and the bytes.

"Q12" is fixed point with 12 fractional bits. A latent is in units of its quantization step; a symbol is the
whole number of steps between a latent and the mean that the entropy networks predict for it. Rows are
anchors.

    z_f ─► reference network ─► mean, scale of f;   f_hat = q_f + mean          (CompGS Sec. 3.3, Fig. 4)
    f_hat ─► covariance network ─► mean, scale of c;   c_hat = q_c + mean
    z_g, f_hat ─► residual network ─► mean, scale of g;   g_hat = q_g + mean
"""

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numba import njit, prange

from compgs.codec.integer_network import FRACTION_BITS, IntegerNetwork, entropy_parameters, first_rows
from compgs.codec.rans import escape_bits
from compgs.codec.tables import FrequencyTables, HyperTable, channel_tables, gaussian_tables
from compgs.codec.weights import QuantizedTensor

COVARIANCE_DIM = 6  # log scales of an anchor
STREAMS = ("reference_hyper", "reference", "covariance", "residual_hyper", "residual")  # in decoding order


@dataclass(frozen=True)
class Dimensions:
    """Channels of everything."""

    coupled_primitives: int = 10  # K, slots per anchor; the mask says which exist
    reference_dim: int = 32
    residual_dim: int = 8
    reference_hyper_dim: int = 4
    residual_hyper_dim: int = 10
    heads: Literal["separate", "paired"] = "paired"  # layout of the prediction networks
    width: int = 32  # hidden width of the prediction networks

    def network_sizes(self) -> dict[str, tuple[int, int]]:
        """(inputs, outputs) of each entropy network; the outputs are means and scales."""
        residuals = self.coupled_primitives * self.residual_dim
        return {
            "reference": (self.reference_hyper_dim, 2 * self.reference_dim),
            "covariance": (self.reference_dim, 2 * COVARIANCE_DIM),
            "residual": (self.residual_hyper_dim + self.reference_dim, 2 * residuals),
        }

    def symbols_per_anchor(self) -> int:
        """With all coupled primitives."""
        hyper = self.reference_hyper_dim + self.residual_hyper_dim
        return hyper + self.reference_dim + COVARIANCE_DIM + self.coupled_primitives * self.residual_dim


@dataclass(frozen=True)
class FileContent:
    """N anchors with up to K coupled primitives each, and all that is needed to render them."""

    dimensions: Dimensions
    voxel_size: float  # world units between neighbouring coordinates
    view_distance_scale: float  # world units: unit of the view embedding's distance
    background: tuple[float, float, float]  # color behind everything; float32
    reference_step: float  # quantization steps; float32
    residual_step: float
    covariance_step: float  # of log scales
    coordinates: np.ndarray  # [N, 3] int32 voxels
    mask: np.ndarray  # [N, K] bool: which coupled primitives exist
    reference_hyper: np.ndarray  # [N, reference_hyper_dim] int32 symbols
    reference: np.ndarray  # [N, reference_dim] int32 symbols
    covariance: np.ndarray  # [N, 6] int32 symbols
    residual_hyper: np.ndarray  # [N, residual_hyper_dim] int32 symbols
    residual: np.ndarray  # [N, K, residual_dim] int32 symbols, zero where the mask is False
    reference_hyper_tables: tuple[HyperTable, ...]  # one a channel
    residual_hyper_tables: tuple[HyperTable, ...]
    networks: dict[str, IntegerNetwork]  # "reference", "covariance", "residual"
    heads: tuple[tuple[str, QuantizedTensor], ...]  # prediction networks' parameters by name
    metadata: dict[str, str] = field(default_factory=dict)  # for people; no decoder depends on it


@dataclass(frozen=True)
class Latents:
    """Dequantized latents, Q12, in units of their quantization step."""

    reference: np.ndarray  # [N, reference_dim] int32
    covariance: np.ndarray  # [N, 6] int32
    residual: np.ndarray  # [P, residual_dim] int32: the P coupled primitives that exist, anchor by anchor


def fixed_point(symbols: np.ndarray) -> np.ndarray:  # int32, Q12
    """Hyperprior symbols as the networks take them. Below 2^18, which the format asserts, they fit into 32
    bits.
    """
    return symbols << FRACTION_BITS


def reconstruct(symbols: np.ndarray, means: np.ndarray) -> np.ndarray:  # int32, Q12
    """Latents from symbols and means (same shape, Q12); they take the means' place."""
    _add_steps(symbols.reshape(-1), means.reshape(-1))
    return means


def residual_context(residual_hyper: np.ndarray, reference_latents: np.ndarray) -> np.ndarray:
    """[N, residual_hyper_dim + reference_dim] Q12 input of the residual network."""
    return np.concatenate([fixed_point(residual_hyper), reference_latents], 1)


def gather_existing(slots: np.ndarray, mask: np.ndarray) -> np.ndarray:  # [P, D]
    """Of [N, K, D], the coupled primitives that exist [N, K], anchor by anchor."""
    rows = first_rows(mask)
    out = np.empty((int(rows[-1]), slots.shape[2]), np.int32)
    _move_rows(slots, out, mask, rows, True)
    return out


def scatter_existing(existing: np.ndarray, mask: np.ndarray) -> np.ndarray:  # [N, K, D]
    """Inverse of `gather_existing`; zero where nothing exists."""
    slots = np.empty((*mask.shape, existing.shape[1]), np.int32)
    _move_rows(slots, existing, mask, first_rows(mask), False)
    return slots


@njit(cache=True, parallel=True)
def _add_steps(symbols, means):
    for i in prange(len(symbols)):
        means[i] += symbols[i] << FRACTION_BITS


@njit(cache=True, parallel=True)
def _move_rows(slots, existing, mask, rows, gather):
    for n in prange(len(mask)):
        row = rows[n]
        for k in range(mask.shape[1]):
            if not mask[n, k]:
                if not gather:
                    slots[n, k, :] = 0
                continue
            for c in range(slots.shape[2]):
                if gather:
                    existing[row, c] = slots[n, k, c]
                else:
                    slots[n, k, c] = existing[row, c]
            row += 1


def channel_index(anchors: int, channels: int) -> np.ndarray:  # [N, C] uint8
    """A hyperprior's tables: one a channel."""
    return np.tile(np.arange(channels, dtype=np.uint8), (anchors, 1))


def dequantize(content: FileContent) -> Latents:
    """Latents of all anchors, exactly as any other decoder gets them."""
    means, _ = entropy_parameters(content.networks["reference"], fixed_point(content.reference_hyper))
    reference = reconstruct(content.reference, means)
    means, _ = entropy_parameters(content.networks["covariance"], reference)
    covariance = reconstruct(content.covariance, means)
    context = residual_context(content.residual_hyper, reference)
    means, _ = entropy_parameters(content.networks["residual"], context, content.mask)
    residual = reconstruct(gather_existing(content.residual, content.mask), means)
    return Latents(reference, covariance, residual)


def cross_entropy_bits(content: FileContent) -> dict[str, float]:
    """Code length of each stream under the file's own integer tables, escapes included: what a perfect coder
    needs.
    """
    gaussian = gaussian_tables()
    anchors = len(content.coordinates)
    result = {}

    def add(name: str, symbols: np.ndarray, index: np.ndarray, tables: FrequencyTables) -> None:
        result[name] = float(sum(escape_bits(symbols.ravel(), index.ravel(), tables)))

    for name in ("reference_hyper", "residual_hyper"):
        tables = getattr(content, f"{name}_tables")
        add(name, getattr(content, name), channel_index(anchors, len(tables)), channel_tables(tables))
    means, index = entropy_parameters(content.networks["reference"], fixed_point(content.reference_hyper))
    add("reference", content.reference, index, gaussian)
    reference = reconstruct(content.reference, means)
    add(
        "covariance",
        content.covariance,
        entropy_parameters(content.networks["covariance"], reference)[1],
        gaussian,
    )
    context = residual_context(content.residual_hyper, reference)
    index = entropy_parameters(content.networks["residual"], context, content.mask)[1]
    add("residual", gather_existing(content.residual, content.mask), index, gaussian)
    return {name: result[name] for name in STREAMS}
