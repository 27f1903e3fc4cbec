"""The readable rasterizer against finite differences and the definition of its terms."""

import numpy as np
import pytest
import torch

from compgs.cameras import Camera
from compgs.gaussians import Gaussians
from compgs.render.settings import RasterSettings, jacobian_limits
from compgs.tensors.reference import project, rasterize_reference, rotation_matrices

CAMERA = Camera(np.eye(4), 20.0, 22.0, 6.0, 5.0, 12, 10)


def make_fields(count: int, seed: int = 0) -> list[torch.Tensor]:
    r = np.random.default_rng(seed)
    means = np.c_[r.uniform(-0.5, 0.5, (count, 2)), r.uniform(1.5, 3, count)]
    fields = (means, r.normal(size=(count, 4)), r.uniform(0.1, 0.4, (count, 3)), r.uniform(0.2, 0.9, count))
    return [torch.tensor(f, requires_grad=True) for f in (*fields, r.uniform(0, 1, (count, 3)))]


def test_gradients_agree_with_finite_differences():
    def image(*fields):
        result = rasterize_reference(Gaussians(*fields), CAMERA)
        return result.image[::3, ::3], result.transmittance[::3, ::3]

    assert torch.autograd.gradcheck(image, make_fields(3), eps=1e-7, atol=1e-5, rtol=1e-3)


def test_rotations_are_rotations_and_their_scale_does_not_matter():
    quaternions = torch.randn(20, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    matrices = rotation_matrices(quaternions)
    torch.testing.assert_close(matrices @ matrices.mT, torch.eye(3).double().expand(20, 3, 3))
    torch.testing.assert_close(torch.linalg.det(matrices), torch.ones(20).double())
    torch.testing.assert_close(matrices, rotation_matrices(-3 * quaternions))
    quarter = rotation_matrices(torch.tensor([[1.0, 0.0, 0.0, 1.0]]))[0]  # w, z: 90 degrees around z
    torch.testing.assert_close(quarter @ torch.tensor([1.0, 0, 0]), torch.tensor([0.0, 1, 0]))


def test_projected_covariance_is_that_of_projected_samples():
    fields = make_fields(1, seed=3)
    fields[2] = fields[2] * 0.01  # small: the projection is linear over it
    splats = project(Gaussians(*fields), CAMERA, RasterSettings(dilation=0.0))
    mean, quaternion, scale = (f.detach() for f in fields[:3])
    samples = torch.randn(200_000, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    points = mean + (samples * scale) @ rotation_matrices(quaternion)[0].T
    pixels = points[:, :2] / points[:, 2:] * torch.tensor([CAMERA.fx, CAMERA.fy])
    torch.testing.assert_close(splats.covariances[0].detach(), torch.cov(pixels.T), rtol=0.02, atol=1e-6)


def test_beyond_the_margin_the_jacobian_is_held():
    settings = RasterSettings()
    left, right, top, bottom = jacobian_limits(CAMERA, settings)
    assert (left, right) == pytest.approx((-6 / 20 - 0.3 * 6 / 20, 6 / 20 + 0.3 * 6 / 20))
    assert (top, bottom) == pytest.approx((-5 / 22 - 0.3 * 5 / 22, 5 / 22 + 0.3 * 5 / 22))
    covariances = []
    for x in (right * 2.0, right * 2.5):  # far outside, at the same depth
        fields = make_fields(1)
        fields[0] = torch.tensor([[2.0 * x, 0.0, 2.0]], dtype=torch.float64)
        covariances.append(project(Gaussians(*fields), CAMERA, settings).covariances)
    torch.testing.assert_close(*covariances)
