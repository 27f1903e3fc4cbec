"""Inter-primitive prediction (CompGS Sec. 3.2): anchors and residuals in, Gaussians out. The readable version.

`f` reference embedding of an anchor, `g_k` residual embedding of a coupled primitive, `v` view embedding of an anchor
(unit direction from the camera, distance); networks give translation `t_k`, scaling `S_k`, rotation, `alpha_k`, `c_k`:

    mean_k = mean + reach t_k    scales_k = size sigmoid(S_k)    opacity_k = tanh(alpha_k)    color_k = sigmoid(c_k)

Opacity is predicted first: a coupled primitive that is not seen needs nothing else. The networks are in `heads.py`.
Everything runs on any device, in any precision, with gradients; on the CPU in float32 its twin is
`model/prediction_kernels.py`, for training through `autograd.py` and for rendering through `model/inference.py`.
"""

import contextlib
import functools
from abc import abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from compgs.cameras import Camera
from compgs.gaussians import Gaussians
from compgs.model.constants import CUTOFF_SIGMAS, OPACITY_CUTOFF, SMALLEST_DISTANCE
from compgs.tensors.primitives import Primitives


@dataclass(frozen=True)
class Prediction:
    """Gaussians of one view, and where they come from."""

    gaussians: Gaussians  # M primitives
    index: Tensor  # [M] int64, ascending: which coupled primitives (of P) they are
    opacities: Tensor  # [P] of all coupled primitives; not above 0: not drawn
    drawn: Tensor | None = None  # [M] bool: those that are drawn, of opacity above 0; None: all M


@dataclass(frozen=True)
class Geometry:
    """Holds the geometry of all P coupled primitives, drawn or not: what is the same from everywhere."""

    means: Tensor  # [P, 3] world units
    scales: Tensor  # [P, 3] standard deviations, world units
    quaternions: Tensor  # [P, 4]

    def tensors(self) -> tuple[Tensor, Tensor, Tensor]:
        """Means, scales and quaternions."""
        return self.means, self.scales, self.quaternions

    def cut(self) -> "Geometry":
        """The same as leaves of another graph: gradients of what is made of them end there."""
        return Geometry(*(tensor.detach().requires_grad_() for tensor in self.tensors()))

    def of(self, rows: Tensor | None) -> "Geometry":
        """Return the rows [M] int64, each of them once; None: all of them."""
        return self if rows is None else Geometry(*(_Rows.apply(tensor, rows) for tensor in self.tensors()))


class _Rows(torch.autograd.Function):
    """`index_select` of rows that come once each: its gradient is copied, not summed by one thread."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, rows: Tensor) -> Tensor:
        ctx.save_for_backward(rows)
        ctx.count = len(x)
        return x.index_select(0, rows)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, None]:
        (rows,) = ctx.saved_tensors
        result = grads[0].new_zeros(ctx.count, *grads[0].shape[1:])
        result[rows] = grads[0]
        return result, None


@functools.lru_cache(maxsize=4096)
def camera_center(camera: Camera, device: torch.device, dtype: torch.dtype = torch.float32) -> Tensor:
    """[3] world units; kept, as a copy to a GPU waits for it to finish its work."""
    return torch.tensor(camera.center, dtype=dtype, device=device)


# the equations ---------------------------------------------------------------------------------


def view_embedding(
    positions: Tensor,  # [N, 3] of anchors, world units
    camera_center: Tensor,  # [3] world units
    distance_unit: float,  # world units
) -> Tensor:  # [N, 4]
    """Unit direction from the camera to the anchor, and distance in `distance_unit` (Sec. 3.2)."""
    offset = positions - camera_center
    distance = offset.norm(dim=1, keepdim=True)
    return torch.cat([offset / distance.clamp_min(SMALLEST_DISTANCE), distance / distance_unit], 1)


def see(
    references: Tensor,  # [N, reference_dim] of anchors
    positions: Tensor,  # [N, 3] of the same, world units
    camera_center: Tensor,  # [3] world units
    distance_unit: float,  # world units
) -> Tensor:  # [N, reference_dim + 4]
    """What the networks of opacity and color take of an anchor: reference embedding, then view embedding."""
    return torch.cat([references, view_embedding(positions, camera_center, distance_unit)], 1)


def opacity_activation(raw: Tensor) -> Tensor:
    """[P, 1 or more] raw numbers of which opacity is the first -> [P] opacities, -1 to 1."""
    return torch.tanh(raw[:, 0])


def color_activation(raw: Tensor) -> Tensor:
    """[M, 3] raw -> [M, 3] display RGB, 0 to 1."""
    return torch.sigmoid(raw)


def is_drawn(opacities: Tensor) -> Tensor:
    """[P] -> [P] bool: whether a primitive reaches the renderer."""
    return opacities.detach() > OPACITY_CUTOFF


def affine_transform(
    raw: Tensor,  # [M, 10] output of the geometry network: translation, scaling, quaternion
    positions: Tensor,  # [M, 3] of the anchors, world units
    reach: Tensor,  # [M, 3] of the anchors: world units per unit of a translation
    sizes: Tensor,  # [M, 3] of the anchors: standard deviations, world units
) -> tuple[Tensor, Tensor, Tensor]:
    """Means, scales [M, 3] and quaternions [M, 4] of coupled primitives (Eq. 2 and 4).

    mean_k = mean + t_k * reach, covariance_k = R_k S_k Sigma S_k R_k^T with Sigma = diag(sizes)^2 and
    0 < S_k < 1. As printed, S_k R_k Sigma is not symmetric and so no covariance: docs/paper_map.md.
    """
    means = positions + raw[:, :3] * reach
    scales = torch.sigmoid(raw[:, 3:6]) * sizes
    # An identity offset keeps the norm away from zero, where the direction has no gradient.
    return means, scales, torch.cat([raw[:, 6:7] + 1.0, raw[:, 7:10]], 1)


def drawn_reach(
    offsets: Tensor,  # [..., 3] of coupled primitives from their anchors, world units
    scales: Tensor,  # [..., 3] standard deviations, world units
) -> Tensor:  # [...]
    """World units: how far from its anchor a coupled primitive is drawn. `HybridModel` culls by it, too."""
    return offsets.norm(dim=-1) + CUTOFF_SIGMAS * scales.amax(-1)


class Heads(nn.Module):
    """The networks that a prediction asks (`tensors/heads.py`).

    `f` [A, reference_dim] are references of anchors, `seen` [A, reference_dim + 4] references and view embeddings,
    `index` [M] int64, ascending, rows of these for each coupled primitive.
    """

    @abstractmethod
    def raw_geometry(self, f: Tensor, residuals: Tensor, index: Tensor) -> Tensor:
        """[M, 10] translation, scaling, quaternion."""

    @abstractmethod
    def raw_appearance(self, seen: Tensor, residuals: Tensor, index: Tensor) -> Tensor:
        """[M, 1 or more]: opacity, and after it what the same network says of color, if it says anything."""

    @abstractmethod
    def raw_color(
        self, raw: Tensor, chosen: Tensor | None, seen: Tensor, residuals: Tensor, index: Tensor
    ) -> Tensor:
        """[M, 3] color of the `chosen` [M] int64 rows of `raw_appearance` (None: of all), whose residuals [M, G] and
        index [M] are given.
        """

    def predict_drawn(
        self, primitives: Primitives, seen: Tensor, appearance_dtype: torch.dtype = torch.float32
    ) -> Prediction:
        """The coupled primitives that are drawn, by the fastest means there are."""
        return predict_by_torch(self, primitives, seen, appearance_dtype)

    def forward(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """function(heads, *arguments): by way of torch.func.functional_call, with other weights in the heads."""
        return function(self, *arguments)


# put together ---------------------------------------------------------------------------------


def predict(
    heads: Heads,
    primitives: Primitives,
    camera_center: Tensor,  # [3] world units
    distance_unit: float,  # world units
    weights: dict[str, Tensor] | None = None,
    *,
    compact: bool = True,
    appearance_dtype: torch.dtype = torch.float32,
    geometry: Geometry | None = None,
) -> Prediction:
    """Gaussians of all coupled primitives that can be seen from a camera (Sec. 3.2).

    `weights`: other parameter values for the heads (as they will be stored), by name. Not `compact`: all coupled
    primitives, those that are not drawn with opacity 0; the same image and gradients by more arithmetic, but a GPU need
    not be waited for to learn how many there are. `appearance_dtype`: of the networks of opacity and color.
    `geometry`: of these primitives, where several views share it.
    """
    seen = see(primitives.references, primitives.positions, camera_center, distance_unit)
    function: Callable[..., Prediction] = _drawn if compact else _all
    if geometry is not None:
        function = functools.partial(predict_by_torch, compact=compact, geometry=geometry)
    if weights is None:
        return function(heads, primitives, seen, appearance_dtype)
    arguments = function, primitives, seen, appearance_dtype
    prediction: Prediction = torch.func.functional_call(heads, weights, arguments)
    return prediction


def _drawn(heads: Heads, primitives: Primitives, seen: Tensor, appearance_dtype: torch.dtype) -> Prediction:
    """What is drawn, by the fastest means that the heads have."""
    return heads.predict_drawn(primitives, seen, appearance_dtype)


def _all(heads: Heads, primitives: Primitives, seen: Tensor, appearance_dtype: torch.dtype) -> Prediction:
    """All, drawn or not."""
    return predict_by_torch(heads, primitives, seen, appearance_dtype, compact=False)


def predict_by_torch(
    heads: Heads,
    primitives: Primitives,
    seen: Tensor,  # [N, reference_dim + 4]: references and view embeddings
    appearance_dtype: torch.dtype = torch.float32,
    *,
    compact: bool = True,
    geometry: Geometry | None = None,
) -> Prediction:
    """`predict` by the heads as they are, in plain torch (the networks alone run in kernels where they can)."""
    p = primitives
    a = predict_appearance(heads, seen, p.residuals, p.anchor_index, dtype=appearance_dtype, compact=compact)
    if geometry is None:
        means, scales, quaternions = predict_geometry(heads, p, a.residuals, a.anchor)
    else:
        means, scales, quaternions = geometry.of(a.index).tensors()
    gaussians = Gaussians(means, quaternions, scales, a.opacities, a.colors)
    if a.index is not None:
        return Prediction(gaussians, a.index, a.all_opacities)
    index = torch.arange(len(a.opacities), device=seen.device)
    return Prediction(gaussians, index, a.all_opacities, is_drawn(a.all_opacities))


@dataclass(frozen=True)
class Appearance:
    """Opacity and color of M of P coupled primitives, and the inputs from which their geometry is predicted."""

    all_opacities: Tensor  # [P]
    index: Tensor | None  # [M] int64, ascending: those that are drawn; None: all
    opacities: Tensor  # [M]; 0: not drawn
    colors: Tensor  # [M, 3] display RGB
    residuals: Tensor  # [M, residual_dim]
    anchor: Tensor  # [M] int64, ascending


def predict_appearance(
    heads: Heads,
    seen: Tensor,  # [A, reference_dim + 4]: references and view embeddings of anchors
    residuals: Tensor,  # [P, residual_dim]
    anchor_index: Tensor,  # [P] int64, ascending: rows of `seen`
    *,
    dtype: torch.dtype,  # in which the networks compute
    compact: bool,
) -> Appearance:
    """Opacity of all, color of those that are drawn; not `compact`: color of all, and no value decides a shape."""
    with appearance_precision(residuals.device, dtype):
        raw = heads.raw_appearance(seen, residuals, anchor_index).to(residuals.dtype)
    opacities = all_opacities = opacity_activation(raw)
    index, anchor = None, anchor_index
    if compact:
        index = torch.nonzero(is_drawn(opacities)).view(-1)
        opacities, anchor = opacities.index_select(0, index), anchor_index.index_select(0, index)
        residuals = residuals.index_select(0, index)
    else:
        opacities = torch.where(is_drawn(opacities), opacities, torch.zeros_like(opacities))
    with appearance_precision(residuals.device, dtype):
        color = heads.raw_color(raw, index, seen, residuals, anchor).to(residuals.dtype)
    return Appearance(all_opacities, index, opacities, color_activation(color), residuals, anchor)


def predict_geometry(
    heads: Heads,
    primitives: Primitives,
    residuals: Tensor,  # [M, residual_dim]
    anchor: Tensor,  # [M] int64, ascending: rows of `primitives`
) -> tuple[Tensor, Tensor, Tensor]:
    """Means, scales [M, 3] and quaternions [M, 4] of coupled primitives, world units."""
    p = primitives
    return affine_transform(
        heads.raw_geometry(p.references, residuals, anchor),
        p.positions.index_select(0, anchor),
        p.reach.index_select(0, anchor),
        p.sizes.index_select(0, anchor),
    )


def geometry_of_all(heads: Heads, primitives: Primitives) -> Geometry:
    """Predict the geometry of all coupled primitives."""
    return Geometry(*predict_geometry(heads, primitives, primitives.residuals, primitives.anchor_index))


# where it runs ---------------------------------------------------------------------------------


def appearance_precision(
    device: torch.device, dtype: torch.dtype
) -> contextlib.AbstractContextManager[object]:
    """Within it, the networks of opacity and color compute in `dtype` (float32: as always)."""
    if dtype == torch.float32:
        return contextlib.nullcontext()
    return torch.autocast(device.type, dtype=dtype, cache_enabled=False)
