import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from compgs.entropy.factorized import SMALLEST_PROBABILITY, TAIL_BITS, FactorizedDensity


def made_up(channels=3, reach=24, seed=0):
    """A density that is far from smooth and from symmetric."""
    density = FactorizedDensity(channels, reach)
    with torch.no_grad():
        density.logits.add_(
            2.0 * torch.randn(density.logits.shape, generator=torch.Generator().manual_seed(seed))
        )
    return density


def mass_by_integration(p, z, pieces=2000):
    """Mass of [z - 1/2, z + 1/2] of the piecewise constant density with unit bins, by a Riemann sum."""
    points = z - 0.5 + (np.arange(pieces) + 0.5) / pieces
    return p[np.rint(points).astype(int) + len(p) // 2].mean()


def test_probabilities_sum_to_one_and_none_vanishes():
    density = made_up()
    with torch.no_grad():
        density.logits[0, 3] = -1000.0
        density.logits[1, 5] = 1000.0
    p = density.probabilities()
    assert p.shape == (3, 49)
    torch.testing.assert_close(p.sum(1), torch.ones(3))
    assert float(p.detach().min()) >= 0.999 * SMALLEST_PROBABILITY


def test_it_starts_as_a_discretized_logistic():
    p = FactorizedDensity(2, reach=10, scale=1.5).probabilities().detach().double().numpy()
    k = np.arange(-10, 11)
    sigmoid = lambda t: 1 / (1 + np.exp(-t))  # noqa: E731
    logistic = sigmoid((k + 0.5) / 1.5) - sigmoid((k - 0.5) / 1.5)
    np.testing.assert_allclose(p[0], logistic, rtol=5e-3, atol=3e-5)
    np.testing.assert_array_equal(p[0], p[1])


def test_bits_of_symbols_are_those_of_the_table():
    density = made_up()
    symbols = torch.arange(-24.0, 25.0)
    bits = density.bits(symbols[:, None].expand(49, 3))
    torch.testing.assert_close(bits, -density.probabilities().log2().sum(0))


@settings(max_examples=40, deadline=None)
@given(st.floats(-23.5, 23.5))
def test_the_mass_between_symbols_is_the_integral_of_the_density(z):
    density = made_up(channels=1)
    p = density.probabilities().detach().double().numpy()[0]
    bits = density.bits(torch.tensor([[z]])).item()
    assert 2.0**-bits == pytest.approx(mass_by_integration(p, z), rel=5e-3, abs=2e-3 * p.max())


def test_fused_and_torch_agree_with_their_gradients():
    g = torch.Generator().manual_seed(5)
    z = torch.cat(
        [torch.randn(900, 3, generator=g) * 9, torch.tensor([[-23.9, 23.9, 0.0], [1e4, -1e4, 25.0]])]
    )
    weight = torch.randn(len(z), generator=g)
    results = []
    for dtype in (torch.float32, torch.float64):
        density = made_up().to(dtype)
        a = z.to(dtype).requires_grad_()
        bits = density.bits(a)
        results.append([bits, *torch.autograd.grad(bits, [a, density.logits], weight.to(dtype))])
    for fused, plain in zip(*results, strict=True):
        assert (fused - plain).abs().max() <= 1e-4 * plain.abs().max()


def test_beyond_the_last_bin_bits_grow_and_the_gradient_pulls_back():
    density = FactorizedDensity(1)
    z = torch.tensor([[24.0], [30.0], [-1000.0]], requires_grad=True)
    bits = density.bits(z)
    bits.sum().backward()
    assert (bits[1] - bits[0]).item() == pytest.approx(6 * TAIL_BITS)
    assert bits.isfinite().all()
    assert z.grad[1, 0] > 0 > z.grad[2, 0]


def test_training_finds_the_histogram_of_noisy_data():
    """What is trained is what is coded: noise does not change the probabilities that are found."""
    g = torch.Generator().manual_seed(0)
    truth = torch.tensor([0.05, 0.6, 0.0, 0.25, 0.1])
    symbols = torch.multinomial(truth, 8000, replacement=True, generator=g).float() - 2.0
    density = FactorizedDensity(1)
    optimizer = torch.optim.Adam(density.parameters(), lr=0.1)
    for _ in range(300):
        optimizer.zero_grad()
        density.bits(symbols[:, None]).mean().backward()
        optimizer.step()
    found = density.probabilities().detach()[0, 22:27]
    torch.testing.assert_close(found, truth, rtol=0.0, atol=0.02)


def test_gradients_are_the_same_bits_with_one_thread_and_with_several(with_threads):
    z = torch.randn(3000, 3, generator=torch.Generator().manual_seed(2)) * 5
    gradients = []
    for count in (1, 2):
        with_threads(count)
        density = made_up()
        density.bits(z).sum().backward()
        gradients.append(density.logits.grad)
    assert all(torch.equal(gradients[0], other) for other in gradients[1:])


def test_not_a_number_is_not_hidden_and_stays_inside_the_tables():
    for dtype in (torch.float32, torch.float64):
        density = FactorizedDensity(1).to(dtype)
        z = torch.tensor([[float("nan")], [0.3]], dtype=dtype, requires_grad=True)
        bits = density.bits(z)
        bits.sum().backward()
        assert bits.isnan().tolist() == [True, False]
