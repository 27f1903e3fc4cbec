"""Hybrid primitives: few anchors that carry references, many coupled primitives that carry residuals (Sec. 3.1)."""

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from compgs.model.arrays import PrimitiveArrays


@dataclass(frozen=True)
class Primitives:
    """N anchor primitives with up to K coupled primitives each, as prediction sees them (dequantized).

    Coupled primitives are stored one after the other, in the order of their anchors; an anchor may have fewer than
    K. Log scales are relative to the voxel size, so that a scene in millimetres has the same latents as one in miles.
    """

    positions: Tensor  # [N, 3] world units
    log_scales: Tensor  # [N, 6] natural log of (0:3) reach of a translation, (3:6) size, in voxels
    references: Tensor  # [N, reference_dim]
    residuals: Tensor  # [P, residual_dim], P coupled primitives
    anchor_index: Tensor  # [P] int64, ascending: row of the anchor of each coupled primitive
    voxel_size: float  # world units

    def __len__(self) -> int:
        return len(self.positions)

    @property
    def reach(self) -> Tensor:
        """[N, 3] world units per unit of a predicted translation."""
        return self.log_scales[:, :3].exp() * self.voxel_size

    @property
    def sizes(self) -> Tensor:
        """[N, 3] world units: standard deviations of the anchor's own covariance."""
        return self.log_scales[:, 3:].exp() * self.voxel_size

    def arrays(self) -> PrimitiveArrays:
        """The same for the kernels, without gradients; copies nothing that is contiguous float32 on the CPU."""

        def array(tensor: Tensor) -> np.ndarray:
            return tensor.detach().cpu().contiguous().numpy()

        return PrimitiveArrays(
            positions=array(self.positions),
            log_scales=array(self.log_scales),
            references=array(self.references),
            residuals=array(self.residuals),
            anchor_index=array(self.anchor_index),
            voxel_size=self.voxel_size,
        )


def every_slot(anchors: int, coupled: int, device: torch.device | None = None) -> Tensor:
    """anchor_index [anchors * coupled] of anchors that have all their K coupled primitives."""
    return torch.arange(anchors, device=device).repeat_interleave(coupled)


def select_anchors(primitives: Primitives, chosen: Tensor) -> Primitives:
    """The chosen anchors (mask [N] bool) with their coupled primitives, in the same order."""
    rows = torch.cumsum(chosen, 0) - 1
    kept = chosen[primitives.anchor_index]
    return replace(
        primitives,
        positions=primitives.positions[chosen],
        log_scales=primitives.log_scales[chosen],
        references=primitives.references[chosen],
        residuals=primitives.residuals[kept],
        anchor_index=rows[primitives.anchor_index[kept]],
    )


def anchor_range(primitives: Primitives, anchors: slice, coupled: slice) -> Primitives:
    """A range of anchors, from a row to another, and the range of all their coupled primitives."""
    p = primitives
    return replace(
        primitives,
        positions=p.positions[anchors],
        log_scales=p.log_scales[anchors],
        references=p.references[anchors],
        residuals=p.residuals[coupled],
        anchor_index=p.anchor_index[coupled] - anchors.start,
    )
