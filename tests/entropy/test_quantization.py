import numpy as np
import torch
from hypothesis import given
from hypothesis import strategies as st

from compgs.entropy.quantization import UniformNoise, quantize, quantize_weight, weight_exponent


def test_quantized_latents_differ_from_the_mean_by_whole_steps():
    y, mean = torch.randn(100, 7) * 5, torch.randn(100, 7)
    symbols = quantize(y, mean) - mean
    torch.testing.assert_close(symbols, symbols.round(), atol=1e-5, rtol=0)
    assert (quantize(y, mean) - y).abs().max() <= 0.5 + 1e-5


def test_the_gradient_reaches_the_latent_unchanged_and_never_the_mean():
    y, mean = torch.randn(5, 3, requires_grad=True), torch.randn(5, 3, requires_grad=True)
    upstream = torch.randn(5, 3)
    (quantize(y, mean) * upstream).sum().backward()
    assert torch.equal(y.grad, upstream)
    assert mean.grad is None


@given(st.integers(6, 16), st.floats(1e-4, 30.0), st.integers(0, 1000))
def test_stored_weights_are_integers_of_that_many_bits(bits, spread, seed):
    weight = torch.randn(13, 5, generator=torch.Generator().manual_seed(seed)) * spread
    exponent = weight_exponent(weight, bits)
    integers = quantize_weight(weight, bits).double() * 2.0**exponent
    assert torch.equal(integers, integers.round())
    assert integers.abs().max() <= (1 << (bits - 1)) - 1
    if 0 < exponent < 24:
        assert float(weight.abs().max()) * 2.0 ** (exponent + 1) > (1 << (bits - 1)) - 2


def test_noise_is_uniform_over_one_step_and_repeats_with_its_seeds():
    def draw(seed):
        noise = UniformNoise(1, np.random.default_rng(seed))
        return noise(torch.empty(100, 70)), noise(torch.empty(100, 70))

    first, second = draw(0)
    assert first.shape == (100, 70) and not torch.equal(first, second)
    assert first.min() >= -0.5 and first.max() < 0.5
    assert abs(float(first.mean())) < 0.02 and abs(float(first.var()) - 1 / 12) < 0.003
    assert torch.equal(first, draw(0)[0]) and not torch.equal(first, draw(1)[0])


def test_there_is_noise_for_any_number_of_latents():
    many = UniformNoise(0, np.random.default_rng(0))(torch.empty(3, UniformNoise.POOL // 2))
    assert abs(float(many.mean())) < 0.001 and many.std() > 0.28


def test_noise_for_more_latents_than_the_pool_has_numbers_does_not_repeat_within_itself(monkeypatch):
    """A pool, cut into pieces, came back after so many latents; here it is a smaller one than for a million anchors."""
    monkeypatch.setattr(UniformNoise, "POOL", 1 << 17)
    noise = UniformNoise(0, np.random.default_rng(0))
    many = noise(torch.empty(UniformNoise.POOL + 50_000)).numpy()
    # Neighbours as one number each: in so many pairs of 24 random bits none comes twice.
    bits = many.view(np.uint32).astype(np.uint64)
    pairs = (bits[:-1] << np.uint64(32)) | bits[1:]
    assert len(np.unique(pairs)) > len(pairs) - 3
    again = UniformNoise(0, np.random.default_rng(0))(torch.empty(len(many))).numpy()
    assert np.array_equal(many, again)
