"""Inter-primitive prediction (CompGS Sec. 3.2): anchors and residuals in, Gaussians out.

`f` reference embedding of an anchor, `g_k` residual embedding of a coupled primitive, `v` view embedding of an anchor
(unit direction from the camera, distance). The four networks of the paper,

    t_k = phi(f, g_k)    S_k = psi(f, g_k), R_k = varphi(f, g_k)    alpha_k = kappa(v, f, g_k)    c_k = zeta(v, f, g_k)

are either separate, or paired into one for geometry and one for appearance, which halves weights and time.
Opacity is predicted first: a coupled primitive that is not seen needs nothing else.
"""

import contextlib
import functools
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from compgs.cameras import Camera
from compgs.gaussians import Gaussians
from compgs.model.fused import PairedPrediction
from compgs.model.layers import ResidualMLP
from compgs.model.primitives import Primitives
from compgs.numerics.linear import Reader

# Name, in a file, of the residual embeddings [K, residual_dim] that all anchors share where none has its own.
SHARED_RESIDUALS = "residuals"
VIEW_DIM = 4  # unit direction (3) and distance (1)
OPACITY_CUTOFF = 1.0 / 255.0  # a splat below it touches no pixel in any rasterizer
OPACITY_BIAS = 0.15  # where opacity starts at or below zero no gradient flows


class PredictionHeads(nn.Module):
    """The prediction networks. `layout` is "separate" (four networks, the paper) or "paired" (two)."""

    def __init__(self, reference_dim: int, residual_dim: int, width: int, layout: str) -> None:
        super().__init__()
        self.layout = layout
        seen = reference_dim + VIEW_DIM
        if layout == "paired":
            self.geometry = ResidualMLP(reference_dim, residual_dim, 10, width, blocks=1)
            self.appearance = ResidualMLP(seen, residual_dim, 4, width, blocks=1)
        else:
            self.translation = ResidualMLP(reference_dim, residual_dim, 3, width, blocks=1)
            self.covariance = ResidualMLP(reference_dim, residual_dim, 7, width, blocks=1)
            self.opacity = ResidualMLP(seen, residual_dim, 1, width, blocks=1)
            self.color = ResidualMLP(seen, residual_dim, 3, width, blocks=2)
        with torch.no_grad():
            opacity = self.appearance if layout == "paired" else self.opacity
            opacity.output_bias[0] = OPACITY_BIAS

    @torch.no_grad()
    def pass_colors(self, mean: Tensor) -> None:
        """The first three reference channels, plus `mean` [3], are the colors' logits, before anything is learned."""
        network, first = (self.appearance, 1) if self.layout == "paired" else (self.color, 0)
        network.skip_weight[:3] = 0
        network.skip_weight[:3, first : first + 3] = torch.eye(3)
        network.output_bias[first : first + 3] = mean

    def readers(self, reference_step: float) -> Iterator[Reader]:
        """The layers that take the references."""
        for network in self.networks():
            yield Reader(network.input_weight, network.input_bias, 0, 0, reference_step)
            yield Reader(network.skip_weight, network.output_bias, 0, 0, reference_step)

    def networks(self) -> Iterator[ResidualMLP]:
        for network in self.children():
            assert isinstance(network, ResidualMLP)
            yield network

    def forward(self, kind: str, *args: Any) -> Any:
        """`predict_appearance`, `predict_color` and so on, by name, so that torch.func.functional_call reaches them."""
        return getattr(self, f"predict_{kind}")(*args)

    def predict_appearance(self, anchors: Tensor, residuals: Tensor, index: Tensor) -> Tensor:
        """Of all coupled primitives: [P, 4] raw opacity and color (paired), or [P, 1] raw opacity (separate)."""
        return (self.appearance if self.layout == "paired" else self.opacity)(anchors, residuals, index)

    def predict_color(self, anchors: Tensor, residuals: Tensor, index: Tensor) -> Tensor:
        """Of visible coupled primitives: [M, 3] raw color (separate only)."""
        return self.color(anchors, residuals, index)

    def predict_geometry(self, anchors: Tensor, residuals: Tensor, index: Tensor) -> Tensor:
        """Of visible coupled primitives: [M, 10] translation, scaling, quaternion."""
        if self.layout == "paired":
            return self.geometry(anchors, residuals, index)
        translation = self.translation(anchors, residuals, index)
        return torch.cat([translation, self.covariance(anchors, residuals, index)], 1)

    def predict_drawn(self, seen: Tensor, primitives: Primitives) -> tuple[Tensor, ...]:
        """What `PairedPrediction` returns (paired only, on the CPU in float32). seen: [N, reference_dim + VIEW_DIM]"""
        p = primitives
        appearance, appearance_weights = self.appearance.begin(seen)
        geometry, geometry_weights = self.geometry.begin(p.references)
        return PairedPrediction.apply(
            appearance, geometry, p.residuals, p.log_scales, p.positions, p.anchor_index, p.voxel_size,
            OPACITY_CUTOFF, *appearance_weights, *geometry_weights,
        )  # fmt: skip


@dataclass(frozen=True)
class Prediction:
    """Gaussians of one view, and where they come from."""

    gaussians: Gaussians  # M primitives
    index: Tensor  # [M] int64, ascending: which coupled primitives (of P) they are
    opacities: Tensor  # [P] of all coupled primitives; not above 0: not drawn
    drawn: Tensor | None = None  # [M] bool: those that are drawn, of opacity above 0; None: all M


@functools.lru_cache(maxsize=4096)
def camera_center(camera: Camera, device: torch.device) -> Tensor:
    """[3] float32, world units; kept, as a copy to a GPU waits for it to finish its work."""
    return torch.tensor(camera.center, dtype=torch.float32, device=device)


def view_embedding(positions: Tensor, camera_center: Tensor, distance_unit: float) -> Tensor:
    """[N, 4]: unit direction from the camera to the anchor, and distance in `distance_unit` world units (Sec. 3.2)."""
    offset = positions - camera_center
    distance = offset.norm(dim=1, keepdim=True)
    return torch.cat([offset / distance.clamp_min(1e-12), distance / distance_unit], 1)


def affine_transform(
    raw: Tensor,  # [M, 10] output of the geometry network
    positions: Tensor,  # [M, 3] of the anchors, world units
    offset_scales: Tensor,  # [M, 3] world units
    sizes: Tensor,  # [M, 3] world units
) -> tuple[Tensor, Tensor, Tensor]:
    """Means, scales [M, 3] and quaternions [M, 4] of coupled primitives (Eq. 2 and 4).

    mean_k = mean + t_k * offset_scale, covariance_k = R_k S_k Sigma S_k R_k^T with Sigma = diag(sizes)^2 and
    0 < S_k < 1. As printed, S_k R_k Sigma is not symmetric and so no covariance: docs/paper_map.md.
    """
    means = positions + raw[:, :3] * offset_scales
    scales = torch.sigmoid(raw[:, 3:6]) * sizes
    # An identity offset keeps the norm away from zero, where the direction has no gradient.
    return means, scales, torch.cat([raw[:, 6:7] + 1.0, raw[:, 7:10]], 1)


def choosing_pays(device: torch.device) -> bool:
    """Whether to leave out primitives that are not drawn: not where their number must first come from a GPU."""
    return device.type != "cuda"


def appearance_precision(
    device: torch.device, dtype: torch.dtype
) -> contextlib.AbstractContextManager[object]:
    """Within it, the networks of opacity and color compute in `dtype` (float32: as always)."""
    if dtype == torch.float32:
        return contextlib.nullcontext()
    return torch.autocast(device.type, dtype=dtype, cache_enabled=False)


def predict(
    heads: PredictionHeads,
    primitives: Primitives,
    camera_center: Tensor,  # [3] world units
    distance_unit: float,  # world units
    weights: dict[str, Tensor] | None = None,
    *,
    compact: bool = True,
    appearance_dtype: torch.dtype = torch.float32,
) -> Prediction:
    """Gaussians of all coupled primitives that can be seen from a camera (Sec. 3.2).

    `weights`: other parameter values for the heads (as they will be stored), by name. Not `compact`: all coupled
    primitives, those that are not drawn with opacity 0; the same image and gradients by more arithmetic, but a GPU need
    not be waited for to learn how many there are. `appearance_dtype`: of the networks of opacity and color.
    """

    def heads_with_weights(*args: Any) -> Any:
        return heads(*args) if weights is None else torch.func.functional_call(heads, weights, args)

    def call(kind: str, anchors: Tensor, residuals: Tensor, index: Tensor) -> Tensor:
        dtype = torch.float32 if kind == "geometry" else appearance_dtype
        with appearance_precision(residuals.device, dtype):
            return heads_with_weights(kind, anchors, residuals, index).to(residuals.dtype)

    view = view_embedding(primitives.positions, camera_center, distance_unit)
    seen = torch.cat([primitives.references, view], 1)
    plain = seen.device.type == "cpu" and seen.dtype == appearance_dtype == torch.float32
    if compact and plain and heads.layout == "paired":
        means, scales, quaternions, shown, colors, index, opacities = heads_with_weights(
            "drawn", seen, primitives
        )
        return Prediction(Gaussians(means, quaternions, scales, shown, colors), index, opacities)
    raw = call("appearance", seen, primitives.residuals, primitives.anchor_index)
    opacities = torch.tanh(raw[:, 0])
    if not compact:
        return _predict_all(heads, primitives, call, seen, raw, opacities)
    index = torch.nonzero(opacities.detach() > OPACITY_CUTOFF).view(-1)
    anchor = primitives.anchor_index[index]
    residuals = primitives.residuals.index_select(0, index)
    if heads.layout == "paired":
        color = raw.index_select(0, index)[:, 1:4]
    else:
        color = call("color", seen, residuals, anchor)
    means, scales, quaternions = affine_transform(
        call("geometry", primitives.references, residuals, anchor),
        primitives.positions.index_select(0, anchor),
        primitives.offset_scales.index_select(0, anchor),
        primitives.sizes.index_select(0, anchor),
    )
    gaussians = Gaussians(means, quaternions, scales, opacities.index_select(0, index), torch.sigmoid(color))
    return Prediction(gaussians, index, opacities)


def _predict_all(
    heads: PredictionHeads,
    primitives: Primitives,
    call: Callable[[str, Tensor, Tensor, Tensor], Tensor],
    seen: Tensor,
    raw: Tensor,
    opacities: Tensor,
) -> Prediction:
    """The rest of `predict` where nothing is left out."""
    p, anchor = primitives, primitives.anchor_index
    drawn = opacities.detach() > OPACITY_CUTOFF
    color = raw[:, 1:4] if heads.layout == "paired" else call("color", seen, p.residuals, anchor)
    means, scales, quaternions = affine_transform(
        call("geometry", p.references, p.residuals, anchor),
        p.positions.index_select(0, anchor),
        p.offset_scales.index_select(0, anchor),
        p.sizes.index_select(0, anchor),
    )
    shown = torch.where(drawn, opacities, torch.zeros_like(opacities))
    gaussians = Gaussians(means, quaternions, scales, shown, torch.sigmoid(color))
    index = torch.arange(len(opacities), device=opacities.device)
    return Prediction(gaussians, index, opacities, drawn)
