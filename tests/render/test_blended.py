"""Gradients of an image by opacities and colors, on arrays, against plain torch in float64."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from compgs.cameras import Camera
from compgs.gaussians import Gaussians
from compgs.model.splats import SplatArrays, SplatModel
from compgs.render import RasterSettings, blend_of, blended, rasterize
from compgs.tensors.reference import rasterize_reference
from compgs.tensors.scenes import SplatsOnDevice

CAMERA = Camera(np.eye(4), 30.0, 30.0, 12.0, 9.0, 24, 18)
SETTINGS = RasterSettings(background=(0.2, 0.5, 0.9))


def made(count: int = 60) -> Gaussians[np.ndarray]:
    r = np.random.default_rng(0)
    fields = (
        r.normal((0, 0, 2.5), 0.6, (count, 3)), r.normal(size=(count, 4)), np.exp(r.normal(-2, 0.6, (count, 3))),
        r.uniform(0.01, 0.95, count), r.uniform(0, 1, (count, 3)),
    )  # fmt: skip
    return Gaussians(*(field.astype(np.float32) for field in fields))


@pytest.mark.parametrize("settings", [SETTINGS, replace(SETTINGS, antialiased=True)])
def test_the_image_is_that_without_gradients(settings: RasterSettings) -> None:
    assert np.array_equal(blended(made(), CAMERA, settings).image, rasterize(made(), CAMERA, settings).image)


@pytest.mark.parametrize("antialiased", [False, True], ids=["plain", "antialiased"])
@pytest.mark.parametrize("by_torch", [False, True], ids=["kernels", "on a device"])
def test_gradients_are_those_of_float64_autograd(by_torch: bool, antialiased: bool) -> None:
    settings = replace(SETTINGS, antialiased=antialiased)
    gaussians = made()
    exact = Gaussians(*(torch.from_numpy(v).double() for v in vars(gaussians).values()))
    wanted = exact.opacities.requires_grad_(), exact.colors.requires_grad_()
    image = rasterize_reference(exact, CAMERA, settings).image
    d_image = np.random.default_rng(1).normal(size=image.shape).astype(np.float32)
    expected = torch.autograd.grad(image, wanted, torch.from_numpy(d_image).double())
    nothing = SplatArrays(*(np.zeros((0, n), np.float32) for n in (3, 3, 4, 1, 3, 0)))
    scene = SplatsOnDevice(nothing, (0, 0, 0)) if by_torch else SplatModel(nothing, (0, 0, 0))
    drawn = blend_of(scene)(gaussians, CAMERA, settings)
    np.testing.assert_allclose(drawn.image, image.detach(), atol=1e-4)
    for found, exactly in zip(drawn.gradients(d_image), expected, strict=True):
        assert found.dtype == np.float32
        assert np.linalg.norm(found - exactly.numpy()) < 1e-3 * np.linalg.norm(exactly.numpy())
