"""Independent splats with view-dependent color: what plain 3DGS and files of splats hold (Kerbl et al. 2023).

`SplatArrays` are the stored, unactivated numbers, on numpy arrays; `SplatModel` is a scene of them that can be
rendered. `tensors/splats.py` has the splats that are trained.
"""

import functools
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from compgs.cameras import Camera
from compgs.gaussians import Gaussians
from compgs.model.constants import CUTOFF_SIGMAS
from compgs.model.degrees import degree_of, harmonics_above_dc
from compgs.pictures import table

ORIGIN = (0.0, 0.0, 0.0)


@dataclass(frozen=True, eq=False)
class SplatArrays:
    """M splats in float32, unactivated: standard deviation = exp(log scale), opacity = sigmoid(logit).

    Means count from `world_offset`, harmonics are in the order of 3DGS (`compgs.model.spherical_harmonics`).
    """

    means: np.ndarray  # [M, 3] world units
    log_scales: np.ndarray  # [M, 3]
    quaternions: np.ndarray  # [M, 4] w-x-y-z, need not be normalized, not zero
    opacity_logits: np.ndarray  # [M]
    dc: np.ndarray  # [M, 3] coefficients of degree 0, RGB
    rest: np.ndarray  # [M, K, 3] of degree 1 to `degree`: K = 0, 3, 8 or 15
    world_offset: tuple[float, float, float] = ORIGIN  # world units, float64
    # Whether they were trained with opacities that fall as dilation spreads a splat (`RasterSettings.antialiased`).
    antialiased: bool = False

    def __repr__(self) -> str:
        return f"SplatArrays({len(self):,} splats of degree {self.degree})"

    def __len__(self) -> int:
        return len(self.means)

    @property
    def degree(self) -> int:
        """Return the degree of the harmonics, 0 to 3."""
        return degree_of(self.rest.shape[1])

    @property
    def columns(self) -> dict[str, np.ndarray]:
        """Return by name what each splat has a row of."""
        names = "means", "log_scales", "quaternions", "opacity_logits", "dc", "rest"
        return {name: getattr(self, name) for name in names}

    @property
    def opacities(self) -> np.ndarray:
        """[M] in [0, 1], float64."""
        return sigmoid(self.opacity_logits.astype(np.float64))

    def each(self, change: Callable[[np.ndarray], np.ndarray]) -> "SplatArrays":
        """The same with every array changed, as by choosing rows."""
        arrays: dict[str, Any] = {name: change(value) for name, value in self.columns.items()}
        return replace(self, **arrays)

    def rows(self, index: np.ndarray) -> "SplatArrays":
        """The splats of an index or a mask."""
        return self.each(lambda array: array[index])

    def of_degree(self, degree: int) -> "SplatArrays":
        """Leave out the harmonics above a degree."""
        return replace(self, rest=self.rest[:, : harmonics_above_dc(degree)])


def sigmoid(logits: np.ndarray) -> np.ndarray:
    """Compute the sigmoid in the precision of the logits."""
    with np.errstate(over="ignore"):
        return 1 / (1 + np.exp(-logits))


def splat_radii(log_scales: np.ndarray) -> np.ndarray:
    """[M] float32, world units: of spheres beyond which nothing of a splat is drawn; log_scales [M, 3]."""
    return np.float32(CUTOFF_SIGMAS) * np.exp(log_scales.max(1))


@dataclass(frozen=True, eq=False)
class SplatModel:
    """A scene of splats; `gaussians(camera)` is what a view renders. Only .cgs files hold a background.

    Splats and the cameras of `gaussians` are in the local frame, world coordinates minus `world_offset`;
    `compgs.render` takes cameras of the world and moves them.
    """

    splats: SplatArrays
    background: tuple[float, float, float]  # RGB, 0 to 1
    viewpoints: tuple[Camera, ...] = ()  # files of splats keep none

    @property
    def world_offset(self) -> tuple[float, float, float]:
        """World units, float64: origin of the local frame."""
        return self.splats.world_offset

    @property
    def angular_dilation(self) -> None:
        """3DGS's pixels, in pictures of every size."""
        return None

    @property
    def antialiased(self) -> bool:
        """Whether opacities fall as dilation spreads the splats."""
        return self.splats.antialiased

    def __repr__(self) -> str:
        return f"{type(self).__name__}({len(self.splats):,} splats)"

    def _repr_html_(self) -> str:
        """Show in a notebook what there is."""
        return table(type(self).__name__, self.counts)

    @property
    def counts(self) -> Mapping[str, int]:
        return {"splats": len(self.splats)}

    @property
    def most_gaussians(self) -> int:
        return len(self.splats)

    def at(self, world_offset: tuple[float, float, float]) -> "SplatModel":
        """The same with positions that count from another place."""
        return replace(self, splats=replace(self.splats, world_offset=world_offset))

    def over(self, background: tuple[float, float, float]) -> "SplatModel":
        """The same over another background."""
        return replace(self, background=background)

    @functools.cached_property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Spheres that hold what is drawn of a splat: centres [M, 3] and radii [M], world units."""
        return self.splats.means, splat_radii(self.splats.log_scales)

    @functools.cached_property
    def _activated(self) -> tuple[np.ndarray, np.ndarray]:
        """Standard deviations [M, 3], world units, and opacities [M]."""
        return np.exp(self.splats.log_scales), sigmoid(self.splats.opacity_logits)

    def gaussians(self, camera: Camera, visible: np.ndarray | None = None) -> Gaussians[np.ndarray]:
        """What a camera sees. `visible` [M] bool: splats to look at; all of them if not given."""
        from compgs.model.spherical_harmonics import view_colors

        s, (scales, opacities) = self.splats, self._activated
        chosen = slice(None) if visible is None else np.flatnonzero(visible)
        means = s.means[chosen]
        colors = view_colors(means, s.dc[chosen], s.rest[chosen], camera.center)
        return Gaussians(means, s.quaternions[chosen], scales[chosen], opacities[chosen], colors)

    def parts(self, camera: Camera, visible: np.ndarray | None = None) -> Iterator[Gaussians[np.ndarray]]:
        """The same, as one part: splats are in memory anyway."""
        yield self.gaussians(camera, visible)
