"""A scene that can be rendered: what a decoded file holds, and what training hands over."""

import functools
from dataclasses import dataclass

import torch
from torch import Tensor

from compgs.cameras import Camera
from compgs.gaussians import Gaussians
from compgs.model.prediction import OPACITY_CUTOFF, PredictionHeads, affine_transform, view_embedding
from compgs.model.primitives import Primitives

# An opaque splat falls below 1/255 at sqrt(2 ln 255) = 3.33 standard deviations.
CUTOFF_SIGMAS = 3.34


@dataclass(frozen=True, eq=False)
class HybridModel:
    """Anchors, residuals and prediction networks of one scene; `gaussians(camera)` is what a view renders.

    Geometry of coupled primitives does not depend on the view and is predicted once, on first use; a view then costs
    opacity and color of the anchors that may be in it.
    """

    primitives: Primitives
    heads: PredictionHeads
    distance_unit: float  # world units, of the view embedding
    background: tuple[float, float, float]  # RGB, 0 to 1

    @property
    def anchors(self) -> int:
        return len(self.primitives)

    @property
    def coupled(self) -> int:
        """Number of coupled primitives in the scene."""
        return len(self.primitives.residuals)

    @functools.cached_property
    def geometry(self) -> tuple[Tensor, Tensor, Tensor]:
        """Means, scales [P, 3] and quaternions [P, 4] of all coupled primitives, world units."""
        p = self.primitives
        means, scales, quaternions = [], [], []
        with torch.no_grad():
            # In blocks, so that the peak stays near the size of the result.
            for index, residuals in zip(
                p.anchor_index.split(1 << 18), p.residuals.split(1 << 18), strict=True
            ):
                first, last = (int(index[0]), int(index[-1]) + 1) if len(index) else (0, 0)
                raw = self.heads("geometry", p.references[first:last], residuals, index - first)
                m, s, q = affine_transform(raw, p.positions[index], p.offset_scales[index], p.sizes[index])
                means.append(m)
                scales.append(s)
                quaternions.append(q)
        return torch.cat(means), torch.cat(scales), torch.cat(quaternions)

    @functools.cached_property
    def bounds(self) -> tuple[Tensor, Tensor]:
        """Spheres that hold an anchor's coupled primitives: centres [N, 3] and radii [N], world units."""
        p = self.primitives
        means, scales, _ = self.geometry
        reach = (means - p.positions[p.anchor_index]).norm(dim=1) + CUTOFF_SIGMAS * scales.amax(1)
        radii = torch.zeros(len(p), device=means.device).scatter_reduce_(0, p.anchor_index, reach, "amax")
        return p.positions, radii

    def gaussians(self, camera: Camera, visible: Tensor | None = None) -> Gaussians:
        """What a camera sees. `visible` [N] bool: anchors to look at; all of them if not given."""
        p = self.primitives
        means, scales, quaternions = self.geometry
        with torch.no_grad():
            if visible is None:
                visible = torch.ones(len(p), dtype=torch.bool, device=p.positions.device)
            anchors = torch.nonzero(visible).view(-1)
            chosen = torch.nonzero(visible[p.anchor_index]).view(-1)
            rows = (torch.cumsum(visible, 0) - 1)[p.anchor_index[chosen]]
            center = torch.as_tensor(camera.center, dtype=p.positions.dtype, device=p.positions.device)
            view = view_embedding(p.positions[anchors], center, self.distance_unit)
            seen = torch.cat([p.references[anchors], view], 1)
            residuals = p.residuals[chosen]
            raw = self.heads("appearance", seen, residuals, rows)
            opacities = torch.tanh(raw[:, 0])
            drawn = torch.nonzero(opacities > OPACITY_CUTOFF).view(-1)
            if self.heads.layout == "paired":
                color = raw[drawn, 1:4]
            else:
                color = self.heads("color", seen, residuals[drawn], rows[drawn])
            primitive = chosen[drawn]
            return Gaussians(
                means[primitive],
                quaternions[primitive],
                scales[primitive],
                opacities[drawn],
                torch.sigmoid(color),
            )
