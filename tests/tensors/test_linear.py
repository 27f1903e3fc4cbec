import pytest
import torch

from compgs.tensors.linear import linear


def gradients(dtype, rows, inputs, outputs):
    g = torch.Generator().manual_seed(0)
    shapes = (rows, inputs), (inputs, outputs), (outputs,)
    x, weight, bias = (torch.randn(s, generator=g).to(dtype).requires_grad_() for s in shapes)
    weights = torch.randn(rows, outputs, generator=g).to(dtype)
    out = linear(x, weight, bias)
    return [out.detach(), *torch.autograd.grad((out * weights).sum(), [x, weight, bias])]


@pytest.mark.parametrize(
    "shape", [(4000, 42, 160), (1, 3, 5), (0, 3, 5), (37, 1, 1), (50, 500, 600)], ids=str
)
def test_outputs_and_gradients_agree_with_float64_autograd(shape):
    for found, truth in zip(gradients(torch.float32, *shape), gradients(torch.float64, *shape), strict=True):
        torch.testing.assert_close(found.double(), truth, rtol=1e-5, atol=1e-5 * max(1, shape[0]) ** 0.5)


@pytest.mark.parametrize("shape", [(4606, 42, 160), (4606, 4, 64), (46_060, 8, 8)], ids=str)
def test_gradients_do_not_depend_on_the_number_of_threads(shape, with_threads):
    results = []
    for count in (1, 2):
        with_threads(count)
        results.append(gradients(torch.float32, *shape))
    assert all(torch.equal(a, b) for a, b in zip(*results, strict=True))
