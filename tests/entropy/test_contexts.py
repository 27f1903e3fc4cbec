import pytest
import torch

from compgs.config import EntropyConfig, ModelConfig
from compgs.entropy.gaussian import scale_from_index
from compgs.entropy.models import make_entropy_model

MODEL = ModelConfig(reference_context="none", coupled_primitives=3, reference_dim=6, residual_dim=4)


@pytest.fixture
def entropy():
    torch.manual_seed(0)
    return make_entropy_model(MODEL, EntropyConfig())


def test_without_a_hyperprior_nothing_is_sent_before_the_references(entropy):
    f, c, g = torch.randn(20, 6), torch.randn(20, 6), torch.zeros(1, 12)
    bits = entropy(f, c, g, rate=True).bits
    assert tuple(bits) == tuple(entropy.channels) == ("reference", "covariance")
    assert list(entropy.reference_context.parameters()) == []


def test_without_a_hyperprior_every_anchor_is_coded_alike(entropy):
    f, c, g = torch.randn(1, 6).repeat(9, 1), torch.zeros(9, 6), torch.zeros(1, 12)
    bits = entropy(f, c, g, rate=True).bits["reference"]
    assert torch.equal(bits, bits[:1].expand(9))


def test_without_a_hyperprior_minimizing_the_bits_finds_the_channels_means_and_spreads(entropy):
    """The bits of Gaussians in closed form, log2(spread sqrt(2 pi e)) each; the network's weights stay zero."""
    g = torch.Generator().manual_seed(2)
    spreads = torch.tensor([1.0, 2.0, 3.0, 5.0, 8.0, 12.0])
    f = torch.randn(2000, 6, generator=g) * spreads + torch.linspace(-8, 8, 6)
    optimizer = torch.optim.Adam(entropy.parameters(), 0.05)
    for _ in range(1000):
        noise = torch.rand(2000, 6, generator=g) - 0.5
        loss = (
            entropy(f, f, torch.zeros(1, 12), rate=True, noise=lambda x, n=noise: n).bits["reference"].mean()
        )
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    # uniform noise adds a twelfth to the variance
    expected = 0.5 * torch.log2(2 * torch.pi * torch.e * (spreads**2 + 1 / 12)).sum()
    assert float(loss.detach()) == pytest.approx(float(expected), rel=0.02)
    assert not any(weight.any() for weight in entropy.reference_network.weights)


def test_without_a_hyperprior_references_start_anew_at_their_means_and_spreads(entropy):
    f = torch.randn(500, 6, generator=torch.Generator().manual_seed(1)) * 3 + torch.linspace(-8, 8, 6)
    entropy.restart_reference_scales(f)
    mean, scale = entropy.reference_network(entropy.reference_context(f))
    torch.testing.assert_close(mean.detach(), f.mean(0).expand(500, 6))
    torch.testing.assert_close(scale_from_index(scale.detach()), f.std(0, correction=0).expand(500, 6))
