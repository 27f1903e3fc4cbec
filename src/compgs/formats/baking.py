"""A neural scene as plain splats: opacity becomes a constant, color spherical harmonics, geometry stays as it is.

What a primitive looks like is known from cameras only, so both are fitted to what the cameras see of it, by least
squares in pixels:

    color(d)  = 1/2 + sum_k Y_k(d) c_k     minimizing  sum_v w_v |color(d_v) - color_v|^2 + penalty on high degrees
    opacity   = sum_v t_v opacity_v / sum_v t_v

v runs over the cameras; w_v is the primitive's share of the image (transmittance x alpha, summed over pixels), and
t_v = w_v / opacity_v what of it the primitives before it let through.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from compgs.cameras import Camera
from compgs.errors import TrainingError
from compgs.gaussians import Gaussians
from compgs.model.hybrid_model import HybridModel
from compgs.model.spherical_harmonics import COLOR_OFFSET, Y0, coefficients, harmonic_basis
from compgs.model.splats import Splats
from compgs.render import RasterSettings, contributions, local_camera, visible_mask

# Opacity that primitives of anchors in view are given to find out what reaches them, where they are not drawn: it must
# be above the rasterizer's cutoff, and hide little. Without it a primitive that is there from one side only is there
# from all sides: 0.3 to 0.8 dB against our own renderings. 0.005 to 0.04 are equally good.
PROBE_OPACITY = 0.008
# Pixels by which a view counts in which a primitive is hidden: its color there is better known than guessed.
HIDDEN_WEIGHT = 0.1
# Of the squared coefficients of degree l, times l^2 and the views' weight. A hundred times more costs 1 dB.
PENALTY = 1e-4
MAX_OPACITY = 0.999  # the rasterizer draws nothing more opaque
CUTOFF = 1 / 255  # opacity below which nothing is drawn
BLOCK = 1 << 16  # primitives solved at once


@dataclass(frozen=True, eq=False)
class Baked:
    """Splats in the model's local frame, and how much of the cameras' images each of them is."""

    splats: Splats
    importance: Tensor  # [M] pixels, summed over the cameras

    def rows(self, index: Tensor) -> "Baked":
        return Baked(self.splats.rows(index), self.importance.index_select(0, index))

    def most_important(self, count: int) -> "Baked":
        """As many splats as asked for, in the order in which they were."""
        if count >= len(self.importance):
            return self
        return self.rows(self.importance.topk(count).indices.sort().values)


@torch.no_grad()
def bake(
    model: HybridModel,
    cameras: Sequence[Camera],  # of the world
    degree: int = 3,
    progress: Callable[[], None] | None = None,  # called after each camera
) -> Baked:
    """Splats that look like the model from the cameras. Primitives that no camera sees are dropped.

    The cameras should surround what they see and be many more than coefficients: of twelve, pictures between them lose
    2.5 dB against 96. Memory: 1.2 kB a primitive at degree 3. Raises TrainingError if there is nothing to be seen.
    """
    sums = _Sums.zeros(model.coupled, degree, model.primitives.positions.device)
    settings = RasterSettings(background=model.background)
    for camera in cameras:
        _add_view(sums, model, local_camera(model, camera), settings)
        if progress:
            progress()
    opacities = (sums.opacity / sums.reaching.clamp_min(1e-12)).clamp(0, MAX_OPACITY)
    kept = torch.nonzero((sums.weight > 0) & (opacities > CUTOFF)).view(-1)
    if not len(kept):
        raise TrainingError(f"none of {model.coupled} primitives is seen from {len(cameras)} cameras")
    means, scales, quaternions = (array.index_select(0, kept) for array in model.geometry)
    harmonics = torch.cat([_solved(sums, rows, degree) for rows in kept.split(BLOCK)])
    splats = Splats(
        means=means,
        log_scales=scales.log(),
        quaternions=quaternions,
        opacity_logits=torch.logit(opacities[kept]),
        dc=harmonics[:, 0].contiguous(),
        rest=harmonics[:, 1:].contiguous(),
    )
    return Baked(splats, sums.importance[kept])


@dataclass(frozen=True, eq=False)
class _Sums:
    """What is added up over cameras, for each of P primitives."""

    normal: Tensor  # [P, K, K] w Y Y^T
    colors: Tensor  # [P, K, 3] w Y (color - 1/2)
    weight: Tensor  # [P] w, with that of hidden views
    importance: Tensor  # [P] w, pixels
    opacity: Tensor  # [P] t x opacity
    reaching: Tensor  # [P] t

    @staticmethod
    def zeros(count: int, degree: int, device: torch.device) -> "_Sums":
        k = coefficients(degree)
        shapes = (count, k, k), (count, k, 3), (count,), (count,), (count,), (count,)
        return _Sums(*(torch.zeros(shape, device=device) for shape in shapes))


def _add_view(sums: _Sums, model: HybridModel, camera: Camera, settings: RasterSettings) -> None:
    """Of a camera of the model's frame."""
    visible = visible_mask(*model.bounds, camera, settings)
    gaussians, drawn = model.drawn(camera, visible)
    shown = gaussians.opacities > CUTOFF  # on a GPU those are there, too, that are not
    gaussians = Gaussians(*(value[shown] for value in vars(gaussians).values()))
    drawn = drawn[shown]
    _add_opacities(sums, model, camera, settings, visible, gaussians, drawn)
    share = contributions(gaussians, camera, settings)
    sums.importance.index_add_(0, drawn, share)
    weight = share + HIDDEN_WEIGHT
    center = torch.as_tensor(camera.center, dtype=gaussians.means.dtype, device=gaussians.means.device)
    directions = torch.nn.functional.normalize(gaussians.means - center, dim=1)
    degree = round(sums.normal.shape[1] ** 0.5) - 1
    for rows in torch.arange(len(drawn), device=drawn.device).split(BLOCK):
        basis = harmonic_basis(directions[rows], degree)
        weighted = weight[rows, None] * basis
        sums.normal.index_add_(0, drawn[rows], weighted[:, :, None] * basis[:, None])
        offsets = gaussians.colors[rows] - COLOR_OFFSET
        sums.colors.index_add_(0, drawn[rows], weighted[:, :, None] * offsets[:, None])
    sums.weight.index_add_(0, drawn, weight)


def _add_opacities(
    sums: _Sums,
    model: HybridModel,
    camera: Camera,
    settings: RasterSettings,
    visible: Tensor,  # [N] bool, anchors
    gaussians: Gaussians,
    drawn: Tensor,  # [M] int64, which primitives they are
) -> None:
    """Of all primitives of the anchors in view: those that are not drawn have opacity 0, and count with it."""
    rows = torch.nonzero(visible[model.primitives.anchor_index]).view(-1)
    opacities = torch.zeros_like(sums.opacity)
    opacities[drawn] = gaussians.opacities
    means, scales, quaternions = (array.index_select(0, rows) for array in model.geometry)
    probes = opacities[rows].clamp_min(PROBE_OPACITY)
    share = contributions(
        Gaussians(means, quaternions, scales, probes, torch.zeros_like(means)), camera, settings
    )
    # Of a Gaussian, what lies above the cutoff is 1 - cutoff / opacity: the rest is not in the share.
    reaching = share / (probes - CUTOFF)
    sums.reaching.index_add_(0, rows, reaching)
    sums.opacity.index_add_(0, rows, reaching * opacities[rows])


def _solved(sums: _Sums, rows: Tensor, degree: int) -> Tensor:
    """[m, K, 3] coefficients of some primitives."""
    weight = sums.weight[rows, None, None].double()
    degrees = torch.tensor([float(l) for l in range(degree + 1) for _ in range(2 * l + 1)])
    # Degree 0 is determined wherever there is a view; its share keeps the matrix from being singular to rounding.
    penalty = torch.diag(PENALTY * degrees**2 + 1e-9 * Y0**2).to(weight)
    normal = sums.normal[rows].double() / weight + penalty
    return torch.linalg.solve(normal, sums.colors[rows].double() / weight).float()
