import math

import numpy as np
import pytest
import torch
from scipy.special import lpmv

from compgs.tensors.spherical_harmonics import (
    coefficients,
    dc_from_color,
    harmonic_basis,
    view_colors,
    view_colors_reference,
)

CENTER = torch.tensor([0.3, -0.2, 0.9])


def made(count: int, dtype=torch.float32):
    """Means, dc, rest; large coefficients, so that some colors are clamped."""
    g = torch.Generator().manual_seed(0)
    draw = lambda *shape: torch.randn(*shape, generator=g).to(dtype)  # noqa: E731
    return draw(count, 3), draw(count, 3), draw(count, 15, 3)


def real_harmonic(degree: int, order: int, directions: np.ndarray) -> np.ndarray:
    """Orthonormal, from SciPy's associated Legendre functions, which carry the Condon-Shortley phase."""
    m, azimuth = abs(order), np.arctan2(directions[:, 1], directions[:, 0])
    norm = (2 * degree + 1) / (4 * np.pi) * math.factorial(degree - m) / math.factorial(degree + m)
    value = np.sqrt(norm) * lpmv(m, degree, directions[:, 2])
    if order == 0:
        return value
    return np.sqrt(2) * value * (np.sin(m * azimuth) if order < 0 else np.cos(m * azimuth))


def test_the_basis_is_that_of_scipy_band_by_band():
    directions = torch.nn.functional.normalize(made(200, torch.float64)[0], dim=1)
    basis = harmonic_basis(directions, 3).numpy()
    index = 0
    for degree in range(4):
        for order in range(-degree, degree + 1):
            expected = real_harmonic(degree, order, directions.numpy())
            np.testing.assert_allclose(basis[:, index], expected, atol=1e-12, err_msg=f"{degree}, {order}")
            index += 1
    assert index == coefficients(3)


def test_the_basis_has_the_signs_of_3dgs_files():
    x, y, z = harmonic_basis(torch.eye(3, dtype=torch.float64), 1)
    c = np.sqrt(3 / (4 * np.pi))
    np.testing.assert_allclose(x[1:], [0, 0, -c], atol=1e-15)
    np.testing.assert_allclose(y[1:], [-c, 0, 0], atol=1e-15)
    np.testing.assert_allclose(z[1:], [0, c, 0], atol=1e-15)


def test_the_coefficient_of_a_color_gives_that_color_from_everywhere():
    colors = torch.rand(50, 3, generator=torch.Generator().manual_seed(1))
    means, _, _ = made(50)
    seen = view_colors(means, dc_from_color(colors), torch.zeros(50, 15, 3), CENTER, 3)
    assert torch.allclose(seen, colors, atol=1e-6)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_colors_and_gradients_are_those_of_float64_autograd(degree):
    inputs = [t.requires_grad_() for t in made(1500)]
    exact = [t.detach().double().requires_grad_() for t in inputs]
    visible = torch.arange(1500) % 5 != 0
    weights = torch.randn(1500, 3, generator=torch.Generator().manual_seed(2))
    colors = view_colors(*inputs, CENTER, degree, visible)
    truth = view_colors_reference(*exact, CENTER.double(), degree, visible)
    assert (truth == 0).any() and torch.allclose(colors.double(), truth, atol=2e-6)
    (colors * weights).sum().backward()
    (truth * weights.double()).sum().backward()
    for name, fast, slow in zip(("means", "dc", "rest"), inputs, exact, strict=True):
        if slow.grad is None:  # degree 0 looks at nothing but dc
            assert not fast.grad.any()
            continue
        scale = slow.grad.abs().amax(tuple(range(1, slow.grad.dim())), keepdim=True).clamp_min(1e-3)
        assert ((fast.grad.double() - slow.grad) / scale).abs().max() < 2e-4, name


def test_fewer_coefficients_than_three_degrees_are_enough_for_a_lower_degree():
    means, dc, rest = made(100)
    full = view_colors(means, dc, rest, CENTER, 1)
    assert torch.equal(full, view_colors(means, dc, rest[:, :3].contiguous(), CENTER, 1))
    assert torch.equal(
        view_colors(means, dc, rest[:, :0], CENTER, 0), view_colors(means, dc, rest, CENTER, 0)
    )


def test_a_splat_at_the_camera_gives_finite_colors_and_gradients():
    inputs = [t.requires_grad_() for t in (CENTER[None].clone(), torch.ones(1, 3), torch.ones(1, 15, 3))]
    view_colors(*inputs, CENTER, 3).sum().backward()
    assert all(torch.isfinite(t.grad).all() for t in inputs)


def test_gradients_do_not_depend_on_the_number_of_threads(with_threads):
    results = []
    for threads in (1, 2):
        with_threads(threads)
        inputs = [t.requires_grad_() for t in made(5000)]
        view_colors(*inputs, CENTER, 3).square().sum().backward()
        results.append([t.grad for t in inputs])
    assert all(torch.equal(a, b) for a, b in zip(*results, strict=True))
