import numpy as np
import pytest
import torch

from compgs.cameras import Camera
from compgs.model.splats import SplatModel
from compgs.render import rasterize, render
from compgs.render.settings import RasterSettings
from compgs.tensors.spherical_harmonics import view_colors_reference
from compgs.tensors.splats import Splats

CAMERA = Camera(np.eye(4), 60.0, 60.0, 32.0, 24.0, 64, 48)


def made(count: int, degree: int = 3) -> Splats:
    """In front of the camera, beside it and behind it."""
    g = torch.Generator().manual_seed(0)
    draw = lambda *shape: torch.randn(*shape, generator=g)  # noqa: E731
    return Splats(
        means=draw(count, 3) * torch.tensor([4.0, 4.0, 2.0]) + torch.tensor([0.0, 0.0, 2.0]),
        log_scales=draw(count, 3) * 0.4 - 1.5,
        quaternions=draw(count, 4),
        opacity_logits=draw(count) * 2,
        dc=draw(count, 3),
        rest=draw(count, (degree + 1) ** 2 - 1, 3) * 0.3,
    )


def test_activations_are_exp_and_sigmoid_and_colors_those_of_the_direction() -> None:
    splats = made(20)
    seen = SplatModel(splats.arrays(), (0.0, 0.0, 0.0)).gaussians(CAMERA)
    np.testing.assert_allclose(seen.scales, splats.log_scales.exp(), rtol=1e-6)
    np.testing.assert_allclose(seen.opacities, splats.opacity_logits.sigmoid(), rtol=1e-6)
    expected = view_colors_reference(splats.means, splats.dc, splats.rest, torch.zeros(3), 3)
    assert np.allclose(seen.colors, expected, atol=1e-6)


@pytest.mark.parametrize("degree", [0, 2])
def test_leaving_out_what_no_pixel_sees_changes_no_pixel(degree: int) -> None:
    model = SplatModel(made(400, degree).arrays(), (0.2, 0.4, 0.9))
    assert model.splats.degree == degree
    culled = render(model, CAMERA)
    everything = rasterize(model.gaussians(CAMERA), CAMERA, RasterSettings(background=model.background))
    assert len(culled.visible) < 400
    assert np.allclose(culled.image, everything.image, atol=1e-5)
