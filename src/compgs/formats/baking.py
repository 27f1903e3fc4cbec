"""A neural scene as plain splats: opacity becomes a constant, color spherical harmonics, geometry stays as it is.

What a primitive looks like is known from cameras only, so both are fitted to what the cameras see of it, by least
squares in pixels:

    color(d)  = 1/2 + sum_k Y_k(d) c_k     minimizing  sum_v w_v |color(d_v) - color_v|^2 + penalty on high degrees
    opacity   = sum_v t_v opacity_v / sum_v t_v

v runs over the cameras; w_v is the primitive's share of the image (transmittance x alpha, summed over pixels), and
t_v = w_v / opacity_v what of it the primitives before it let through.

A few cameras do not see everything that a visitor may see. A primitive that they do not see is as the networks say that
it is from where they stand, all of them alike.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from compgs.cameras import Camera
from compgs.errors import TrainingError
from compgs.gaussians import Gaussians
from compgs.model.degrees import coefficients, degree_of
from compgs.model.hybrid_model import HybridModel
from compgs.model.spherical_harmonics import COLOR_OFFSET, Y0, harmonic_basis
from compgs.model.splats import SplatArrays
from compgs.render import RasterSettings, blend_of, contributions, local_camera, settings_of, visible_mask

# Opacity that primitives of anchors in view are given to find out what reaches them, where they are not drawn: it must
# be above the rasterizer's cutoff, and hide little. Without it a primitive that is there from one side only is there
# from all sides: 0.3 to 0.8 dB against our own renderings. 0.005 to 0.04 are equally good.
PROBE_OPACITY = 0.008
# Pixels by which a view counts in which a primitive is hidden: its color there is better known than guessed.
HIDDEN_WEIGHT = 0.1
# Pixels over all cameras, at full transmittance, below which a primitive counts as not seen: what is in no picture of
# the cameras may be the sky of another one.
LEAST_SEEN = 0.5
# Of the squared coefficients of degree l, times l^2 and the views' weight. A hundred times more costs 1 dB.
PENALTY = 1e-4
MAX_OPACITY = 0.999  # the rasterizer draws nothing more opaque
CUTOFF = 1 / 255  # opacity below which nothing is drawn
BLOCK = 1 << 14  # primitives worked on at once


@dataclass(frozen=True, eq=False)
class Baked:
    """Splats in the model's local frame, and how much of the cameras' images each of them is."""

    splats: SplatArrays
    importance: np.ndarray  # [M] pixels, summed over the cameras

    def rows(self, index: np.ndarray) -> "Baked":
        return Baked(self.splats.rows(index), self.importance[index])

    def most_important(self, count: int) -> "Baked":
        """Choose as many splats as asked for, in the order in which they were."""
        if count >= len(self.importance):
            return self
        return self.rows(np.sort(np.argpartition(-self.importance, count)[:count]))


def bake(
    model: HybridModel,
    cameras: Sequence[Camera],  # of the world
    degree: int = 3,
    progress: Callable[[], None] | None = None,  # called after each camera
) -> Baked:
    """Splats that look like the model from the cameras. Primitives that are not drawn are dropped.

    The cameras should surround what they see and be many more than coefficients: of twelve, pictures between them lose
    2.5 dB against 96. Memory: 1.2 kB a primitive at degree 3. Raises TrainingError if there is nothing to be seen.
    """
    sums = _Sums.zeros(model.coupled, degree)
    settings = settings_of(model)
    for camera in cameras:
        _add_view(sums, model, local_camera(model, camera), settings)
        if progress:
            progress()
    if not sums.importance.any():
        raise TrainingError(f"none of {model.coupled} primitives is seen from {len(cameras)} cameras")
    unseen = sums.reaching < LEAST_SEEN
    for camera in cameras if unseen.any() else ():
        _add_unseen(sums, model, local_camera(model, camera), unseen)
    opacities = np.clip(sums.opacity / np.maximum(sums.reaching, np.float32(1e-12)), 0, MAX_OPACITY)
    kept = np.flatnonzero((sums.weight > 0) & (opacities > CUTOFF))
    means, scales, quaternions = (array[kept] for array in model.geometry)
    blocks = np.split(kept, range(BLOCK, len(kept), BLOCK))
    harmonics = np.concatenate([_solved(sums, rows, degree) for rows in blocks])
    shown = opacities[kept].astype(np.float64)
    splats = SplatArrays(
        means=means,
        log_scales=np.log(scales),
        quaternions=quaternions,
        opacity_logits=np.log(shown / (1 - shown)).astype(np.float32),
        dc=np.ascontiguousarray(harmonics[:, 0]),
        rest=np.ascontiguousarray(harmonics[:, 1:]),
        world_offset=model.world_offset,
    )
    return Baked(splats, sums.importance[kept])


@dataclass(frozen=True, eq=False)
class _Sums:
    """What is added up over cameras, for each of P primitives."""

    normal: np.ndarray  # [P, K, K] w Y Y^T
    colors: np.ndarray  # [P, K, 3] w Y (color - 1/2)
    weight: np.ndarray  # [P] w, with that of hidden views
    importance: np.ndarray  # [P] w, pixels
    opacity: np.ndarray  # [P] t x opacity
    reaching: np.ndarray  # [P] t

    @staticmethod
    def zeros(count: int, degree: int) -> "_Sums":
        k = coefficients(degree)
        shapes = (count, k, k), (count, k, 3), (count,), (count,), (count,), (count,)
        return _Sums(*(np.zeros(shape, np.float32) for shape in shapes))


def _add_view(sums: _Sums, model: HybridModel, camera: Camera, settings: RasterSettings) -> None:
    """Add the view of a camera of the model's frame. A primitive is drawn once in a view: sums need not add up repeated
    rows.
    """
    visible = visible_mask(*model.bounds, camera, settings)
    gaussians, drawn = model.drawn(camera, visible)
    # On a GPU those are there, too, that are not drawn.
    gaussians, drawn = _chosen(gaussians, drawn, gaussians.opacities > CUTOFF)
    _add_opacities(sums, model, camera, settings, visible, gaussians, drawn)
    share = contributions(gaussians, camera, settings, blend_of(model))
    sums.importance[drawn] += share
    _add_colors(sums, gaussians, drawn, share + np.float32(HIDDEN_WEIGHT), camera)


def _add_unseen(sums: _Sums, model: HybridModel, camera: Camera, unseen: np.ndarray) -> None:
    """Add what the networks say of the primitives of a mask [P] bool, as if the camera saw a little of each."""
    anchors = np.zeros(model.anchors, bool)
    anchors[model.primitives.anchor_index[unseen]] = True
    gaussians, drawn = model.drawn(camera, anchors)
    gaussians, drawn = _chosen(gaussians, drawn, unseen[drawn] & (gaussians.opacities > CUTOFF))
    sums.reaching[unseen] += np.float32(LEAST_SEEN)
    sums.opacity[drawn] += np.float32(LEAST_SEEN) * gaussians.opacities
    _add_colors(sums, gaussians, drawn, np.full(len(drawn), HIDDEN_WEIGHT, np.float32), camera)


def _chosen(
    gaussians: Gaussians[np.ndarray], drawn: np.ndarray, which: np.ndarray
) -> tuple[Gaussians[np.ndarray], np.ndarray]:
    """Those of a mask [M] bool."""
    return Gaussians(*(value[which] for value in vars(gaussians).values())), drawn[which]


def _add_colors(
    sums: _Sums,
    gaussians: Gaussians[np.ndarray],
    drawn: np.ndarray,  # [M] int64, which primitives they are
    weight: np.ndarray,  # [M] pixels
    camera: Camera,
) -> None:
    """Add the colors that a camera sees."""
    offsets = gaussians.means - camera.center.astype(np.float32)
    directions = offsets / np.maximum(np.linalg.norm(offsets, axis=1, keepdims=True), np.float32(1e-12))
    degree = degree_of(sums.normal.shape[1] - 1)
    for start in range(0, len(drawn), BLOCK):
        rows = slice(start, start + BLOCK)
        basis = harmonic_basis(directions[rows], degree)
        weighted = weight[rows, None] * basis
        sums.normal[drawn[rows]] += weighted[:, :, None] * basis[:, None]
        colors = gaussians.colors[rows] - np.float32(COLOR_OFFSET)
        sums.colors[drawn[rows]] += weighted[:, :, None] * colors[:, None]
    sums.weight[drawn] += weight


def _add_opacities(
    sums: _Sums,
    model: HybridModel,
    camera: Camera,
    settings: RasterSettings,
    visible: np.ndarray,  # [N] bool, anchors
    gaussians: Gaussians[np.ndarray],
    drawn: np.ndarray,  # [M] int64, which primitives they are
) -> None:
    """Add the opacities of all primitives of the anchors in view: those that are not drawn have opacity 0, and count
    with it.
    """
    rows = np.flatnonzero(visible[model.primitives.anchor_index])
    opacities = np.zeros_like(sums.opacity)
    opacities[drawn] = gaussians.opacities
    means, scales, quaternions = (array[rows] for array in model.geometry)
    probes = np.maximum(opacities[rows], np.float32(PROBE_OPACITY))
    probing = Gaussians(means, quaternions, scales, probes, np.zeros_like(means))
    share = contributions(probing, camera, settings, blend_of(model))
    # Of a Gaussian, what lies above the cutoff is 1 - cutoff / opacity: the rest is not in the share.
    reaching = share / (probes - np.float32(CUTOFF))
    sums.reaching[rows] += reaching
    sums.opacity[rows] += reaching * opacities[rows]


def _solved(sums: _Sums, rows: np.ndarray, degree: int) -> np.ndarray:
    """[m, K, 3] coefficients of some primitives."""
    weight = sums.weight[rows, None, None].astype(np.float64)
    degrees = np.array([l for l in range(degree + 1) for _ in range(2 * l + 1)], np.float64)
    # Degree 0 is determined wherever there is a view; its share keeps the matrix from being singular to rounding.
    normal = sums.normal[rows] / weight + np.diag(PENALTY * degrees**2 + 1e-9 * Y0**2)
    return np.linalg.solve(normal, sums.colors[rows] / weight).astype(np.float32)
