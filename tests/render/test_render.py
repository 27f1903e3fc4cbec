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
from compgs.render.rasterize import rasterize_parts
from compgs.tensors.gsplat_backend import check_settings, load_gsplat

CAMERA = Camera(np.eye(4), 30.0, 30.0, 10.0, 8.0, 20, 16)


def make_gaussians(count: int) -> Gaussians[np.ndarray]:
    r = np.random.default_rng(0)
    fields = (
        r.normal((0, 0, 3), 1, (count, 3)), r.normal(size=(count, 4)), np.full((count, 3), 0.2),
        r.random(count), r.random((count, 3)),
    )  # fmt: skip
    return Gaussians(*(field.astype(np.float32) for field in fields))


class PlainModel:
    """Draws the same fifty Gaussians wherever it is looked at from."""

    background = (0.1, 0.6, 0.3)
    angular_dilation: float | None = None
    antialiased: bool = False
    world_offset = (0.0, 0.0, 0.0)
    bounds = (np.array([[0.0, 0, 3], [0, 0, -3]], np.float32), np.array([0.7, 0.7], np.float32))
    counts: ClassVar = {"splats": 50}
    most_gaussians = 50
    viewpoints = ()
    asked: np.ndarray | None = None

    def gaussians(self, camera: Camera, visible: np.ndarray | None = None) -> Gaussians[np.ndarray]:
        self.asked = visible
        return make_gaussians(50)

    def parts(self, camera: Camera, visible: np.ndarray | None = None) -> Iterator[Gaussians[np.ndarray]]:
        yield self.gaussians(camera, visible)

    def over(self, background: tuple[float, float, float]) -> "PlainModel":
        raise NotImplementedError


def test_a_model_is_rendered_over_its_background():
    result = render(PlainModel(), CAMERA)
    expected = rasterize(PlainModel().gaussians(CAMERA), CAMERA, RasterSettings(PlainModel.background))
    assert result.image.shape == (16, 20, 3)
    assert isinstance(result.image, np.ndarray) and result.image.dtype == np.float32
    assert np.array_equal(result.image, expected.image)


def test_gaussians_that_come_in_parts_give_the_image_of_all_of_them():
    whole = make_gaussians(300)
    fields = [f.name for f in dataclasses.fields(Gaussians)]

    def part(first: int, last: int) -> Gaussians[np.ndarray]:
        return Gaussians(*(getattr(whole, name)[first:last] for name in fields))

    parts = (part(a, b) for a, b in ((0, 0), (0, 1), (1, 200), (200, 300)))
    found = rasterize_parts(parts, 1000, CAMERA)
    expected = rasterize(whole, CAMERA)
    for name in ("image", "transmittance", "means2d", "visible"):
        assert np.array_equal(getattr(found, name), getattr(expected, name))


def test_settings_replace_the_defaults():
    result = render(PlainModel(), CAMERA, RasterSettings(background=(1.0, 1.0, 1.0), near_plane=1e6))
    assert np.all(result.image == 1)


def test_an_angular_dilation_is_that_of_the_training_at_every_size_but_for_the_smallest():
    settings = RasterSettings(angular_dilation=0.3 / 30**2)
    for scale, pixels in ((1, 0.3), (2, 1.2), (0.5, 0.075), (0.1, 0.02)):
        camera = Camera(np.eye(4), 30.0 * scale, 30.0 * scale, 10.0, 8.0, 20, 16)
        assert settings.dilation_of(camera) == pytest.approx(pixels)
        assert RasterSettings(dilation=0.7).dilation_of(camera) == 0.7


@pytest.mark.parametrize("size", [2, 4])
def test_a_scene_with_an_angular_dilation_looks_larger_as_it_looks_small(size: int):
    """A larger picture, reduced, is the smaller one; with pixels it is sharper and paler."""
    thin = Gaussians(
        np.array([[0.0, 0, 3], [0.3, 0.2, 3]], np.float32), np.array([[1.0, 0, 0, 0]] * 2, np.float32),
        np.full((2, 3), 0.005, np.float32), np.array([0.9, 0.9], np.float32), np.ones((2, 3), np.float32),
    )  # fmt: skip

    class Thin(PlainModel):
        background = (0.0, 0.0, 0.0)

        def gaussians(self, camera: Camera, visible: np.ndarray | None = None) -> Gaussians[np.ndarray]:
            return thin

    large = Camera(np.eye(4), 30.0 * size, 30.0 * size, 10.0 * size, 8.0 * size, 20 * size, 16 * size)

    def away(model: PlainModel) -> float:
        small, big = render(model, CAMERA).image, render(model, large).image
        reduced = big.reshape(16, size, 20, size, 3).mean((1, 3))
        return float(np.abs(reduced - small).sum() / small.sum())

    fixed, angular = Thin(), Thin()
    angular.angular_dilation = 1.0 / 30**2
    assert away(angular) < 0.1
    assert away(fixed) > 0.5


def test_a_model_is_asked_for_anchors_in_view_only():
    model = PlainModel()
    render(model, CAMERA)
    assert model.asked is not None and model.asked.tolist() == [True, False]


def test_the_package_itself_renders():
    # a package and a function share the name: whichever was bound last, it can be called
    image = render(PlainModel(), CAMERA).image
    assert np.array_equal(compgs.render(PlainModel(), CAMERA).image, image)
    assert np.array_equal(sys.modules["compgs.render"](PlainModel(), camera=CAMERA).image, image)


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
        with pytest.raises(
            ConfigError, match="on CUDA only angular_dilation, antialiased, background, dilation, near_plane"
        ):
            check_settings(dataclasses.replace(RasterSettings(), **change))


def test_cameras_of_the_world_are_moved_into_the_models_frame():
    class Far(PlainModel):
        world_offset = (4.2e6, 5.1e5, 3e3)
        seen: list[Camera] = []  # noqa: RUF012

        def gaussians(self, camera: Camera, visible: np.ndarray | None = None) -> Gaussians[np.ndarray]:
            self.seen.append(camera)
            return make_gaussians(50)

    camera = CAMERA.moved(-np.array(Far.world_offset))
    image, again = render(Far(), camera).image, render(Far(), camera).image
    assert np.allclose(image, render(PlainModel(), CAMERA).image, atol=1e-5)
    assert np.array_equal(image, again)
    np.testing.assert_allclose(Far.seen[0].center, CAMERA.center, atol=1e-8)
    assert Far.seen[0] is Far.seen[1]  # so that what is kept for a camera is found again
    plain = render(PlainModel(), camera).image
    assert not np.allclose(plain, image, atol=0.1)  # it was the offset that brought it back
