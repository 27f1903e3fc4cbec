"""Splats on torch tensors, as training changes them (Kerbl et al. 2023); `model/splats.py` has them as files hold them.

`Splats` are the stored, unactivated numbers; `splat_gaussians` activates them for a camera, with gradients.
"""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from compgs.cameras import Camera
from compgs.gaussians import Gaussians
from compgs.model.constants import CUTOFF_SIGMAS
from compgs.model.degrees import degree_of
from compgs.model.splats import ORIGIN, SplatArrays
from compgs.tensors.prediction import camera_center
from compgs.tensors.spherical_harmonics import view_colors


@dataclass(frozen=True, eq=False)
class Splats:
    """M splats as they are stored: standard deviation = exp(log scale), opacity = sigmoid(logit)."""

    means: Tensor  # [M, 3] world units
    log_scales: Tensor  # [M, 3]
    quaternions: Tensor  # [M, 4] w-x-y-z, need not be normalized, not zero
    opacity_logits: Tensor  # [M]
    dc: Tensor  # [M, 3] harmonic coefficients of degree 0, RGB
    rest: Tensor  # [M, K, 3] of degree 1 to `degree`: K = 0, 3, 8 or 15

    def __len__(self) -> int:
        return len(self.means)

    @property
    def degree(self) -> int:
        """Return the degree of the spherical harmonics, 0 to 3."""
        return degree_of(self.rest.shape[1])

    @classmethod
    def of(cls, arrays: SplatArrays) -> "Splats":
        """Make tensors on the CPU from copies of the arrays."""
        named = arrays.columns.items()
        return cls(**{name: torch.from_numpy(np.array(value, np.float32)) for name, value in named})

    def arrays(self, world_offset: tuple[float, float, float] = ORIGIN) -> SplatArrays:
        """Inverse of `of`; on the CPU they share the memory of the tensors."""
        named = {name: tensor.detach().cpu().float().numpy() for name, tensor in vars(self).items()}
        return SplatArrays(**named, world_offset=world_offset)

    def to(self, device: torch.device | str) -> "Splats":
        return Splats(**{name: tensor.to(device) for name, tensor in vars(self).items()})

    def rows(self, index: Tensor) -> "Splats":
        """The splats of an index [V] int64."""
        return Splats(**{name: tensor.index_select(0, index) for name, tensor in vars(self).items()})


def splat_gaussians(
    splats: Splats, camera: Camera, degree: int | None = None, visible: Tensor | None = None
) -> Gaussians[Tensor]:
    """What a camera sees, differentiable. `degree` of the harmonics to use, all by default; splats outside of
    `visible` [M] bool are given without color: they must not reach the image.
    """
    center = camera_center(camera, splats.means.device, splats.means.dtype)
    degree = splats.degree if degree is None else degree
    return Gaussians(
        splats.means,
        splats.quaternions,
        splats.log_scales.exp(),
        splats.opacity_logits.sigmoid(),
        view_colors(splats.means, splats.dc, splats.rest, center, degree, visible),
    )


def splat_radii(splats: Splats) -> Tensor:
    """[M] world units: of spheres beyond which nothing of a splat is drawn."""
    return CUTOFF_SIGMAS * splats.log_scales.detach().amax(1).exp()
