import math

import pytest
import torch

from compgs.config import EntropyConfig, ModelConfig
from compgs.entropy import STREAMS, EntropyModel

MODEL = ModelConfig(coupled_primitives=3, reference_dim=6, residuals=True, residual_dim=4)
ENTROPY = EntropyConfig(reference_hyper_dim=2, residual_hyper_dim=3)


def latents(n=50, seed=0):
    g = torch.Generator().manual_seed(seed)
    return [torch.randn(n, c, generator=g) * s for c, s in ((6, 3.0), (6, 20.0), (12, 2.0))]


@pytest.fixture
def entropy():
    torch.manual_seed(0)
    return EntropyModel(MODEL, ENTROPY)


def test_bits_are_given_per_anchor_for_every_stream(entropy):
    result = entropy(*latents(), rate=True)
    assert tuple(result.bits) == STREAMS
    assert all(b.shape == (50,) and (b > 0).all() for b in result.bits.values())


def test_without_rate_nothing_is_estimated_and_latents_are_the_same(entropy):
    with_rate, without = entropy(*latents(), rate=True), entropy(*latents(), rate=False)
    assert without.bits == {}
    assert torch.equal(with_rate.residuals, without.residuals)


def test_an_anchor_is_coded_independently_of_the_others(entropy):
    whole = entropy(*latents(), rate=True)
    part = entropy(*[x[10:20] for x in latents()], rate=True)
    torch.testing.assert_close(part.references, whole.references[10:20])
    torch.testing.assert_close(part.bits["residual"], whole.bits["residual"][10:20])


def test_quantization_moves_no_latent_by_more_than_half_a_step(entropy):
    f, c, g = latents()
    result = entropy(f, c, g, rate=False, network_bits=10)
    for before, after in ((f, result.references), (c, result.covariances), (g, result.residuals)):
        assert (before - after).abs().max() <= 0.5 + 1e-4


def test_the_prior_of_the_covariance_starts_at_the_data(entropy):
    log_scales = torch.randn(500, 6) * 0.7 - 1.3
    y = log_scales / entropy.covariance_step
    before = entropy(torch.zeros(500, 6), y, torch.zeros(500, 12), rate=True).bits["covariance"].mean()
    entropy.fit_covariance_prior(log_scales)
    after = entropy(torch.zeros(500, 6), y, torch.zeros(500, 12), rate=True).bits["covariance"].mean()
    # 6 Gaussians of 0.7 natural units in steps: log2(0.7 / step sqrt(2 pi e)) bits each.
    expected = 6 * math.log2(0.7 / ENTROPY.covariance_step * math.sqrt(2 * math.pi * math.e))
    assert after < before
    assert float(after.detach()) == pytest.approx(expected, rel=0.05)


def test_minimizing_the_bits_lets_the_networks_find_a_dependence(entropy):
    """Covariances that are a function of the references end up nearly free."""
    g = torch.Generator().manual_seed(2)
    f = (torch.randn(400, 6, generator=g) * 4).round()
    c = f @ torch.randn(6, 6, generator=g)
    optimizer = torch.optim.Adam(entropy.parameters(), 0.02)
    first = last = 0.0
    for _ in range(300):
        bits = (
            entropy(
                f,
                c,
                torch.zeros(400, 12),
                rate=True,
                noise=lambda x: torch.empty_like(x).uniform_(-0.5, 0.5, generator=g),
            )
            .bits["covariance"]
            .mean()
        )
        first = first or float(bits.detach())
        last = float(bits.detach())
        optimizer.zero_grad()
        bits.backward()
        optimizer.step()
    assert last < 0.5 * first


def test_without_noise_training_sees_the_density_at_the_symbols_and_has_gradients(entropy):
    """The end of a training: a histogram, which counts symbols, would have none."""
    latents = [torch.randn(40, n).requires_grad_() for n in (6, 6, 12)]
    bits = entropy(*latents, rate=True).bits
    symbols = entropy.reference_analysis(latents[0]).round()
    torch.testing.assert_close(bits["reference_hyper"], entropy.reference_density.bits(symbols))
    torch.stack([b.sum() for b in bits.values()]).sum().backward()
    assert all(float(y.grad.abs().sum()) > 0 for y in latents)
    assert float(entropy.residual_density.logits.grad.abs().sum()) > 0
