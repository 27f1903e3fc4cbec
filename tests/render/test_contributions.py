"""Contributions against weights that are multiplied out pixel by pixel in float64."""

import math

import numpy as np
import pytest
import torch

from compgs.cameras import Camera
from compgs.gaussians import Gaussians
from compgs.render import contributions, rasterize
from compgs.render.settings import DEFAULT_SETTINGS
from compgs.tensors.contributions import contributions as contributions_of_tensors
from compgs.tensors.reference import meets_image, project

CAMERA = Camera(np.eye(4), 30.0, 30.0, 12.0, 9.0, 24, 18)


def made_gaussians(count: int, seed: int = 0, dtype: torch.dtype = torch.float32) -> Gaussians:
    r = np.random.default_rng(seed)
    means = r.normal((0, 0, 2.5), 0.6, (count, 3))
    fields = (
        means, r.normal(size=(count, 4)), np.exp(r.normal(-2, 0.6, (count, 3))),
        r.uniform(0.01, 1, count), r.uniform(0, 1, (count, 3)),
    )  # fmt: skip
    return Gaussians(*(torch.tensor(f, dtype=dtype) for f in fields))


def as_arrays(gaussians: Gaussians[torch.Tensor]) -> Gaussians[np.ndarray]:
    return Gaussians(*(value.numpy() for value in vars(gaussians).values()))


def slow_twin(gaussians: Gaussians, camera: Camera) -> list[float]:
    """Transmittance x alpha summed over pixels, one pixel and one splat after the other."""
    s = DEFAULT_SETTINGS
    splats = project(gaussians, camera, s)
    visible = splats.drawn & meets_image(splats, gaussians, camera, s)
    order = [int(i) for i in torch.sort(splats.depths, stable=True).indices if visible[i]]
    inverses = torch.linalg.inv(splats.covariances)
    total = [0.0] * len(gaussians.means)
    for y in range(camera.height):
        for x in range(camera.width):
            through = 1.0
            for i in order:
                d = splats.means2d[i] - torch.tensor([x + 0.5, y + 0.5], dtype=torch.float64)
                alpha = float(gaussians.opacities[i]) * math.exp(-0.5 * float(d @ inverses[i] @ d))
                alpha = min(alpha, s.alpha_cap)
                if alpha < s.alpha_cutoff:
                    continue
                if through * (1 - alpha) <= s.transmittance_stop:
                    break
                total[i] += through * alpha
                through *= 1 - alpha
    return total


def test_contributions_are_the_blending_weights() -> None:
    exact = slow_twin(made_gaussians(40, dtype=torch.float64), CAMERA)
    found = contributions(as_arrays(made_gaussians(40)), CAMERA)
    assert found.tolist() == pytest.approx(exact, rel=2e-3, abs=2e-3)
    assert contributions_of_tensors(made_gaussians(40), CAMERA).tolist() == found.tolist()
    in_float64 = contributions_of_tensors(made_gaussians(40, dtype=torch.float64), CAMERA)
    assert in_float64.tolist() == pytest.approx(exact, rel=1e-9, abs=1e-9)


def test_contributions_and_background_share_the_image() -> None:
    gaussians = as_arrays(made_gaussians(300, seed=1))
    through = rasterize(gaussians, CAMERA).transmittance
    assert float(contributions(gaussians, CAMERA).sum()) == pytest.approx(
        float((1 - through).sum()), rel=1e-4
    )


def test_what_is_not_seen_contributes_nothing_and_nothing_keeps_a_gradient() -> None:
    gaussians = made_gaussians(20)
    gaussians.means[3] = torch.tensor([0.0, 0.0, -2.0])
    assert contributions(as_arrays(gaussians), CAMERA)[3] == 0
    with torch.no_grad():
        weights = contributions_of_tensors(gaussians, CAMERA)
    assert weights[3] == 0
    assert not weights.requires_grad and not gaussians.colors.requires_grad
