from dataclasses import replace

import numpy as np
import pytest
import torch

from compgs.cameras import Camera
from compgs.model import HeadDimensions, HybridModel
from compgs.model.constants import OPACITY_CUTOFF
from compgs.tensors.heads import make_heads
from compgs.tensors.prediction import affine_transform, predict, view_embedding
from compgs.tensors.primitives import Primitives, every_slot, select_anchors

N, K, D, G = 40, 5, 12, 8


def rotation_matrix(q):
    w, x, y, z = torch.nn.functional.normalize(q, dim=-1).unbind(-1)
    rows = [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y), 2 * (x * y + w * z)]
    rows += [1 - 2 * (x * x + z * z), 2 * (y * z - w * x), 2 * (x * z - w * y), 2 * (y * z + w * x)]
    rows += [1 - 2 * (x * x + y * y)]
    return torch.stack(rows, -1).view(*q.shape[:-1], 3, 3)


@pytest.fixture
def primitives():
    g = torch.Generator().manual_seed(1)
    return Primitives(
        positions=torch.randn(N, 3, generator=g) * 3,
        log_scales=torch.randn(N, 6, generator=g),
        references=torch.randn(N, D, generator=g),
        residuals=torch.randn(N * K, G, generator=g),
        anchor_index=every_slot(N, K),
        voxel_size=0.05,
    )


def heads(layout):
    torch.manual_seed(0)
    return make_heads(layout, HeadDimensions(D, G, 16))


CENTER = torch.tensor([0.3, -2.0, 5.0])


@pytest.mark.parametrize("layout", ["paired", "separate"])
def test_prediction_equals_the_equations_written_out(primitives, layout):
    net = heads(layout)
    result = predict(net, primitives, CENTER, 4.0)
    f = primitives.references.repeat_interleave(K, 0)
    eps = view_embedding(primitives.positions, CENTER, 4.0).repeat_interleave(K, 0)
    one = torch.arange(N * K)
    if layout == "paired":
        raw = net.appearance(torch.cat([f, eps], 1), primitives.residuals, one)
        alpha, color = torch.tanh(raw[:, 0]), torch.sigmoid(raw[:, 1:])
        beta = net.geometry(f, primitives.residuals, one)
    else:
        alpha = torch.tanh(net.opacity(torch.cat([f, eps], 1), primitives.residuals, one)[:, 0])
        color = torch.sigmoid(net.color(torch.cat([f, eps], 1), primitives.residuals, one))
        beta = torch.cat(
            [net.translation(f, primitives.residuals, one), net.covariance(f, primitives.residuals, one)], 1
        )
    s = primitives.log_scales.repeat_interleave(K, 0).exp() * 0.05
    mean = primitives.positions.repeat_interleave(K, 0) + beta[:, :3] * s[:, :3]
    drawn = alpha > OPACITY_CUTOFF
    close = {"atol": 1e-4, "rtol": 1e-4}
    torch.testing.assert_close(result.opacities, alpha, **close)
    assert torch.equal(result.index, torch.nonzero(drawn).view(-1))
    torch.testing.assert_close(result.gaussians.means, mean[drawn], **close)
    torch.testing.assert_close(result.gaussians.colors, color[drawn], **close)
    torch.testing.assert_close(
        result.gaussians.scales, (torch.sigmoid(beta[:, 3:6]) * s[:, 3:])[drawn], **close
    )


def test_the_affine_transform_gives_a_covariance_for_any_network_output():
    raw = torch.randn(500, 10, dtype=torch.float64) * 20
    sizes = torch.rand(500, 3, dtype=torch.float64) + 1e-3
    _, scales, q = affine_transform(raw, torch.zeros(500, 3).double(), sizes, sizes)
    r = rotation_matrix(q)
    covariance = r @ torch.diag_embed(scales**2) @ r.mT
    torch.testing.assert_close(covariance, covariance.mT)
    assert (torch.linalg.eigvalsh(covariance) > -1e-9).all()
    assert (scales <= sizes).all() and (scales > 0).all()


def test_primitives_below_the_cutoff_are_not_drawn(primitives):
    result = predict(heads("paired"), primitives, CENTER, 4.0)
    assert 0 < len(result.index) < N * K
    assert (result.gaussians.opacities > OPACITY_CUTOFF).all()
    assert (result.index.diff() > 0).all()


@pytest.mark.parametrize("layout", ["paired", "separate"])
@pytest.mark.parametrize("compact", [True, False])
def test_stored_weights_replace_the_heads_own(primitives, layout, compact):
    net = heads(layout)
    other = make_heads(layout, HeadDimensions(D, G, 16))
    stored = dict(other.named_parameters())
    found = predict(net, primitives, CENTER, 4.0, stored, compact=compact)
    expected = predict(other, primitives, CENTER, 4.0, compact=compact)
    for name in ("means", "quaternions", "scales", "opacities", "colors"):
        assert torch.equal(getattr(found.gaussians, name), getattr(expected.gaussians, name))
    own = predict(net, primitives, CENTER, 4.0, compact=compact)
    assert not torch.equal(own.opacities, found.opacities)


@pytest.mark.parametrize("layout", ["paired", "separate"])
def test_a_loaded_model_gives_the_gaussians_of_prediction(primitives, layout):
    net = heads(layout)
    keep = torch.rand(N * K, generator=torch.Generator().manual_seed(5)) < 0.7
    some = replace(
        primitives, residuals=primitives.residuals[keep], anchor_index=primitives.anchor_index[keep]
    )
    pose = torch.eye(4).double()
    pose[:3, 3] = -CENTER
    camera = Camera(pose.numpy(), 50, 50, 32, 32, 64, 64)
    model = HybridModel(some.arrays(), net.weights(), 4.0, (0.0, 0.0, 0.0))
    expected = predict(net, some, CENTER, 4.0).gaussians
    found = model.gaussians(camera)
    for name in ("means", "quaternions", "scales", "opacities", "colors"):
        exact = getattr(expected, name).detach()
        np.testing.assert_allclose(getattr(found, name), exact, atol=1e-5, rtol=1e-4)
    visible = torch.arange(N) % 2 == 0
    half = model.gaussians(camera, visible.numpy())
    np.testing.assert_allclose(
        half.means,
        predict(net, select_anchors(some, visible), CENTER, 4.0).gaussians.means.detach(),
        atol=1e-5,
        rtol=1e-4,
    )


def test_bounds_hold_every_primitive(primitives):
    model = HybridModel(primitives.arrays(), heads("paired").weights(), 4.0, (0.0, 0.0, 0.0))
    centers, radii = model.bounds
    means, scales, _ = model.geometry
    index = primitives.anchor_index.numpy()
    distance = np.linalg.norm(means - centers[index], axis=1)
    assert (distance + 3 * scales.max(1) <= radii[index]).all()
