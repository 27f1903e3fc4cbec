"""What a view sees of the anchors, differentiable: the equations of this package's docstring."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from compgs.gaussians import Gaussians
from compgs.methods.anchors.networks import applied
from compgs.model.constants import CUTOFF_SIGMAS
from compgs.published.anchors import Frame
from compgs.tensors import where
from compgs.tensors.prediction import Prediction, is_drawn, see


@dataclass(frozen=True)
class AnchorValues:
    """Anchors as prediction takes them: trained as they are, or with the noise of a quantization."""

    positions: Tensor  # [N, 3] world units
    features: Tensor  # [N, F]
    offsets: Tensor  # [N, K, 3] in units of the position scale
    position_scales: Tensor  # [N, 1 or 3] natural log, voxels
    sizes: Tensor  # [N, 3] natural log, voxels
    mask: Tensor | None = None  # [N, K] 0 or 1, by which opacities are multiplied; None: all 1

    def rows(self, index: Tensor) -> "AnchorValues":
        """The anchors of an index [V] int64."""
        rows: dict[str, Any] = {
            name: None if tensor is None else tensor.index_select(0, index)
            for name, tensor in vars(self).items()
        }
        return AnchorValues(**rows)

    def means(self, voxel_size: float) -> Tensor:
        """[N, K, 3] world units."""
        return self.positions[:, None] + self.offsets * (self.position_scales.exp() * voxel_size)[:, None]

    @torch.no_grad()
    def radii(self, voxel_size: float) -> Tensor:
        """[N] world units: of spheres that hold all that is drawn of an anchor, from wherever it is seen."""
        away = (self.means(voxel_size) - self.positions[:, None]).norm(dim=2).amax(1)
        return away + CUTOFF_SIGMAS * voxel_size * self.sizes.amax(1).exp()


def predict_anchors(
    weights: Mapping[str, Tensor],  # of `ViewNetworks`, by name
    anchors: AnchorValues,  # V of them
    camera_center: Tensor,  # [3] world units
    frame: Frame,
) -> Prediction:
    """What may be drawn from a camera: of V * K coupled primitives those with opacity, on a GPU all of them."""
    v, k = anchors.offsets.shape[:2]
    seen = see(anchors.features, anchors.positions, camera_center, frame.distance_unit)
    all_opacities = torch.tanh(applied(weights, "opacity", seen)).view(-1)
    if anchors.mask is not None:
        all_opacities = all_opacities * anchors.mask.reshape(-1)
    drawn = is_drawn(all_opacities)
    colors = torch.sigmoid(applied(weights, "color", seen)).view(-1, 3)
    shapes = applied(weights, "covariance", seen).view(v, k, 7)
    sizes = (anchors.sizes.exp() * frame.voxel_size)[:, None]
    scales = (torch.sigmoid(shapes[..., :3]) * sizes).view(-1, 3)
    # An identity offset keeps the norm away from zero, where the direction has no gradient.
    quaternions = torch.cat([shapes[..., 3:4] + 1.0, shapes[..., 4:]], 2).view(-1, 4)
    means = anchors.means(frame.voxel_size).view(-1, 3)
    if not where.choosing_pays(seen.device):
        opacities = torch.where(drawn, all_opacities, torch.zeros_like(all_opacities))
        every = torch.arange(v * k, device=seen.device)
        return Prediction(
            Gaussians(means, quaternions, scales, opacities, colors), every, all_opacities, drawn
        )
    index = torch.nonzero(drawn).view(-1)
    parts = (t.index_select(0, index) for t in (means, quaternions, scales, all_opacities, colors))
    return Prediction(Gaussians(*parts), index, all_opacities)
