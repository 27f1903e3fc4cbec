import math
from dataclasses import replace

import pytest
import torch

from compgs.config import EntropyConfig, ModelConfig
from compgs.entropy import STREAMS, EntropyModel
from compgs.entropy.gaussian import gaussian_bits, scale_from_index
from compgs.entropy.models import make_entropy_model
from compgs.entropy.network import EntropyNetwork

MODEL = ModelConfig(
    coupled_primitives=3, reference_dim=6, residuals=True, residual_dim=4, reference_context="hyperprior"
)
ENTROPY = EntropyConfig(reference_hyper_dim=2)
BLOCKS = EntropyConfig(reference_hyper_dim=2, network_blocks=2)


def latents(n=50, seed=0):
    g = torch.Generator().manual_seed(seed)
    return [torch.randn(n, c, generator=g) * s for c, s in ((6, 3.0), (6, 20.0), (12, 2.0))]


@pytest.fixture(params=[ENTROPY, BLOCKS], ids=["linear", "blocks"])
def entropy(request):
    torch.manual_seed(0)
    return make_entropy_model(replace(MODEL, width=7), request.param)


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
    expected = 6 * math.log2(0.7 / ENTROPY.steps.covariance * math.sqrt(2 * math.pi * math.e))
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
    symbols = entropy.reference_context.analysis(latents[0]).round()
    torch.testing.assert_close(bits["reference_hyper"], entropy.reference_context.density.bits(symbols))
    torch.stack([b.sum() for b in bits.values()]).sum().backward()
    assert all(float(y.grad.abs().sum()) > 0 for y in latents)
    assert float(entropy.residual_hyperprior.density.logits.grad.abs().sum()) > 0


def test_in_training_the_likelihood_sees_latents_and_hyperpriors_with_noise_in_place_of_rounding(entropy):
    f, c, g = latents()
    bits = entropy(f, c, g, rate=True, noise=lambda like: torch.full_like(like, 0.3)).bits
    z = entropy.reference_context.analysis(f), entropy.residual_hyperprior.analysis(g)
    for name, y, density in zip(
        ("reference_hyper", "residual_hyper"),
        z,
        (entropy.reference_context.density, entropy.residual_hyperprior.density),
        strict=True,
    ):
        # The mass of a unit interval lies in two bins, in proportion.
        p = density.probabilities().double()
        left = (y.double() + 0.3).floor()
        part = y.double() + 0.3 - left
        column = (left.long() + p.shape[1] // 2).t()
        mass = p.gather(1, column).t() * (1 - part) + p.gather(1, column + 1).t() * part
        torch.testing.assert_close(bits[name].double(), -mass.log2().sum(1), rtol=1e-4, atol=1e-4)
    for name, y, network, context in (
        ("reference", f, entropy.reference_network, z[0].round()),
        ("covariance", c, entropy.covariance_network, entropy(f, c, g, rate=False).references),
    ):
        mean, scale = network(context)
        torch.testing.assert_close(bits[name], gaussian_bits(y - mean + 0.3, scale), rtol=1e-3, atol=1e-2)


def test_scales_start_anew_at_the_spread_around_what_the_hyperprior_expects(entropy):
    """In octaves of a step; a channel that hardly moves gets a fifth of a step."""
    references = latents(400)[0] + torch.tensor([0.0, 5.0, 0.0, 0.0, 0.0, 0.0])
    references[:, 3] = 1.0
    with torch.no_grad():
        for layer in (entropy.reference_context.analysis.first, entropy.reference_context.analysis.second):
            layer.weight.mul_(2.0)
        entropy.reference_network.weights[-1][3] = 0
    weight, bias = entropy.restart_reference_scales(references)
    with torch.no_grad():
        mean, scale = entropy.reference_network(entropy.reference_context.analysis(references).round())
    spread = (references - mean).double().std(0, correction=0)
    plain = references.double().std(0, correction=0)
    assert spread[3] < 1e-3
    assert ((spread - plain).abs() > 0.02 * plain.clamp_min(0.1)).any()
    torch.testing.assert_close(
        scale_from_index(scale).double(), spread.clamp_min(0.2).expand(400, -1), rtol=1e-3, atol=0
    )
    assert weight is entropy.reference_network.weights[-1] and bias is entropy.reference_network.biases[-1]


def test_a_file_is_estimated_by_the_histograms_of_its_hyperpriors(entropy):
    with torch.no_grad():
        f, c, g = latents()
        bits = entropy(f, c, g, rate=True).bits["reference_hyper"]
        symbols = entropy.reference_context.analysis(f).round().to(torch.int64)
    expected = [
        sum(-math.log2(float((column == column[i]).double().mean())) for column in symbols.unbind(1))
        for i in range(len(f))
    ]
    assert bits.tolist() == pytest.approx(expected, rel=1e-4)


def test_a_new_anchor_starts_with_the_residuals_that_the_prior_expects(entropy):
    start = entropy.starting_residuals()
    assert start.any()
    mean, _ = entropy.residual_network(torch.zeros(1, 9))
    if not entropy.residual_network.blocks:
        torch.testing.assert_close(start, mean[0].detach())
    assert entropy.residual_network.biases[-1][:12].tolist() == start.tolist()


def test_statistics_are_all_parameters_but_the_steps(entropy):
    names = {id(p): name for name, p in entropy.named_parameters()}
    found = {names[id(p)] for p in entropy.statistics()}
    assert found == set(names.values()) - {"log_covariance_step"}


def test_residuals_are_predicted_from_references_and_then_their_hyperprior(entropy):
    """What the network is given, in the file's order; and one channel of the hyperprior for each primitive."""
    f, c, g = latents()
    seen = {}
    entropy.residual_network.inputs_of_last, plain = (
        lambda x, bits=None: seen.setdefault("x", x) is x and plain(x, bits),
        entropy.residual_network.inputs_of_last,
    )
    references = entropy(f, c, g, rate=False).references
    hyper = entropy.residual_hyperprior.analysis(g).round()
    assert hyper.shape[1] == MODEL.coupled_primitives
    torch.testing.assert_close(seen["x"], torch.cat([references, hyper], 1))


def test_a_network_with_blocks_is_a_residual_perceptron_with_a_linear_skip():
    """Written out: h = leaky(W0 x + b0), then h + W(leaky(W h + b)) + b twice, then W [h, x] + b."""
    network = EntropyNetwork(4, 3, blocks=2, width=6, mean_gain=2.5).double()
    with torch.no_grad():
        for bias in network.biases:
            bias.normal_()

    def slow(x):
        weights, biases = list(network.weights), list(network.biases)
        h = torch.where((y := weights[0] @ x + biases[0]) > 0, y, y / 64)
        for i in (1, 3):
            y = weights[i] @ h + biases[i]
            h = h + weights[i + 1] @ torch.where(y > 0, y, y / 64) + biases[i + 1]
        y = weights[5] @ torch.cat([h, x]) + biases[5]
        return y[:3] * 2.5, y[3:] * 12 + 60

    x = torch.randn(20, 4, dtype=torch.float64)
    mean, scale = network(x)
    expected = [slow(row) for row in x]
    torch.testing.assert_close(mean, torch.stack([m for m, _ in expected]))
    torch.testing.assert_close(scale, torch.stack([s for _, s in expected]))


def test_readers_of_the_references_are_all_the_weights_that_see_them(entropy):
    """Other references that every reader undoes predict the same: a rotation, and its transpose in each of them."""
    f = latents()[0]
    turn = torch.linalg.qr(torch.randn(6, 6))[0]
    z = torch.randn(50, 3)

    def predicted(references):
        return [
            entropy.reference_context.analysis(references),
            *entropy.covariance_network(references),
            *entropy.residual_network(torch.cat([references, z], 1)),
        ]

    before = predicted(f)
    with torch.no_grad():
        for reader in entropy.readers():
            part = reader.weight[:, reader.first : reader.first + 6]
            part.copy_(part @ turn)
    for old, new in zip(before, predicted(f @ turn), strict=True):
        torch.testing.assert_close(new, old, atol=1e-3, rtol=1e-3)


def test_anchors_that_share_residuals_pay_for_none_of_them():
    torch.manual_seed(0)
    model = replace(MODEL, residuals=False)
    entropy = make_entropy_model(model, ENTROPY)
    assert type(entropy) is EntropyModel
    assert entropy.coded_networks == (entropy.reference_network, entropy.covariance_network)
    f, c, _ = latents()
    shared = entropy.starting_residuals()
    assert shared.shape == (12,) and len(shared.unique()) == 12
    result = entropy(f, c, shared[None], rate=True)
    assert tuple(result.bits) == STREAMS[:3]
    assert torch.equal(result.residuals, shared.expand(50, -1))


def test_each_log_scale_has_a_step_of_its_own(entropy):
    assert entropy.covariance_step.shape == (6,)
    with torch.no_grad():
        entropy.log_covariance_step.copy_(torch.linspace(-3, 0, 6))
    torch.testing.assert_close(entropy.covariance_step, torch.linspace(-3, 0, 6).exp())
    with torch.no_grad():
        entropy.log_covariance_step.fill_(-30)
    assert (entropy.covariance_step == 0.005).all()
