"""Latents coded around predicted means: the fused pass against plain torch in float64."""

import re

import numpy as np
import pytest
import torch
from numba import njit

from compgs.entropy import conditional
from compgs.entropy.conditional import code_latents
from compgs.entropy.network import EntropyNetwork

N, INPUTS, SLOTS, CHANNELS = 150, 7, 4, 12


def latents(seed: int = 0) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    """y, context, noise, and a mask of slots."""
    g = torch.Generator().manual_seed(seed)
    y, context = torch.randn(N, CHANNELS, generator=g) * 3, torch.randn(N, INPUTS, generator=g) * 2
    noise = torch.rand(N, CHANNELS, generator=g) - 0.5
    return y, context, noise, torch.rand(N, SLOTS, generator=g) > 0.3


def network(blocks: int = 0) -> EntropyNetwork:
    torch.manual_seed(1)
    return EntropyNetwork(INPUTS, CHANNELS, blocks, 5)


def run(
    dtype: torch.dtype, *, bits: int | None, with_noise: bool, masked: bool, blocks: int = 0
) -> list[torch.Tensor]:
    """y_hat, bits, and the gradients of a function of both."""
    y, context, noise, mask = latents()
    y, context = (x.to(dtype).requires_grad_() for x in (y, context))
    net = network(blocks).to(dtype)
    y_hat, total = code_latents(
        y,
        context,
        net,
        rate=True,
        noise=(lambda like: noise.to(like.dtype)) if with_noise else None,
        network_bits=bits,
        mask=mask if masked else None,
    )
    weights = torch.linspace(0.5, 1.5, N, dtype=dtype)
    (y_hat.sin().sum() + (weights * total).sum()).backward()
    gradients = [y.grad, context.grad, *(p.grad for p in net.parameters())]
    return [y_hat.detach(), total.detach(), *(g for g in gradients if g is not None)]


@pytest.mark.parametrize("bits", [None, 13])
@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("blocks", [0, 1, 2])
def test_the_fused_pass_agrees_with_torch_in_float64(bits: int | None, masked: bool, blocks: int):
    fused = run(torch.float32, bits=bits, with_noise=True, masked=masked, blocks=blocks)
    plain = run(torch.float64, bits=bits, with_noise=True, masked=masked, blocks=blocks)
    assert len(fused) == len(plain) >= 6
    for a, b in zip(fused, plain, strict=True):
        torch.testing.assert_close(a.double(), b, rtol=2e-4, atol=2e-4 * float(b.abs().max()))


def test_without_noise_the_bits_are_those_of_the_symbols():
    fused = run(torch.float32, bits=13, with_noise=False, masked=True)
    plain = run(torch.float64, bits=13, with_noise=False, masked=True)
    torch.testing.assert_close(fused[0].double(), plain[0], rtol=0, atol=3e-4)  # (a step of the fixed point)
    torch.testing.assert_close(fused[1].double(), plain[1], rtol=1e-4, atol=1e-3)


def test_what_is_reconstructed_lies_whole_steps_from_the_mean_and_half_a_step_from_the_latent():
    y, context, _, _ = latents()
    net = network()
    y_hat, bits = code_latents(y, context, net, rate=False)
    mean, _ = net(context)
    symbols = y_hat - mean
    torch.testing.assert_close(symbols, symbols.round(), rtol=0, atol=1e-5)
    assert (y_hat - y).abs().max() <= 0.5 + 1e-5
    assert len(bits) == 0


def test_masked_slots_cost_nothing_and_pull_at_nothing():
    y, context, noise, mask = latents()
    mask[:] = False
    y.requires_grad_()
    net = network()
    _, bits = code_latents(y, context, net, rate=True, noise=lambda like: noise, mask=mask)
    bits.sum().backward()
    assert float(bits.detach().abs().sum()) == 0.0
    assert y.grad is not None and float(y.grad.abs().sum()) == 0.0
    assert all(float(p.grad.abs().sum()) == 0.0 for p in net.parameters() if p.grad is not None)


def test_bits_and_gradients_do_not_depend_on_the_number_of_threads(with_threads):
    with_threads(2)
    many = run(torch.float32, bits=13, with_noise=True, masked=True)
    with_threads(1)
    one = run(torch.float32, bits=13, with_noise=True, masked=True)
    assert all(torch.equal(a, b) for a, b in zip(many, one, strict=True))


def test_the_row_kernels_are_compiled_to_vector_instructions():
    """Losing them is silent otherwise."""
    row, empty = np.ones(16, np.float32), np.ones(0, np.float32)
    wide = np.ones(32, np.float32)
    calls = [
        (conditional._quantize_row, (row, wide, empty, True, row.copy(), row.copy(), row.copy())),
        (conditional._gradient_row, (wide, row, row, np.float32(1), empty, row.copy(), wide.copy())),
    ]
    for kernel, arguments in calls:
        fresh = njit(kernel.py_func, **{k: v for k, v in kernel.targetoptions.items() if k != "nopython"})
        fresh(*arguments)
        (code,) = fresh.inspect_llvm().values()
        assert re.search(r"f(sub|mul|add) [a-z ]*<(4|8|16) x float>", code)
