"""A scene that can be rendered: what a decoded file holds, and what training hands over. Free of torch."""

import functools
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np

from compgs.cameras import Camera
from compgs.gaussians import Gaussians
from compgs.model.arrays import PrimitiveArrays
from compgs.model.constants import CUTOFF_SIGMAS
from compgs.model.head_weights import HeadWeights
from compgs.model.inference import DrawnArrays, SceneArrays
from compgs.pictures import table

# Anchors are worked on in blocks, so that memory stays near the size of the result.
BLOCK = 1 << 14
FRAME_BLOCK = 1 << 12  # whole blocks of the kernels, so that dividing a frame changes nothing


@dataclass(frozen=True, eq=False)
class HybridModel:
    """Anchors, residuals and prediction networks of one scene; `gaussians(camera)` is what a view renders.

    All numbers are numpy arrays. Everything here lives in the model's local frame: world coordinates minus
    `world_offset`, so that single precision is enough far from the world's origin. Its methods take cameras of that
    frame; `compgs.render` takes those of the world and moves them.

    Geometry of coupled primitives does not depend on the view and is predicted once, on first use; a view then costs
    opacity and color of the anchors that may be in it.
    """

    primitives: PrimitiveArrays
    heads: HeadWeights
    distance_unit: float  # world units, of the view embedding
    background: tuple[float, float, float]  # RGB, 0 to 1
    # world units, float64: origin of the local frame
    world_offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    viewpoints: tuple[Camera, ...] = ()  # of the world: where to look from, the best first
    up: tuple[float, float, float] = (0.0, -1.0, 0.0)  # direction of the sky
    angular_dilation: float | None = None  # of what is drawn (`RasterSettings`)

    @property
    def antialiased(self) -> bool:
        """Trained with plain dilation: opacities are those at which it was trained."""
        return False

    @property
    def anchors(self) -> int:
        return len(self.primitives)

    @property
    def coupled(self) -> int:
        """Number of coupled primitives in the scene."""
        return len(self.primitives.residuals)

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.anchors:,} anchors, {self.coupled:,} coupled primitives)"

    def _repr_html_(self) -> str:
        """Show in a notebook what there is."""
        return table(type(self).__name__, {**self.counts, "viewpoints": len(self.viewpoints)})

    @property
    def counts(self) -> Mapping[str, int]:
        return {"anchors": self.anchors, "coupled_primitives": self.coupled}

    @property
    def most_gaussians(self) -> int:
        return self.coupled

    def over(self, background: tuple[float, float, float]) -> "HybridModel":
        """The same over another background."""
        return replace(self, background=background)

    @functools.cached_property
    def _scene(self) -> SceneArrays:
        """Return the scene with its geometry, for the kernels."""
        return SceneArrays.of(self.heads.arrays(), self.primitives, self.distance_unit)

    @property
    def geometry(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Means, scales [P, 3] and quaternions [P, 4] of all coupled primitives, world units."""
        return self._scene.geometry.fields

    @functools.cached_property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Spheres that hold an anchor's coupled primitives: centres [N, 3] and radii [N], world units."""
        p, first = self.primitives, self._scene.first_coupled
        means, scales, _ = self.geometry
        radii = np.zeros(len(p), np.float32)
        for start in range(0, len(p), BLOCK):
            anchors = slice(start, min(start + BLOCK, len(p)))
            coupled = slice(first[anchors.start], first[anchors.stop])
            with np.errstate(over="ignore", invalid="ignore"):  # a file may hold any numbers
                offset = means[coupled] - p.positions[p.anchor_index[coupled]]
                reach = np.sqrt(np.square(offset).sum(1)) + np.float32(CUTOFF_SIGMAS) * scales[coupled].max(1)
            full = np.flatnonzero(np.diff(first[anchors.start : anchors.stop + 1]))
            if len(full):
                radii[start + full] = np.maximum.reduceat(reach, first[start + full] - coupled.start)
        return p.positions, radii

    def gaussians(self, camera: Camera, visible: np.ndarray | None = None) -> Gaussians[np.ndarray]:
        """What a camera sees. `visible` [N] bool: anchors to look at; all of them if not given."""
        return self.drawn(camera, visible)[0]

    def parts(self, camera: Camera, visible: np.ndarray | None = None) -> Iterator[Gaussians[np.ndarray]]:
        """The same Gaussians, those of FRAME_BLOCK anchors at a time; one part at least."""
        chosen, center = self._seen_from(camera, visible)
        for start in range(0, max(1, len(chosen)), FRAME_BLOCK):
            yield _as_gaussians(self._scene.drawn(chosen[start : start + FRAME_BLOCK], center))

    def drawn(
        self, camera: Camera, visible: np.ndarray | None = None
    ) -> tuple[Gaussians[np.ndarray], np.ndarray]:
        """What a camera sees (M Gaussians), and which coupled primitives they are ([M] int64, ascending)."""
        drawn = self._scene.drawn(*self._seen_from(camera, visible))
        return _as_gaussians(drawn), drawn.index

    def _seen_from(self, camera: Camera, visible: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
        """Rows of the anchors to look at ([V] int64, ascending), and the camera's center [3]."""
        chosen = np.arange(self.anchors, dtype=np.int64) if visible is None else np.flatnonzero(visible)
        return chosen.astype(np.int64, copy=False), camera.center.astype(np.float32)


def _as_gaussians(drawn: DrawnArrays) -> Gaussians[np.ndarray]:
    g = drawn.geometry
    return Gaussians(g.means, g.quaternions, g.scales, drawn.opacities, drawn.colors)
