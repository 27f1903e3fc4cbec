"""What a camera sees of a scene that is not trained any more: networks and kernels on numpy arrays, free of torch.

`prediction.py` is the readable version. Geometry does not depend on the view and is predicted once; a view then costs
opacity and color of the anchors in it.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np

from compgs.model import prediction_kernels as kernels
from compgs.model.arrays import MLPArrays, PrimitiveArrays
from compgs.model.constants import VIEW_DIM

BLOCK = 1 << 14  # anchors: memory stays near the size of the result


@dataclass(frozen=True, eq=False)
class GeometryArrays:
    """All P coupled primitives of a scene, world units."""

    means: np.ndarray  # [P, 3]
    scales: np.ndarray  # [P, 3] standard deviations
    quaternions: np.ndarray  # [P, 4] w-x-y-z, not normalized

    @classmethod
    def empty(cls, coupled: int) -> "GeometryArrays":
        """Room for so many primitives."""
        return cls(*(np.empty((coupled, size), np.float32) for size in (3, 3, 4)))

    @property
    def fields(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        return self.means, self.scales, self.quaternions


@dataclass(frozen=True, eq=False)
class DrawnArrays:
    """The M coupled primitives that a camera sees."""

    index: np.ndarray  # [M] int64, ascending: which of all P
    geometry: GeometryArrays  # of the M
    opacities: np.ndarray  # [M] above OPACITY_CUTOFF
    colors: np.ndarray  # [M, 3] display RGB


@dataclass(frozen=True, eq=False)
class SceneArrays:
    """A scene whose geometry is known: all that a view needs."""

    heads: "HeadArrays"
    primitives: PrimitiveArrays
    first_coupled: np.ndarray  # [N + 1] int64: first coupled primitive of each anchor
    geometry: GeometryArrays
    distance_unit: float  # world units, of the view embedding

    @classmethod
    def of(cls, heads: "HeadArrays", primitives: PrimitiveArrays, distance_unit: float) -> "SceneArrays":
        """Predicts the geometry."""
        first = primitives.first_coupled()
        return cls(heads, primitives, first, heads.geometry(primitives, first), distance_unit)

    def drawn(
        self,
        anchors: np.ndarray,  # [V] int64, ascending: those to look at
        center: np.ndarray,  # [3] float32 of the camera, world units
    ) -> DrawnArrays:
        """What a camera sees of the anchors."""
        return self.heads.drawn(self, anchors, center)


class HeadArrays(ABC):
    """The prediction networks as arrays: the kernels' twin of `PredictionHeads`, without gradients."""

    @abstractmethod
    def raw_geometry(self, references: np.ndarray, residuals: np.ndarray, index: np.ndarray) -> np.ndarray:
        """[M, 10] translation, scaling, quaternion."""

    @abstractmethod
    def drawn(self, scene: SceneArrays, anchors: np.ndarray, center: np.ndarray) -> DrawnArrays:
        """`SceneArrays.drawn` of a scene of these heads."""

    def geometry(self, primitives: PrimitiveArrays, first_coupled: np.ndarray) -> GeometryArrays:
        """Return the geometry of all coupled primitives."""
        p, spread = primitives, primitives.spread()
        geometry = GeometryArrays.empty(len(p.residuals))
        for a in range(0, len(p), BLOCK):
            anchors = slice(a, min(a + BLOCK, len(p)))
            part = slice(first_coupled[anchors.start], first_coupled[anchors.stop])
            index = p.anchor_index[part] - a
            kernels.affine_transform(
                self.raw_geometry(p.references[anchors], p.residuals[part], index),
                index,
                p.positions[anchors],
                spread[anchors],
                *(field[part] for field in geometry.fields),
            )
        return geometry


@dataclass(frozen=True, eq=False)
class PairedArrays(HeadArrays):
    """Two networks; opacity and color of a view come from one pass of kernels."""

    geometry_network: MLPArrays
    appearance_network: MLPArrays

    def raw_geometry(self, references: np.ndarray, residuals: np.ndarray, index: np.ndarray) -> np.ndarray:
        return self.geometry_network.apply(references, residuals, index)

    def drawn(self, scene: SceneArrays, anchors: np.ndarray, center: np.ndarray) -> DrawnArrays:
        p, first = scene.primitives, scene.first_coupled
        places = np.concatenate([np.zeros(1, np.int64), np.cumsum(first[anchors + 1] - first[anchors])])
        appearance = np.empty((int(places[-1]), 4), np.float32)
        counts = np.zeros(kernels.block_count(len(anchors)), np.int64)
        where = anchors, first, places
        kernels.paired_appearance(
            *where,
            p.positions,
            p.references,
            p.residuals,
            center,
            np.float32(scene.distance_unit),
            *self.appearance_network.whole,
            appearance,
            counts,
        )
        offsets = np.concatenate([np.zeros(1, np.int64), np.cumsum(counts)])
        m = int(offsets[-1])
        index, geometry = np.empty(m, np.int64), GeometryArrays.empty(m)
        opacities, colors = np.empty(m, np.float32), np.empty((m, 3), np.float32)
        kernels.gather_drawn(
            *where, appearance, offsets, *scene.geometry.fields, index, *geometry.fields, opacities, colors
        )
        return DrawnArrays(index, geometry, opacities, colors)


@dataclass(frozen=True, eq=False)
class SeparateArrays(HeadArrays):
    """Four networks; colors are predicted of those that are drawn alone."""

    translation_network: MLPArrays
    covariance_network: MLPArrays
    opacity_network: MLPArrays
    color_network: MLPArrays

    def raw_geometry(self, references: np.ndarray, residuals: np.ndarray, index: np.ndarray) -> np.ndarray:
        networks = self.translation_network, self.covariance_network
        return np.concatenate([network.apply(references, residuals, index) for network in networks], 1)

    def drawn(self, scene: SceneArrays, anchors: np.ndarray, center: np.ndarray) -> DrawnArrays:
        p, first = scene.primitives, scene.first_coupled
        seen = np.empty((len(anchors), p.references.shape[1] + VIEW_DIM), np.float32)
        unit = np.float32(scene.distance_unit)
        kernels.see(anchors, p.positions, p.references, center, unit, seen)
        counts = first[anchors + 1] - first[anchors]
        row = np.repeat(
            np.arange(len(anchors), dtype=np.int64), counts
        )  # of `seen`, for each coupled primitive in view
        # Their places among all: the anchors' ranges, one after the other.
        coupled = np.arange(len(row), dtype=np.int64) + (first[anchors + 1] - np.cumsum(counts))[row]
        opacities = np.empty(len(row), np.float32)
        kernels.activate_opacities(self.opacity_network.apply(seen, p.residuals, row, coupled), opacities)
        shown = np.nonzero(opacities > kernels.CUTOFF)[0]
        index, colors = coupled[shown], np.empty((len(shown), 3), np.float32)
        raw = self.color_network.apply(seen, p.residuals, row[shown], index)
        kernels.activate_colors(raw, np.arange(len(shown), dtype=np.int64), colors)
        g, geometry = scene.geometry, GeometryArrays.empty(len(index))
        kernels.gather_geometry(index, *g.fields, *geometry.fields)
        return DrawnArrays(index, geometry, opacities[shown], colors)
