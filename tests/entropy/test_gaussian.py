import re

import mpmath
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numba import njit

from compgs.entropy import gaussian
from compgs.entropy.gaussian import (
    SCALE_LEVELS,
    SCALE_MIN_LOG2,
    SCALES_PER_OCTAVE,
    gaussian_bits,
    index_from_scale,
    scale_from_index,
)


def exact(x, s):
    """Bits and their derivatives by x and by the scale index, in 60 digits."""
    with mpmath.workdps(60):
        sigma = mpmath.mpf(2) ** (mpmath.mpf(s) / SCALES_PER_OCTAVE + SCALE_MIN_LOG2)
        a = abs(mpmath.mpf(x))
        lower, upper = (a - 0.5) / sigma, (a + 0.5) / sigma
        root = mpmath.sqrt(2)
        p = (mpmath.erfc(lower / root) - mpmath.erfc(upper / root)) / 2
        phi_l, phi_u = mpmath.npdf(lower), mpmath.npdf(upper)
        by_x = -mpmath.sign(x) * (phi_u - phi_l) / sigma / p / mpmath.log(2)
        by_s = -(phi_l * lower - phi_u * upper) / p / SCALES_PER_OCTAVE
        return float(-mpmath.log(p, 2)), float(by_x), float(by_s)


def evaluate(x, s, dtype):
    """Bits and gradients of single elements."""
    x = torch.tensor(x, dtype=dtype).view(-1, 1).requires_grad_()
    s = torch.tensor(s, dtype=dtype).view(-1, 1).requires_grad_()
    bits = gaussian_bits(x, s)
    bits.sum().backward()
    return bits.detach().double().numpy(), x.grad.double().view(-1).numpy(), s.grad.double().view(-1).numpy()


# Values on and off the bins' edges, where float32 holds them exactly; up to 1e4 standard deviations.
GRID = [
    (x, s)
    for s in (0.0, 1.0, 30.5, 60.0, 61.25, 97.0, 120.0, 127.0)
    for x in (0.0, 0.125, -0.25, 0.5, -0.5, 0.625, 1.0, -3.0, 12.0, 40.0, -300.0)
] + [(312.5, 0.0), (-10000.0, 60.0), (480000.0, 127.0)]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=["fused", "torch"])
def test_bits_and_gradients_agree_with_sixty_digits(dtype):
    x, s = zip(*GRID, strict=True)
    bits, by_x, by_s = evaluate(x, s, dtype)
    truth = np.array([exact(*point) for point in GRID])
    np.testing.assert_allclose(bits, truth[:, 0], rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(by_x, truth[:, 1], rtol=2e-3, atol=1e-6)
    np.testing.assert_allclose(by_s, truth[:, 2], rtol=2e-3, atol=1e-6)


@settings(max_examples=40, deadline=None)
@given(
    st.lists(
        st.tuples(st.floats(-1e4, 1e4, width=32), st.floats(-20.0, 150.0, width=32)), min_size=1, max_size=40
    )
)
def test_fused_and_torch_agree_everywhere(points):
    x, s = zip(*points, strict=True)
    for fused, plain in zip(evaluate(x, s, torch.float32), evaluate(x, s, torch.float64), strict=True):
        assert np.isfinite(fused).all()
        np.testing.assert_allclose(fused, plain, rtol=2e-3, atol=1e-5)


def test_rows_are_summed_and_their_gradients_weighted():
    g = torch.Generator().manual_seed(0)
    x, s = torch.randn(700, 6, generator=g) * 4, torch.rand(700, 6, generator=g) * 160 - 20
    weight = torch.randn(700, generator=g)
    results = []
    for dtype in (torch.float32, torch.float64):
        a, b = x.to(dtype).requires_grad_(), s.to(dtype).requires_grad_()
        bits = gaussian_bits(a, b)
        results.append([bits, *torch.autograd.grad(bits, [a, b], weight.to(dtype))])
    for fused, plain in zip(*results, strict=True):
        assert fused.shape == plain.shape
        np.testing.assert_allclose(fused.detach(), plain.detach(), rtol=1e-3, atol=1e-4)


def test_probabilities_of_all_symbols_sum_to_one():
    symbols = torch.arange(-400.0, 401.0).view(-1, 1)
    for s in (0.0, 40.0, 77.7, 127.0):
        p = torch.exp2(-gaussian_bits(symbols, torch.full_like(symbols, s)).double())
        assert float(p.sum()) == pytest.approx(1.0, abs=1e-4)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=["fused", "torch"])
def test_outside_the_tables_only_a_gradient_that_leads_back_passes(dtype):
    # A symbol far from the mean wants a larger scale, one at the mean a smaller one.
    x = [50.0, 0.0, 5000.0, 0.0]
    s = [-4.0, -4.0, 130.0, 130.0]
    bits, _, by_s = evaluate(x, s, dtype)
    inside, _, _ = evaluate(x, [0.0, 0.0, 127.0, 127.0], dtype)
    # To a few units of the last place: a compiler may add in another order.
    np.testing.assert_allclose(bits, inside, rtol=2e-6)
    assert by_s[0] < 0 and by_s[3] > 0
    assert by_s[1] == 0 and by_s[2] == 0


def test_the_mean_of_noisy_bits_is_least_at_the_true_scale():
    """Descent on the scale index finds the spread of the data, from either end of the tables."""
    g = torch.Generator().manual_seed(0)
    sigma = 3.0
    x = sigma * torch.randn(4000, 1, generator=g) + torch.rand(4000, 1, generator=g) - 0.5
    for start in (-3.0, 129.0):
        s = torch.tensor(start, requires_grad=True)
        optimizer = torch.optim.Adam([s], lr=1.0, betas=(0.9, 0.9))
        for step in range(250):
            optimizer.param_groups[0]["lr"] = 1.0 - step / 260
            optimizer.zero_grad()
            gaussian_bits(x, s.expand(4000, 1)).mean().backward()
            optimizer.step()
        assert float(scale_from_index(s.detach())) == pytest.approx(sigma, rel=0.05)


def test_scale_and_index_are_inverse_and_an_octave_is_twelve_tables():
    s = torch.arange(float(SCALE_LEVELS))
    sigma = scale_from_index(s)
    torch.testing.assert_close(index_from_scale(sigma), s)
    assert float(sigma[0]) == 1 / 32
    assert float(sigma[60]) == 1.0
    torch.testing.assert_close(sigma[12:], 2 * sigma[:-12])


def test_not_a_number_is_not_hidden():
    nan = float("nan")
    x, s = torch.tensor([[nan], [1.0], [1.0]]), torch.tensor([[60.0], [nan], [60.0]])
    for dtype in (torch.float32, torch.float64):
        assert gaussian_bits(x.to(dtype), s.to(dtype)).isnan().tolist() == [True, True, False]


def test_no_rows_and_strided_inputs_are_taken():
    assert gaussian_bits(torch.zeros(0, 4), torch.zeros(0, 4)).shape == (0,)
    x, s = torch.randn(4, 9).t(), torch.rand(9, 8)[:, ::2] * 127
    torch.testing.assert_close(gaussian_bits(x, s), gaussian_bits(x.contiguous(), s.contiguous()))


def test_the_kernel_is_compiled_to_vector_instructions():
    """Losing them is silent otherwise, and costs a factor of five."""
    kernel = gaussian.element_bits
    fresh = njit(kernel.py_func, **{k: v for k, v in kernel.targetoptions.items() if k != "nopython"})
    fresh(*[np.ones(4, np.float32) for _ in range(5)])
    (code,) = fresh.inspect_llvm().values()
    assert re.search(r"fdiv [a-z ]*<(4|8|16) x float>", code)


def test_bits_are_the_same_with_and_without_gradients():
    x, s = torch.randn(300, 6), torch.rand(300, 6) * 127
    assert torch.equal(gaussian_bits(x, s), gaussian_bits(x.requires_grad_(), s).detach())


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_cuda_agrees_with_the_cpu():
    x, s = torch.randn(500, 8) * 20, torch.rand(500, 8) * 127
    torch.testing.assert_close(
        gaussian_bits(x.cuda(), s.cuda()).cpu(), gaussian_bits(x, s), rtol=1e-4, atol=1e-3
    )
