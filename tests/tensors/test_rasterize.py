"""The CPU rasterizer against the reference in float64, closed forms and itself."""

import dataclasses

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from compgs.cameras import Camera
from compgs.gaussians import Gaussians
from compgs.render import RasterResult, RasterSettings
from compgs.render.binning import TILE_HEIGHT, TILE_WIDTH
from compgs.tensors.rasterize import rasterize

BACKGROUND = RasterSettings(background=(0.2, 0.5, 0.9))
FIELDS = [f.name for f in dataclasses.fields(Gaussians)]


def make_camera(width: int = 53, height: int = 37, distance: float = 3.0) -> Camera:
    """Looks at the origin from a distance, turned a little, principal point off centre."""
    turn = np.array([[0.96, 0.0, 0.28], [0.0, 1.0, 0.0], [-0.28, 0.0, 0.96]])
    pose = np.eye(4)
    pose[:3, :3] = turn
    pose[:3, 3] = (0.1, -0.05, distance)
    return Camera(pose, 60.0, 55.0, 0.48 * width, 0.53 * height, width, height)


def make_gaussians(seed: int, count: int = 120) -> Gaussians:
    """float32; all around the camera: behind it, outside the image, tiny, huge, opaque and transparent."""
    r = np.random.default_rng(seed)
    means = r.normal(0, 1.2, (count, 3)) * (1, 1, 1.5)
    scales = np.exp(r.normal(-2, 1, (count, 3)))
    opacities = 1 / (1 + np.exp(-r.normal(0, 2.5, count)))
    means[:6, 2] = r.uniform(1, 3, 6)  # the special ones in front of the camera
    scales[:2], scales[2:4] = 3.0, 1e-4  # huge, tiny
    opacities[2:6], opacities[6:9] = 1.0, 0.0  # opaque, transparent
    means[9:12, 2] = -5.0  # behind the camera
    means[12:15, 0] = 3.0  # beside the image
    fields = (means, r.normal(size=(count, 4)), scales, opacities, r.uniform(0, 1, (count, 3)))
    return Gaussians(*(torch.tensor(f, dtype=torch.float32) for f in fields))


def leaves(gaussians: Gaussians, dtype: torch.dtype) -> Gaussians:
    return Gaussians(*(getattr(gaussians, n).detach().to(dtype).clone().requires_grad_() for n in FIELDS))


def gradients(gaussians: Gaussians, camera: Camera, settings: RasterSettings) -> tuple[RasterResult, dict]:
    """Result, and the gradients of a random linear function of image and transmittance."""
    generator = torch.Generator().manual_seed(0)
    weights = torch.randn(camera.height, camera.width, 4, generator=generator).to(gaussians.means.dtype)
    result = rasterize(gaussians, camera, settings)
    result.means2d.retain_grad()
    ((result.image * weights[..., :3]).sum() + (result.transmittance * weights[..., 3]).sum()).backward()
    found = {n: getattr(gaussians, n).grad for n in FIELDS}
    return result, found | {"means2d": result.means2d.grad}


@pytest.mark.parametrize("seed", range(4))
def test_image_and_gradients_agree_with_float64_autograd(seed):
    camera, gaussians = make_camera(), make_gaussians(seed)
    true, true_gradients = gradients(leaves(gaussians, torch.float64), camera, BACKGROUND)
    fast, fast_gradients = gradients(leaves(gaussians, torch.float32), camera, BACKGROUND)

    torch.testing.assert_close(fast.image.double(), true.image, rtol=0, atol=2e-6)
    torch.testing.assert_close(fast.transmittance.double(), true.transmittance, rtol=0, atol=2e-6)
    assert torch.equal(fast.visible, true.visible)
    for name, expected in true_gradients.items():
        error = (fast_gradients[name] - expected).abs().max() / expected.abs().max()
        assert error < 1e-4, f"{name}: {error:.1e} of the largest gradient"


def test_gradients_of_long_thin_splats_agree_with_float64_autograd():
    gaussians = make_gaussians(5, 40)
    gaussians = dataclasses.replace(gaussians, scales=torch.tensor([2.0, 0.005, 0.005]).repeat(40, 1))
    _, true = gradients(leaves(gaussians, torch.float64), make_camera(), BACKGROUND)
    _, fast = gradients(leaves(gaussians, torch.float32), make_camera(), BACKGROUND)
    for name, expected in true.items():
        error = (fast[name] - expected).abs().max() / expected.abs().max()
        assert error < 1e-3, f"{name}: {error:.1e} of the largest gradient"


ANTIALIASED = dataclasses.replace(BACKGROUND, antialiased=True)


@pytest.mark.parametrize("seed", range(4))
def test_antialiased_images_agree_with_float64(seed):
    camera, gaussians = make_camera(), make_gaussians(seed)
    true = rasterize(leaves(gaussians, torch.float64), camera, ANTIALIASED)
    fast, plain = (rasterize(gaussians, camera, s) for s in (ANTIALIASED, BACKGROUND))
    # Float32 tells the determinants before and after dilation apart to a few parts in ten million.
    torch.testing.assert_close(fast.image.double(), true.image, rtol=0, atol=2e-4)
    torch.testing.assert_close(fast.transmittance.double(), true.transmittance, rtol=0, atol=2e-4)
    assert (fast.image - plain.image).abs().max() > 0.02


def test_gradients_of_antialiased_splats_agree_with_float64_autograd():
    camera, gaussians = make_camera(), make_gaussians(0)
    _, true = gradients(leaves(gaussians, torch.float64), camera, ANTIALIASED)
    _, found = gradients(leaves(gaussians, torch.float32), camera, ANTIALIASED)
    for name, expected in true.items():
        error = (found[name] - expected).abs().max() / expected.abs().max()
        assert error < 1e-3, f"{name}: {error:.1e} of the largest gradient"


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("scale", [0.3, 0.03, 0.003])
def test_an_antialiased_splat_has_as_much_light_as_it_has_without_dilation(scale, dtype):
    """Of a round splat of variance v the opacity falls by v / (v + 0.3): the area under it stays."""
    camera = straight_camera(65, 65)
    gaussians = Gaussians(*(getattr(on_axis([2.0], [1.0], scale), n).to(dtype) for n in FIELDS))
    settings = RasterSettings(antialiased=True, alpha_cutoff=1e-6)
    through = rasterize(gaussians, camera, settings).transmittance.numpy()
    variance = (50.0 * scale / 2.0) ** 2
    y, x = np.mgrid[0:65, 0:65] + 0.5 - 32.5
    alpha = variance / (variance + 0.3) * np.exp(-(x**2 + y**2) / (2 * (variance + 0.3)))
    np.testing.assert_allclose(1 - through, np.minimum(alpha, 0.999), atol=3e-5)
    if scale == 0.03:
        assert (1 - through).sum() == pytest.approx(2 * np.pi * variance, rel=1e-3)


def on_axis(depths: list[float], opacities: list[float], scale: float = 0.1) -> Gaussians:
    """Isotropic Gaussians in front of a camera at the origin; colors red, green, blue in turn."""
    n = len(depths)
    return Gaussians(
        torch.tensor([[0.0, 0.0, z] for z in depths]),
        torch.tensor([[1.0, 0.0, 0.0, 0.0]] * n),
        torch.full((n, 3), scale),
        torch.tensor(opacities),
        torch.eye(3).repeat(n, 1)[:n],
    )


def straight_camera(width: int = 33, height: int = 33, focal: float = 50.0) -> Camera:
    return Camera(np.eye(4), focal, focal, width / 2, height / 2, width, height)


def test_one_gaussian_has_its_closed_form():
    camera, opacity, depth = straight_camera(), 0.7, 2.0
    image = rasterize(on_axis([depth], [opacity]), camera, BACKGROUND).image.numpy()

    variance = (50.0 * 0.1 / depth) ** 2 + 0.3
    y, x = np.mgrid[0:33, 0:33] + 0.5 - 16.5
    alpha = opacity * np.exp(-(x**2 + y**2) / (2 * variance))
    alpha[alpha < 1 / 255] = 0
    expected = alpha[..., None] * [1, 0, 0] + (1 - alpha[..., None]) * BACKGROUND.background
    np.testing.assert_allclose(image, expected, atol=1e-6)


def test_nearer_splats_cover_farther_ones_whatever_their_order():
    centre = (16, 16)
    for depths in ([1.0, 2.0], [2.0, 1.0]):
        image = rasterize(on_axis(depths, [0.6, 0.6]), straight_camera()).image[centre]
        near, far = (0, 1) if depths[0] < depths[1] else (1, 0)
        assert image[near] == pytest.approx(0.6, abs=1e-6)
        assert image[far] == pytest.approx(0.4 * 0.6, abs=1e-6)


def test_equal_depths_are_drawn_in_the_order_of_the_input():
    image = rasterize(on_axis([1.0] * 3, [0.5, 0.5, 0.5]), straight_camera()).image[16, 16]
    assert image.tolist() == pytest.approx([0.5, 0.25, 0.125], abs=1e-6)


def test_a_finished_pixel_hides_what_is_behind():
    depths = [1.0, 1.1, 1.2, 1.3]
    result = rasterize(on_axis(depths, [1.0, 0.5, 0.9, 1.0]), straight_camera())
    # 0.999 is the cap; 0.001 * 0.5 lets 5e-4 through; the third would leave 5e-5, under the stop: left out
    assert result.image[16, 16].tolist() == pytest.approx([0.999, 0.0005, 0], abs=1e-6)
    assert result.transmittance[16, 16].item() == pytest.approx(5e-4, abs=1e-7)


def test_gaussians_before_the_near_plane_get_exactly_zero_gradients():
    gaussians = leaves(on_axis([0.005, -1.0, 1.0], [0.9, 0.9, 0.9]), torch.float32)
    result, found = gradients(gaussians, straight_camera(), BACKGROUND)
    assert result.visible.tolist() == [False, False, True]
    for gradient in found.values():
        assert torch.all(gradient[:2] == 0)
    assert found["means"][2].abs().max() > 0


@pytest.mark.parametrize("near", [None, 0.5])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_near_plane_is_a_hundredth_of_a_unit_or_where_the_settings_have_it(near, dtype):
    at = near or 0.01
    gaussians = leaves(on_axis([0.99 * at, 1.01 * at, 2.0], [0.5, 0.5, 0.5]), dtype)
    settings = RasterSettings() if near is None else RasterSettings(near_plane=near)
    result = rasterize(gaussians, straight_camera(), settings)
    assert result.visible.tolist() == [False, True, True]


def test_no_gaussians_give_the_background():
    empty = leaves(make_gaussians(0), torch.float32)
    empty = Gaussians(*(getattr(empty, n)[:0].detach().requires_grad_() for n in FIELDS))
    result, found = gradients(empty, make_camera(), BACKGROUND)
    assert torch.allclose(result.image, torch.tensor(BACKGROUND.background).expand_as(result.image))
    assert torch.all(result.transmittance == 1)
    assert all(len(g) == 0 for g in found.values())


@settings(max_examples=20, deadline=None)
@given(st.integers(1, 3 * TILE_WIDTH + 1), st.integers(1, 2 * TILE_HEIGHT + 1), st.integers(0, 99))
def test_any_image_size_agrees_with_the_reference(width, height, seed):
    camera, gaussians = make_camera(width, height), make_gaussians(seed, 40)
    fast = rasterize(gaussians, camera, BACKGROUND)
    true = rasterize(leaves(gaussians, torch.float64), camera, BACKGROUND)
    # The largest error one decision at the alpha cutoff can make: float32 and float64 may differ there.
    assert fast.image.shape == (height, width, 3)
    assert (fast.image - true.image).abs().max() < 1.5 / 255
    assert torch.sum((fast.image - true.image).abs() > 1e-5) <= 3


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf")])
@pytest.mark.parametrize("field", FIELDS)
def test_gaussians_that_are_not_finite_are_not_drawn(field, bad):
    gaussians = make_gaussians(1)
    broken = dataclasses.replace(gaussians, **{field: getattr(gaussians, field).clone()})
    getattr(broken, field)[::3] = bad
    kept = torch.ones(len(gaussians), dtype=torch.bool)
    kept[::3] = False
    without = Gaussians(*(getattr(gaussians, n)[kept] for n in FIELDS))

    result, found = gradients(leaves(broken, torch.float32), make_camera(), BACKGROUND)
    assert torch.equal(result.image, rasterize(without, make_camera(), BACKGROUND).image)
    assert not result.visible[~kept].any()
    for gradient in found.values():
        assert torch.all(gradient[~kept] == 0)
        assert torch.isfinite(gradient).all()


@pytest.mark.parametrize("value", [1e30, -1e30, 1e-30, 0.0])
@pytest.mark.parametrize("field", FIELDS)
def test_absurd_values_neither_crash_nor_hang(field, value):
    gaussians = make_gaussians(2)
    getattr(gaussians, field)[::3] = value
    result, _ = gradients(leaves(gaussians, torch.float32), make_camera(), BACKGROUND)
    assert torch.isfinite(result.image).all()


def test_splats_that_would_exhaust_memory_are_refused():
    many = 1 << 12
    gaussians = on_axis([1.0] * many, [0.5] * many, scale=1.0)
    camera = straight_camera(1 << 13, 1 << 13, focal=1e4)
    with pytest.raises(MemoryError, match=r"4096 visible Gaussians cover \d+ tiles"):
        rasterize(gaussians, camera)


def test_the_same_bits_with_one_thread_and_with_two(with_threads):
    camera, gaussians = make_camera(150, 90), make_gaussians(3, 700)
    results = []
    for threads in (1, 2):
        with_threads(threads)
        results.append(gradients(leaves(gaussians, torch.float32), camera, BACKGROUND))
    (one, one_gradients), (two, two_gradients) = results
    assert torch.equal(one.image, two.image)
    assert torch.equal(one.transmittance, two.transmittance)
    for name in one_gradients:
        assert torch.equal(one_gradients[name], two_gradients[name]), name


def test_without_gradients_the_image_is_the_same():
    gaussians = make_gaussians(4)
    with torch.no_grad():
        plain = rasterize(gaussians, make_camera(), BACKGROUND)
    tracked = rasterize(leaves(gaussians, torch.float32), make_camera(), BACKGROUND)
    assert torch.equal(plain.image, tracked.image)
    assert not plain.image.requires_grad and plain.image.grad_fn is None


def test_inputs_that_are_not_contiguous_are_accepted():
    gaussians = make_gaussians(6)
    strided = Gaussians(*(torch.stack([getattr(gaussians, n)] * 2, -1)[..., 0] for n in FIELDS))
    a = rasterize(gaussians, make_camera(), BACKGROUND)
    b = rasterize(strided, make_camera(), BACKGROUND)
    assert torch.equal(a.image, b.image)


def test_the_settings_are_obeyed():
    camera, gaussians = make_camera(), make_gaussians(7)
    other = RasterSettings((1.0, 0.0, 0.5), 2.5, 1.0, 0.02, 0.8, 0.05, 0.1)
    true, true_gradients = gradients(leaves(gaussians, torch.float64), camera, other)
    fast, fast_gradients = gradients(leaves(gaussians, torch.float32), camera, other)
    torch.testing.assert_close(fast.image.double(), true.image, rtol=0, atol=2e-6)
    for name, expected in true_gradients.items():
        assert (fast_gradients[name] - expected).abs().max() < 1e-4 * expected.abs().max(), name
