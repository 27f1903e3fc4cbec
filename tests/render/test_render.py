"""The public face of rendering."""

import dataclasses
import sys
from collections.abc import Iterator
from typing import ClassVar

import numpy as np
import pytest
import torch

import compgs
from compgs.cameras import Camera
from compgs.errors import ConfigError, MissingDependency
from compgs.gaussians import Gaussians
from compgs.render import RasterSettings, rasterize, render
from compgs.render.gsplat_backend import check_settings, load_gsplat
from compgs.render.rasterize import rasterize_parts

CAMERA = Camera(np.eye(4), 30.0, 30.0, 10.0, 8.0, 20, 16)


def make_gaussians(count: int) -> Gaussians:
    g = torch.Generator().manual_seed(0)
    means = torch.randn(count, 3, generator=g) + torch.tensor([0.0, 0.0, 3.0])
    opacities = torch.rand(count, generator=g)
    colors = torch.nn.Parameter(torch.rand(count, 3, generator=g))
    return Gaussians(
        means, torch.randn(count, 4, generator=g), torch.full((count, 3), 0.2), opacities, colors
    )


class PlainModel:
    """Draws the same fifty Gaussians wherever it is looked at from."""

    background = (0.1, 0.6, 0.3)
    world_offset = (0.0, 0.0, 0.0)
    bounds = (torch.tensor([[0.0, 0, 3], [0, 0, -3]]), torch.tensor([0.7, 0.7]))
    counts: ClassVar = {"splats": 50}
    most_gaussians = 50
    viewpoints = ()
    asked: torch.Tensor | None = None

    def gaussians(self, camera: Camera, visible: torch.Tensor | None = None) -> Gaussians:
        self.asked = visible
        return make_gaussians(50)

    def parts(self, camera: Camera, visible: torch.Tensor | None = None) -> Iterator[Gaussians]:
        yield self.gaussians(camera, visible)

    def over(self, background: tuple[float, float, float]) -> "PlainModel":
        raise NotImplementedError


def test_a_model_is_rendered_over_its_background_without_gradients():
    result = render(PlainModel(), CAMERA)
    expected = rasterize(PlainModel().gaussians(CAMERA), CAMERA, RasterSettings(PlainModel.background))
    assert result.image.shape == (16, 20, 3)
    assert torch.equal(result.image, expected.image.detach())
    assert not result.image.requires_grad


def test_gaussians_that_come_in_parts_give_the_image_of_all_of_them():
    whole = make_gaussians(300)
    fields = [f.name for f in dataclasses.fields(Gaussians)]

    def part(first: int, last: int) -> Gaussians:
        return Gaussians(*(getattr(whole, name).detach()[first:last] for name in fields))

    parts = (part(a, b) for a, b in ((0, 0), (0, 1), (1, 200), (200, 300)))
    found = rasterize_parts(parts, 1000, CAMERA)
    with torch.no_grad():
        expected = rasterize(whole, CAMERA)
    for name in ("image", "transmittance", "means2d", "visible"):
        assert torch.equal(getattr(found, name), getattr(expected, name))


def test_settings_replace_the_defaults():
    result = render(PlainModel(), CAMERA, RasterSettings(background=(1.0, 1.0, 1.0), near_plane=1e6))
    assert torch.all(result.image == 1)


def test_a_model_is_asked_for_anchors_in_view_only():
    model = PlainModel()
    render(model, CAMERA)
    assert model.asked is not None and model.asked.tolist() == [True, False]


def test_the_package_itself_renders():
    # a package and a function share the name: whichever was bound last, it can be called
    image = render(PlainModel(), CAMERA).image
    assert torch.equal(compgs.render(PlainModel(), CAMERA).image, image)
    assert torch.equal(sys.modules["compgs.render"](PlainModel(), camera=CAMERA).image, image)


def test_cuda_names_what_is_missing():
    if torch.cuda.is_available():
        pytest.skip("there is a CUDA device")
    with pytest.raises(MissingDependency, match="no CUDA device"):
        load_gsplat()


def test_a_missing_gsplat_names_the_install_line(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setitem(sys.modules, "gsplat", None)
    with pytest.raises(MissingDependency, match=r"pip install '\.\[cuda\]'"):
        load_gsplat()


def test_settings_that_gsplat_cannot_obey_are_refused():
    check_settings(RasterSettings(background=(1.0, 1.0, 1.0), near_plane=0.2, dilation=0.1))
    for change in (
        {"alpha_cutoff": 0.01},
        {"alpha_cap": 0.99},
        {"transmittance_stop": 1e-3},
        {"margin": 0.15},
    ):
        with pytest.raises(ConfigError, match="on CUDA only background, dilation, near_plane"):
            check_settings(dataclasses.replace(RasterSettings(), **change))


def test_cameras_of_the_world_are_moved_into_the_models_frame():
    class Far(PlainModel):
        world_offset = (4.2e6, 5.1e5, 3e3)
        seen: list[Camera] = []  # noqa: RUF012

        def gaussians(self, camera: Camera, visible: torch.Tensor | None = None) -> Gaussians:
            self.seen.append(camera)
            return make_gaussians(50)

    camera = CAMERA.moved(-np.array(Far.world_offset))
    image, again = render(Far(), camera).image, render(Far(), camera).image
    assert torch.allclose(image, render(PlainModel(), CAMERA).image, atol=1e-5)
    assert torch.equal(image, again)
    np.testing.assert_allclose(Far.seen[0].center, CAMERA.center, atol=1e-8)
    assert Far.seen[0] is Far.seen[1]  # so that what is kept for a camera is found again
    plain = render(PlainModel(), camera).image
    assert not torch.allclose(plain, image, atol=0.1)  # it was the offset that brought it back
