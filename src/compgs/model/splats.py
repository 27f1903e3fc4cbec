"""Independent splats with view-dependent color: what plain 3DGS and files of splats hold (Kerbl et al. 2023).

`Splats` are the stored, unactivated numbers; `splat_gaussians` activates them for a camera; `SplatModel` is a scene of
them that can be rendered.
"""

import functools
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from compgs.cameras import Camera
from compgs.gaussians import Gaussians
from compgs.model.constants import CUTOFF_SIGMAS
from compgs.model.spherical_harmonics import coefficients, view_colors


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
        """Of the spherical harmonics, 0 to 3."""
        return next(d for d in range(4) if coefficients(d) - 1 == self.rest.shape[1])

    def to(self, device: torch.device | str) -> "Splats":
        return Splats(**{name: tensor.to(device) for name, tensor in vars(self).items()})

    def rows(self, index: Tensor) -> "Splats":
        """The splats of an index [V] int64."""
        return Splats(**{name: tensor.index_select(0, index) for name, tensor in vars(self).items()})


def splat_gaussians(
    splats: Splats, camera: Camera, degree: int | None = None, visible: Tensor | None = None
) -> Gaussians:
    """What a camera sees, differentiable. `degree` of the harmonics to use, all by default; splats outside of
    `visible` [M] bool are given without color: they must not reach the image.
    """
    center = torch.as_tensor(camera.center, dtype=splats.means.dtype, device=splats.means.device)
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


@dataclass(frozen=True, eq=False)
class SplatModel:
    """A scene of splats; `gaussians(camera)` is what a view renders. Only .cgs files hold a background.

    Splats and the cameras of `gaussians` are in the local frame, world coordinates minus `world_offset`;
    `compgs.render` takes cameras of the world and moves them.
    """

    splats: Splats
    background: tuple[float, float, float]  # RGB, 0 to 1
    # world units, float64: origin of the local frame
    world_offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    viewpoints: tuple[Camera, ...] = ()  # files of splats keep none

    @property
    def counts(self) -> Mapping[str, int]:
        return {"splats": len(self.splats)}

    @property
    def most_gaussians(self) -> int:
        return len(self.splats)

    def over(self, background: tuple[float, float, float]) -> "SplatModel":
        """The same over another background."""
        return replace(self, background=background)

    @functools.cached_property
    def bounds(self) -> tuple[Tensor, Tensor]:
        """Spheres that hold what is drawn of a splat: centres [M, 3] and radii [M], world units."""
        return self.splats.means, splat_radii(self.splats)

    @torch.no_grad()
    def gaussians(self, camera: Camera, visible: Tensor | None = None) -> Gaussians:
        """What a camera sees. `visible` [M] bool: splats to look at; all of them if not given."""
        if visible is None:
            return splat_gaussians(self.splats, camera)
        return splat_gaussians(self.splats.rows(torch.nonzero(visible).view(-1)), camera)

    def parts(self, camera: Camera, visible: Tensor | None = None) -> Iterator[Gaussians]:
        """The same, as one part: splats are in memory anyway."""
        yield self.gaussians(camera, visible)
