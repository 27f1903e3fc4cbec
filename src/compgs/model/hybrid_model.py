"""A scene that can be rendered: what a decoded file holds, and what training hands over."""

import functools
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor, nn

from compgs.cameras import Camera
from compgs.gaussians import Gaussians
from compgs.model.appearance import block_count, gather_drawn, predict_appearance
from compgs.model.layers import MLPArrays
from compgs.model.prediction import (
    OPACITY_CUTOFF,
    PredictionHeads,
    affine_transform,
    appearance_precision,
    camera_center,
    choosing_pays,
    view_embedding,
)
from compgs.model.primitives import Primitives

# An opaque splat falls below 1/255 at sqrt(2 ln 255) = 3.33 standard deviations.
CUTOFF_SIGMAS = 3.34
# Anchors are worked on in blocks, so that memory stays near the size of the result.
BLOCK = 1 << 14
FRAME_BLOCK = 1 << 12  # whole blocks of `appearance`, so that dividing a frame changes nothing
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
    appearance_dtype: torch.dtype = (
        torch.float32
    )  # in which opacity and color are computed; bfloat16: for GPUs
    world_offset: tuple[float, float, float] = (
        0.0,
        0.0,
        0.0,
    )  # world units, float64: origin of the local frame
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
        p = self.primitives
        means, scales, quaternions = (p.positions.new_empty(self.coupled, size) for size in (3, 3, 4))
        with torch.no_grad():
            offset_scales, sizes = p.offset_scales, p.sizes
            for anchors, coupled in self._blocks():
                index = p.anchor_index[coupled]
                raw = self.heads(
                    "geometry", p.references[anchors], p.residuals[coupled], index - anchors.start
                )
                means[coupled], scales[coupled], quaternions[coupled] = affine_transform(
                    raw,
                    p.positions.index_select(0, index),
                    offset_scales.index_select(0, index),
                    sizes.index_select(0, index),
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
            reach = offset.norm(dim=1) + CUTOFF_SIGMAS * scales[coupled].amax(1)
            radii.scatter_reduce_(0, index, reach, "amax")
        return p.positions, radii

    @torch.no_grad()
    def gaussians(self, camera: Camera, visible: Tensor | None = None) -> Gaussians:
        """What a camera sees. `visible` [N] bool: anchors to look at; all of them if not given."""
        if self._fused:
            return self._fused_gaussians(*self._seen_from(camera, visible))
        return self.drawn(camera, visible)[0]

    @torch.no_grad()
    def parts(self, camera: Camera, visible: Tensor | None = None) -> Iterator[Gaussians]:
        """The same Gaussians, on the CPU those of FRAME_BLOCK anchors at a time; one part at least."""
        if not self._fused:
            yield self.drawn(camera, visible)[0]
            return
        chosen, center = self._seen_from(camera, visible)
        for anchors in chosen.split(FRAME_BLOCK):
            yield self._fused_gaussians(anchors, center)

    @torch.no_grad()
    def drawn(self, camera: Camera, visible: Tensor | None = None) -> tuple[Gaussians, Tensor]:
        """What a camera sees (M Gaussians), and which coupled primitives they are ([M] int64, ascending)."""
        chosen, center = self._seen_from(camera, visible)
        blocks = chosen.split(GPU_BLOCK if chosen.is_cuda else BLOCK)
        parts = [self._appearance(anchors, center) for anchors in blocks]
        drawn, opacities, colors = (torch.cat(part) for part in zip(*parts, strict=True))
        means, scales, quaternions = (array.index_select(0, drawn) for array in self.geometry)
        return Gaussians(means, quaternions, scales, opacities, colors), drawn

    def _seen_from(self, camera: Camera, visible: Tensor | None) -> tuple[Tensor, Tensor]:
        """Rows of the anchors to look at ([V] int64, ascending), and the camera's center [3]."""
        p = self.primitives
        center = camera_center(camera, p.positions.device).to(p.positions.dtype)
        if visible is None:
            return torch.arange(len(p), device=p.positions.device), center
        return torch.nonzero(visible).view(-1), center

    @property
    def _fused(self) -> bool:
        """Whether the kernels of `appearance` do it."""
        plain = self.primitives.residuals.dtype == self.appearance_dtype == torch.float32
        return plain and self.primitives.residuals.device.type == "cpu" and self.heads.layout == "paired"

    @functools.cached_property
    def _appearance_arrays(self) -> MLPArrays:
        return self.heads.appearance.arrays()

    def _fused_gaussians(
        self,
        anchors: Tensor,  # [V] int64, ascending
        center: Tensor,  # [3] of the camera, world units
    ) -> Gaussians:
        """What `_appearance` and gathers of the geometry give, by compiled kernels."""
        p, first = self.primitives, self.first_coupled
        counts = first.index_select(0, anchors + 1) - first.index_select(0, anchors)
        places = nn.functional.pad(counts.cumsum(0), (1, 0))
        appearance = np.empty((int(places[-1]), 4), np.float32)
        drawn = np.zeros(block_count(len(anchors)), np.int64)
        where = anchors.numpy(), first.numpy(), places.numpy()
        predict_appearance(
            *where,
            p.positions.contiguous().numpy(),
            p.references.contiguous().numpy(),
            p.residuals.contiguous().numpy(),
            center.numpy(),
            np.float32(self.distance_unit),
            np.float32(OPACITY_CUTOFF),
            *self._appearance_arrays,
            appearance,
            drawn,
        )
        offsets = np.concatenate([[0], np.cumsum(drawn)])
        m = int(offsets[-1])
        means, scales, quaternions, colors = (p.positions.new_empty(m, size) for size in (3, 3, 4, 3))
        opacities = p.positions.new_empty(m)
        all_means, all_scales, all_quaternions = (t.numpy() for t in self.geometry)
        gather_drawn(
            *where,
            appearance,
            offsets,
            all_means,
            all_scales,
            all_quaternions,
            means.numpy(),
            scales.numpy(),
            quaternions.numpy(),
            opacities.numpy(),
            colors.numpy(),
        )
        return Gaussians(means, quaternions, scales, opacities, colors)

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
        view = view_embedding(p.positions.index_select(0, anchors), center, self.distance_unit)
        seen = torch.cat([p.references.index_select(0, anchors), view], 1)
        residuals = p.residuals.index_select(0, coupled)
        raw = self._head("appearance", seen, residuals, rows)
        opacities = torch.tanh(raw[:, 0])
        if not choosing_pays(rows.device):
            shown = torch.where(opacities > OPACITY_CUTOFF, opacities, torch.zeros_like(opacities))
            if self.heads.layout == "paired":
                color = raw[:, 1:4]
            else:
                color = self._head("color", seen, residuals, rows)
            return coupled, shown, torch.sigmoid(color)
        drawn = torch.nonzero(opacities > OPACITY_CUTOFF).view(-1)
        if self.heads.layout == "paired":
            color = raw.index_select(0, drawn)[:, 1:4]
        else:
            color = self._head("color", seen, residuals.index_select(0, drawn), rows.index_select(0, drawn))
        return coupled.index_select(0, drawn), opacities.index_select(0, drawn), torch.sigmoid(color)

    def _head(self, kind: str, seen: Tensor, residuals: Tensor, rows: Tensor) -> Tensor:
        with appearance_precision(residuals.device, self.appearance_dtype):
            return self.heads(kind, seen, residuals, rows).to(residuals.dtype)
