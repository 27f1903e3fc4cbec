import pytest
import torch
from torch import nn

from compgs.tensors import residual_mlp_kernels
from compgs.tensors.residual_mlp import ResidualMLP

SLOPE = 2.0**-6


def layers(anchor_dim, residual_dim, outputs, width, blocks, seed=0):
    torch.manual_seed(seed)
    return ResidualMLP(anchor_dim, residual_dim, outputs, width, blocks)


def inputs(mlp, anchors, rows, seed=1):
    """Anchor features, residuals and an ascending index in which some anchors are missing and runs differ."""
    g = torch.Generator().manual_seed(seed)
    residual_dim = mlp.input_weight.shape[0] - mlp.anchor_dim
    index = torch.randint(0, anchors, (rows,), generator=g).sort().values
    return (
        torch.randn(anchors, mlp.anchor_dim, generator=g),
        torch.randn(rows, residual_dim, generator=g),
        index,
    )


def written_out(mlp, anchors, residuals, index):
    """The network of the docstring, layer by layer on the concatenated input."""
    inputs = torch.cat([anchors[index], residuals], 1)
    x = nn.functional.leaky_relu(inputs @ mlp.input_weight + mlp.input_bias, SLOPE)
    for block in mlp.blocks:
        hidden = nn.functional.leaky_relu(x @ block.weight1 + block.bias1, SLOPE)
        x = x + hidden @ block.weight2 + block.bias2
    return x @ mlp.output_weight + inputs @ mlp.skip_weight + mlp.output_bias


def gradients(function, mlp, anchors, residuals, index, d_out):
    anchors, residuals = anchors.clone().requires_grad_(), residuals.clone().requires_grad_()
    parameters = list(mlp.parameters())
    out = function(anchors, residuals, index)
    return [out, *torch.autograd.grad(out, [anchors, residuals, *parameters], d_out)]


SHAPES = [
    # anchor_dim, residual_dim, outputs, width, blocks, anchors, rows
    (36, 8, 4, 32, 1, 120, 700),
    (32, 8, 10, 32, 1, 9, 1),
    (5, 3, 1, 8, 0, 40, 129),
    (32, 8, 3, 32, 2, 300, 1300),
    (7, 8, 16, 64, 1, 2, 400),
]


@pytest.mark.parametrize("shape", SHAPES, ids=str)
def test_outputs_and_gradients_agree_with_float64_autograd(shape):
    *dimensions, anchors, rows = shape
    mlp = layers(*dimensions)
    double = layers(*dimensions).double()
    f, g, index = inputs(mlp, anchors, rows)
    d_out = torch.randn(rows, dimensions[2], generator=torch.Generator().manual_seed(3))
    fused = gradients(mlp, mlp, f, g, index, d_out)
    truth = gradients(
        lambda *args: written_out(double, *args), double, f.double(), g.double(), index, d_out.double()
    )
    for a, b in zip(fused, truth, strict=True):
        assert (a - b).abs().max() <= 1e-5 * b.abs().max()


def test_other_types_take_the_torch_path_with_the_same_result():
    mlp = layers(6, 4, 5, 16, 2).double()
    f, g, index = inputs(mlp, 20, 90)
    f, g, d_out = f.double(), g.double(), torch.ones(90, 5).double()
    for a, b in zip(
        gradients(mlp, mlp, f, g, index, d_out),
        gradients(lambda *args: written_out(mlp, *args), mlp, f, g, index, d_out),
        strict=True,
    ):
        torch.testing.assert_close(a, b)


def test_results_are_the_same_bits_with_one_thread_and_with_several(with_threads):
    mlp = layers(36, 8, 4, 32, 1)
    f, g, index = inputs(mlp, 500, 4000)
    d_out = torch.randn(4000, 4)
    results = []
    for count in (1, 2):
        with_threads(count)
        results.append(gradients(mlp, mlp, f, g, index, d_out))
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))


def test_parts_of_the_weight_gradient_never_divide_an_anchor():
    index = inputs(layers(4, 4, 1, 8, 0), 30, 1000)[2].numpy()
    bounds = residual_mlp_kernels.chunk_bounds(index, 16)
    assert bounds[0] == 0 and bounds[-1] == 1000 and (bounds[1:] >= bounds[:-1]).all()
    assert all(index[b] != index[b - 1] for b in bounds if 0 < b < 1000)


def test_parameters_replaced_by_functional_call_are_the_ones_used():
    mlp, other = layers(6, 4, 3, 16, 1, seed=0), layers(6, 4, 3, 16, 1, seed=7)
    f, g, index = inputs(mlp, 20, 90)
    weights = {name: p.detach().clone().requires_grad_() for name, p in other.named_parameters()}
    out = torch.func.functional_call(mlp, weights, (f, g, index))
    assert torch.equal(out, other(f, g, index))
    out.sum().backward()
    assert all(w.grad is not None and w.grad.abs().max() > 0 for w in weights.values())
    assert all(p.grad is None for p in mlp.parameters())


def test_only_what_requires_a_gradient_gets_one():
    mlp = layers(6, 4, 3, 16, 1).requires_grad_(False)
    f, g, index = inputs(mlp, 20, 90)
    assert not mlp(f, g, index).requires_grad
    f.requires_grad_()
    mlp(f, g, index).sum().backward()
    whole = layers(6, 4, 3, 16, 1)
    f2, g2 = f.detach().clone().requires_grad_(), g.clone().requires_grad_()
    whole(f2, g2, index).sum().backward()
    assert torch.equal(f.grad, f2.grad)
    assert g.grad is None


def test_no_coupled_primitives_give_no_rows_and_zero_gradients():
    mlp = layers(6, 4, 3, 16, 1)
    f, g, index = inputs(mlp, 5, 0)
    f.requires_grad_()
    out = mlp(f, g, index)
    assert out.shape == (0, 3)
    out.sum().backward()
    assert f.grad.abs().max() == 0
    assert all(p.grad.abs().max() == 0 for p in mlp.parameters())


def test_the_output_bias_shifts_the_outputs():
    mlp = layers(6, 4, 3, 16, 1)
    f, g, index = inputs(mlp, 20, 90)
    before = mlp(f, g, index)
    with torch.no_grad():
        mlp.output_bias[0] += 2.5
    torch.testing.assert_close(mlp(f, g, index) - before, torch.tensor([2.5, 0.0, 0.0]).expand(90, 3))


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_cuda_agrees_with_the_cpu():
    mlp = layers(36, 8, 4, 32, 1)
    f, g, index = inputs(mlp, 120, 700)
    d_out = torch.randn(700, 4)
    cpu = gradients(mlp, mlp, f, g, index, d_out)
    mlp = mlp.cuda()
    cuda = gradients(mlp, mlp, f.cuda(), g.cuda(), index.cuda(), d_out.cuda())
    for a, b in zip(cpu, cuda, strict=True):
        assert (a - b.cpu()).abs().max() <= 1e-3 * a.abs().max()
