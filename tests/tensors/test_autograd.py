"""Training's way through the kernels, Gaussians and gradients, against plain torch in float64."""

import pytest
import torch

from compgs.model import HeadDimensions
from compgs.tensors.heads import make_heads
from compgs.tensors.prediction import predict
from compgs.tensors.primitives import Primitives, every_slot

N, K, D, G = 300, 5, 12, 8
CENTER = torch.tensor([0.3, -2.0, 5.0])


def inputs(dtype):
    g = torch.Generator().manual_seed(1)
    made = [torch.randn(shape, generator=g) for shape in ((N, 3), (N, 6), (N, D), (N * K, G))]
    return [x.to(dtype).requires_grad_() for x in made]


def prediction(dtype, *, revived=False, layout="paired", kept=1.0):
    """Gaussians and gradients of a random function of them by everything that is trained; `revived`: also of the
    opacities of what is not drawn. `kept`: the share of the Gaussians that it depends on.
    """
    torch.manual_seed(0)
    heads = make_heads(layout, HeadDimensions(D, G, 16)).to(dtype)
    positions, log_scales, references, residuals = inputs(dtype)
    index = every_slot(N, K)
    primitives = Primitives(positions.detach() * 3, log_scales, references, residuals, index, 0.05)
    result = predict(heads, primitives, CENTER.to(dtype), 4.0)
    fields = [
        getattr(result.gaussians, name) for name in ("means", "quaternions", "scales", "opacities", "colors")
    ]
    g = torch.Generator().manual_seed(2)
    weights = [torch.randn(f.shape, generator=g).to(dtype) for f in fields]
    counted = (torch.rand(len(result.index), generator=g) < kept).to(dtype)
    total = sum(
        (f * w * counted.view(-1, *[1] * (f.dim() - 1))).sum() for f, w in zip(fields, weights, strict=True)
    )
    if revived:
        total = total + torch.relu(0.05 - result.opacities).sum()
    total.backward()
    gradients = [log_scales.grad, references.grad, residuals.grad, *(p.grad for p in heads.parameters())]
    return result.index, [f.detach() for f in fields], gradients


@pytest.mark.parametrize("layout", ["paired", "shallow", "separate"])
@pytest.mark.parametrize("revived", [False, True])
def test_prediction_by_kernels_and_its_gradients_agree_with_float64_autograd(revived, layout):
    index, fields, gradients = prediction(torch.float32, revived=revived, layout=layout)
    true_index, true_fields, true_gradients = prediction(torch.float64, revived=revived, layout=layout)
    assert torch.equal(index, true_index) and 100 < len(index) < N * K
    for found, truth in zip(fields + gradients, true_fields + true_gradients, strict=True):
        assert (found.double() - truth).abs().max() <= 2e-5 * truth.abs().max()


@pytest.mark.parametrize("layout", ["paired", "separate"])
@pytest.mark.parametrize("kept", [0.3, 0.0])
def test_primitives_without_gradient_are_passed_over_and_nothing_else_is(kept, layout):
    _, _, gradients = prediction(torch.float32, layout=layout, kept=kept)
    _, _, true_gradients = prediction(torch.float64, layout=layout, kept=kept)
    for found, truth in zip(gradients, true_gradients, strict=True):
        assert (found.double() - truth).abs().max() <= 2e-5 * truth.abs().max()


def test_gradients_do_not_depend_on_the_number_of_threads(with_threads):
    with_threads(2)
    _, _, two = prediction(torch.float32)
    with_threads(1)
    _, _, one = prediction(torch.float32)
    for a, b in zip(one[:3], two[:3], strict=True):
        assert torch.equal(a, b)
