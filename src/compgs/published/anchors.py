"""A scene of such anchors that can be rendered: what their files hold, on numpy arrays, free of torch."""

import functools
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np

from compgs.cameras import Camera
from compgs.gaussians import Gaussians
from compgs.model.constants import CUTOFF_SIGMAS, OPACITY_CUTOFF, SMALLEST_DISTANCE, VIEW_DIM

# Outputs of each network for a coupled primitive.
NETWORKS = {"opacity": 1, "color": 3, "covariance": 7}
BLOCK = 1 << 12  # anchors that are looked at together: memory stays near the size of the result


def tensor_name(network: str, kind: str, layer: int) -> str:
    """Return the name of a weight or bias, as files have it."""
    return f"{network}_{kind}{layer}"


def network_shapes(feature_dim: int, coupled: int, width: int) -> dict[str, tuple[int, ...]]:
    """Return the shapes by name, as files have to hold them."""
    shapes: dict[str, tuple[int, ...]] = {}
    for name, channels in NETWORKS.items():
        for layer, (inputs, outputs) in enumerate(
            ((feature_dim + VIEW_DIM, width), (width, channels * coupled)), 1
        ):
            shapes[tensor_name(name, "weight", layer)] = (inputs, outputs)
            shapes[tensor_name(name, "bias", layer)] = (outputs,)
    return shapes


@dataclass(frozen=True)
class Frame:
    """Where a scene is, and in what units."""

    voxel_size: float  # world units
    distance_unit: float  # world units, of the view embedding
    background: tuple[float, float, float]  # RGB, 0 to 1
    world_offset: tuple[float, float, float]  # world units, float64: origin of the local frame


@dataclass(frozen=True, eq=False)
class AnchorScene:
    """N anchors with K offsets each, as they are rendered; all arrays float32 but the mask."""

    frame: Frame
    positions: np.ndarray  # [N, 3] world units, of the local frame
    features: np.ndarray  # [N, F]
    offsets: np.ndarray  # [N, K, 3] in units of the position scale
    position_scales: np.ndarray  # [N, 1 or 3] natural log, voxels
    sizes: np.ndarray  # [N, 3] natural log, voxels
    mask: np.ndarray  # [N, K] bool: coupled primitives that exist
    weights: Mapping[str, np.ndarray]  # of the networks, by name
    viewpoints: tuple[Camera, ...] = ()

    @property
    def background(self) -> tuple[float, float, float]:
        return self.frame.background

    @property
    def angular_dilation(self) -> None:
        """3DGS's pixels, in pictures of every size."""
        return None

    @property
    def antialiased(self) -> bool:
        """Trained with plain dilation."""
        return False

    @property
    def world_offset(self) -> tuple[float, float, float]:
        return self.frame.world_offset

    @property
    def counts(self) -> Mapping[str, int]:
        return {"anchors": len(self.positions), "coupled_primitives": self.most_gaussians}

    @property
    def most_gaussians(self) -> int:
        return int(self.mask.sum())

    def over(self, background: tuple[float, float, float]) -> "AnchorScene":
        """The same over another background."""
        return replace(self, frame=replace(self.frame, background=background))

    @functools.cached_property
    def _placed(self) -> tuple[np.ndarray, np.ndarray]:
        """Means [N, K, 3] and largest scales [N, 3], world units."""
        with np.errstate(over="ignore"):  # a file may hold any log scale; what is infinite is not rendered
            reach = np.exp(self.position_scales) * np.float32(self.frame.voxel_size)
            sizes = np.exp(self.sizes) * np.float32(self.frame.voxel_size)
            return self.positions[:, None] + self.offsets * reach[:, None], sizes

    @functools.cached_property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Spheres that hold all that is drawn of an anchor: centres [N, 3] and radii [N], world units."""
        means, sizes = self._placed
        with np.errstate(over="ignore", invalid="ignore"):
            away = np.sqrt(np.square(means - self.positions[:, None]).sum(2))
            reach = np.where(self.mask, away, 0).max(1) + np.float32(CUTOFF_SIGMAS) * sizes.max(1)
        return self.positions, np.where(np.isfinite(reach), reach, np.float32(np.inf))

    def gaussians(self, camera: Camera, visible: np.ndarray | None = None) -> Gaussians[np.ndarray]:
        """What a camera of the local frame sees of the anchors of a mask [N] bool, or of all."""
        parts = list(self.parts(camera, visible))
        return Gaussians(*(np.concatenate(arrays) for arrays in zip(*map(_fields, parts), strict=True)))

    def parts(self, camera: Camera, visible: np.ndarray | None = None) -> Iterator[Gaussians[np.ndarray]]:
        """The same, those of BLOCK anchors at a time; one part at least."""
        chosen = np.arange(len(self.positions)) if visible is None else np.flatnonzero(visible)
        for start in range(0, max(1, len(chosen)), BLOCK):
            yield self._seen(chosen[start : start + BLOCK], camera.center.astype(np.float32))

    def _seen(self, rows: np.ndarray, center: np.ndarray) -> Gaussians[np.ndarray]:
        """Return how the anchors in `rows` [V] are seen from `center` [3]."""
        seen = np.concatenate(
            [self.features[rows], view_embedding(self.positions[rows], center, self.frame)], 1
        )
        shape = len(rows), self.mask.shape[1]
        opacities = np.tanh(self._applied("opacity", seen)).reshape(shape)
        drawn = self.mask[rows] & (opacities > OPACITY_CUTOFF)
        with np.errstate(over="ignore", invalid="ignore"):
            colors = _sigmoid(self._applied("color", seen)).reshape(*shape, 3)[drawn]
            shapes = self._applied("covariance", seen).reshape(*shape, 7)[drawn]
            means, sizes = self._placed
            scales = sizes[rows][np.nonzero(drawn)[0]] * _sigmoid(shapes[:, :3])
        quaternions = np.ascontiguousarray(shapes[:, 3:])
        quaternions[:, 0] += 1  # keeps the norm away from zero
        return Gaussians(means[rows][drawn], quaternions, scales, opacities[drawn], colors)

    def _applied(self, name: str, seen: np.ndarray) -> np.ndarray:
        w = {
            kind + str(i): self.weights[tensor_name(name, kind, i)]
            for kind in ("weight", "bias")
            for i in (1, 2)
        }
        return np.maximum(seen @ w["weight1"] + w["bias1"], 0) @ w["weight2"] + w["bias2"]


def view_embedding(positions: np.ndarray, center: np.ndarray, frame: Frame) -> np.ndarray:  # [V, 4]
    """Unit direction from the camera to an anchor, and distance in `distance_unit`; twin of `tensors.prediction`'s."""
    offset = positions - center
    distance = np.sqrt(np.square(offset).sum(1, keepdims=True))
    direction = offset / np.maximum(distance, np.float32(SMALLEST_DISTANCE))
    return np.concatenate([direction, distance / np.float32(frame.distance_unit)], 1)


def _fields(gaussians: Gaussians[np.ndarray]) -> tuple[np.ndarray, ...]:
    g = gaussians
    return g.means, g.quaternions, g.scales, g.opacities, g.colors


def _sigmoid(x: np.ndarray) -> np.ndarray:
    return np.float32(1) / (np.float32(1) + np.exp(-x))
