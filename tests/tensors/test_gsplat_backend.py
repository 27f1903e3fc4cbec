"""gsplat on CUDA against the reference."""

import dataclasses

import numpy as np
import pytest
import torch

from compgs.cameras import Camera
from compgs.gaussians import Gaussians
from compgs.render import RasterSettings
from compgs.tensors.rasterize import rasterize
from compgs.tensors.reference import rasterize_reference

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device"),
]
FIELDS = [f.name for f in dataclasses.fields(Gaussians)]
SETTINGS = RasterSettings(background=(0.2, 0.5, 0.9))
CAMERA = Camera(
    np.array([[1.0, 0, 0, 0.1], [0, 1, 0, 0], [0, 0, 1, 3], [0, 0, 0, 1]]), 60, 55, 26, 19, 53, 37
)


def make_gaussians(dtype: torch.dtype, device: str, count: int = 150) -> Gaussians:
    r = np.random.default_rng(0)
    means = r.normal(0, 1.2, (count, 3)) * (1, 1, 1.5)
    scales = np.exp(r.normal(-2, 1, (count, 3)))
    opacities = 1 / (1 + np.exp(-r.normal(0, 2.5, count)))
    fields = (means, r.normal(size=(count, 4)), scales, opacities, r.uniform(0, 1, (count, 3)))
    return Gaussians(*(torch.tensor(f, dtype=dtype, device=device).requires_grad_() for f in fields))


def backward(result, generator_seed: int = 0):
    weights = torch.randn(37, 53, 4, generator=torch.Generator().manual_seed(generator_seed)).to(result.image)
    result.means2d.retain_grad()
    ((result.image * weights[..., :3]).sum() + (result.transmittance * weights[..., 3]).sum()).backward()


@pytest.mark.parametrize("antialiased", [False, True])
def test_image_and_gradients_agree_with_float64_autograd(antialiased):
    settings = dataclasses.replace(SETTINGS, antialiased=antialiased)
    true_in, fast_in = make_gaussians(torch.float64, "cpu"), make_gaussians(torch.float32, "cuda")
    true, fast = rasterize_reference(true_in, CAMERA, settings), rasterize(fast_in, CAMERA, settings)
    backward(true)
    backward(fast)
    # gsplat ends a splat at 3.33 standard deviations, slightly before an opaque one reaches the alpha cutoff.
    difference = (fast.image.cpu() - true.image).abs()
    assert difference.max() < 2.5 / 255 and difference.mean() < 1e-4
    for name in FIELDS:
        expected, found = getattr(true_in, name).grad, getattr(fast_in, name).grad.cpu()
        assert (found - expected).norm() < 0.01 * expected.norm(), name
    assert (fast.means2d.grad.cpu() - true.means2d.grad).norm() < 0.01 * true.means2d.grad.norm()


def test_no_gaussians_give_the_background_on_cuda():
    empty = Gaussians(*(getattr(make_gaussians(torch.float32, "cuda"), n)[:0] for n in FIELDS))
    image = rasterize(empty, CAMERA, SETTINGS).image
    assert torch.allclose(image, torch.tensor(SETTINGS.background, device="cuda").expand_as(image))
