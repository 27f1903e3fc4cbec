"""A scene that can be rendered: what a decoded file holds, and what training hands over."""

import functools
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import torch
from torch import Tensor, nn

from compgs.cameras import Camera
from compgs.gaussians import Gaussians
from compgs.model.heads import PredictionHeads
from compgs.model.inference import DrawnArrays, SceneArrays
from compgs.model.prediction import (
    camera_center,
    choosing_pays,
    drawn_reach,
    predict_appearance,
    predict_geometry,
    runs_in_kernels,
    see,
)
from compgs.model.primitives import Primitives, anchor_range

# Anchors are worked on in blocks, so that memory stays near the size of the result.
BLOCK = 1 << 14
FRAME_BLOCK = 1 << 12  # whole blocks of the kernels, so that dividing a frame changes nothing
GPU_BLOCK = 1 << 18  # a GPU is not busy with fewer


@dataclass(frozen=True, eq=False)
class HybridModel:
    """Anchors, residuals and prediction networks of one scene; `gaussians(camera)` is what a view renders.

    Everything here lives in the model's local frame: world coordinates minus `world_offset`, so that single precision
    is enough far from the world's origin. Its methods take cameras of that frame; `compgs.render` takes those of
    the world and moves them.

    Geometry of coupled primitives does not depend on the view and is predicted once, on first use; a view then costs
    opacity and color of the anchors that may be in it.
    """

    primitives: Primitives
    heads: PredictionHeads
    distance_unit: float  # world units, of the view embedding
    background: tuple[float, float, float]  # RGB, 0 to 1
    # in which the networks of opacity and color compute; bfloat16: for GPUs
    appearance_dtype: torch.dtype = torch.float32
    # world units, float64: origin of the local frame
    world_offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    viewpoints: tuple[Camera, ...] = ()  # of the world: where to look from, the best first
    up: tuple[float, float, float] = (0.0, -1.0, 0.0)  # direction of the sky

    @property
    def anchors(self) -> int:
        return len(self.primitives)

    @property
    def coupled(self) -> int:
        """Number of coupled primitives in the scene."""
        return len(self.primitives.residuals)

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
    def first_coupled(self) -> Tensor:
        """[N + 1] int64: where the coupled primitives of each anchor begin, and where the last one's end."""
        counts = torch.bincount(self.primitives.anchor_index, minlength=self.anchors)
        return nn.functional.pad(counts.cumsum(0), (1, 0))

    def _blocks(self) -> Iterator[tuple[slice, slice]]:
        """All anchors, BLOCK at a time, and their coupled primitives."""
        starts = self.first_coupled[:-1:BLOCK].tolist()
        for i, start in enumerate(starts):
            end = starts[i + 1] if i + 1 < len(starts) else self.coupled
            yield slice(i * BLOCK, min((i + 1) * BLOCK, self.anchors)), slice(start, end)

    @functools.cached_property
    def geometry(self) -> tuple[Tensor, Tensor, Tensor]:
        """Means, scales [P, 3] and quaternions [P, 4] of all coupled primitives, world units."""
        if self._in_kernels:
            g = self._scene.geometry
            return torch.from_numpy(g.means), torch.from_numpy(g.scales), torch.from_numpy(g.quaternions)
        p = self.primitives
        means, scales, quaternions = (p.positions.new_empty(self.coupled, size) for size in (3, 3, 4))
        with torch.no_grad():
            for anchors, coupled in self._blocks():
                part = anchor_range(p, anchors, coupled)
                means[coupled], scales[coupled], quaternions[coupled] = predict_geometry(
                    self.heads, part, part.residuals, part.anchor_index
                )
        return means, scales, quaternions

    @functools.cached_property
    def bounds(self) -> tuple[Tensor, Tensor]:
        """Spheres that hold an anchor's coupled primitives: centres [N, 3] and radii [N], world units."""
        p = self.primitives
        means, scales, _ = self.geometry
        radii = means.new_zeros(len(p))
        for _, coupled in self._blocks():
            index = p.anchor_index[coupled]
            offset = means[coupled] - p.positions.index_select(0, index)
            radii.scatter_reduce_(0, index, drawn_reach(offset, scales[coupled]), "amax")
        return p.positions, radii

    def gaussians(self, camera: Camera, visible: Tensor | None = None) -> Gaussians:
        """What a camera sees. `visible` [N] bool: anchors to look at; all of them if not given."""
        return self.drawn(camera, visible)[0]

    @torch.no_grad()
    def parts(self, camera: Camera, visible: Tensor | None = None) -> Iterator[Gaussians]:
        """The same Gaussians, on the CPU those of FRAME_BLOCK anchors at a time; one part at least."""
        if not self._in_kernels:
            yield self.gaussians(camera, visible)
            return
        chosen, center = self._seen_from(camera, visible)
        for anchors in chosen.split(FRAME_BLOCK):
            yield _as_gaussians(self._scene.drawn(anchors.numpy(), center.numpy()))

    @torch.no_grad()
    def drawn(self, camera: Camera, visible: Tensor | None = None) -> tuple[Gaussians, Tensor]:
        """What a camera sees (M Gaussians), and which coupled primitives they are ([M] int64, ascending)."""
        chosen, center = self._seen_from(camera, visible)
        if self._in_kernels:
            drawn = self._scene.drawn(chosen.numpy(), center.numpy())
            return _as_gaussians(drawn), torch.from_numpy(drawn.index)
        blocks = chosen.split(GPU_BLOCK if chosen.is_cuda else BLOCK)
        parts = [self._appearance(anchors, center) for anchors in blocks]
        index, opacities, colors = (torch.cat(part) for part in zip(*parts, strict=True))
        means, scales, quaternions = (array.index_select(0, index) for array in self.geometry)
        return Gaussians(means, quaternions, scales, opacities, colors), index

    def _seen_from(self, camera: Camera, visible: Tensor | None) -> tuple[Tensor, Tensor]:
        """Rows of the anchors to look at ([V] int64, ascending), and the camera's center [3]."""
        p = self.primitives
        center = camera_center(camera, p.positions.device).to(p.positions.dtype)
        if visible is None:
            return torch.arange(len(p), device=p.positions.device), center
        return torch.nonzero(visible).view(-1), center

    @property
    def _in_kernels(self) -> bool:
        """Whether the kernels predict, and not the readable torch."""
        p = self.primitives
        return runs_in_kernels(p.residuals.device, p.residuals.dtype, self.appearance_dtype)

    @functools.cached_property
    def _scene(self) -> SceneArrays:
        """The same scene for the kernels."""
        return SceneArrays.of(self.heads.arrays(), self.primitives.arrays(), self.distance_unit)

    def _appearance(
        self,
        anchors: Tensor,  # [V] int64, ascending
        center: Tensor,  # [3] of the camera, world units
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Of the anchors' coupled primitives that are drawn: which they are [M], opacities [M], colors [M, 3].

        On a GPU all of them, those that are not drawn with opacity 0.
        """
        p = self.primitives
        first = self.first_coupled.index_select(0, anchors)
        counts = self.first_coupled.index_select(0, anchors + 1) - first
        rows = torch.repeat_interleave(counts)  # of `anchors`, one for each coupled primitive
        # The anchors' ranges of coupled primitives, one after the other.
        coupled = torch.arange(len(rows), device=rows.device)
        coupled += (first + counts - counts.cumsum(0)).index_select(0, rows)
        references, positions = (t.index_select(0, anchors) for t in (p.references, p.positions))
        seen = see(references, positions, center, self.distance_unit)
        residuals = p.residuals.index_select(0, coupled)
        found = predict_appearance(
            self.heads, seen, residuals, rows, dtype=self.appearance_dtype, compact=choosing_pays(rows.device)
        )
        index = coupled if found.index is None else coupled.index_select(0, found.index)
        return index, found.opacities, found.colors


def _as_gaussians(drawn: DrawnArrays) -> Gaussians:
    g = drawn.geometry
    arrays = g.means, g.quaternions, g.scales, drawn.opacities, drawn.colors
    return Gaussians(*(torch.from_numpy(array) for array in arrays))
