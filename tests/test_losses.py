import re

import numba
import numpy as np
import pytest
import torch

from compgs.losses import (
    Target,
    photometric_loss,
    rate,
    rate_distortion_loss,
    revival_loss,
    scale_regularizer,
    scale_unit,
)
from compgs.numerics import ssim as ssim_module
from compgs.numerics.ssim import l1_and_ssim, window
from compgs.tensors.ssim import ssim


def pair(height, width, seed=0):
    """A smooth photograph and a noisy rendering, some of it outside 0 to 1."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:height, :width]
    photograph = 0.5 + 0.4 * np.sin(x / 7.0 + y / 11.0)[..., None] * np.array([1.0, 0.5, -0.8])
    rendering = photograph + 0.2 * rng.standard_normal(photograph.shape)
    return torch.from_numpy(rendering), torch.from_numpy(np.rint(255 * photograph).astype(np.uint8))


def ssim_by_definition(x, y):
    """Every window summed on its own, in float64."""
    taps = np.exp(-0.5 * (np.arange(-5, 6) / 1.5) ** 2)
    weights = np.outer(taps, taps) / taps.sum() ** 2
    x, y = (np.pad(a, ((5, 5), (5, 5), (0, 0))) for a in (x, y))
    values = []
    for i in range(x.shape[0] - 10):
        for j in range(x.shape[1] - 10):
            for c in range(3):
                p, q = x[i : i + 11, j : j + 11, c], y[i : i + 11, j : j + 11, c]
                m, n = (weights * p).sum(), (weights * q).sum()
                v, w = (weights * p * p).sum() - m * m, (weights * q * q).sum() - n * n
                covariance = (weights * p * q).sum() - m * n
                value = (2 * m * n + 1e-4) * (2 * covariance + 9e-4)
                values.append(value / ((m * m + n * n + 1e-4) * (v + w + 9e-4)))
    return np.mean(values)


def test_ssim_agrees_with_its_definition():
    x, y = pair(19, 23)
    photograph = y.double() / 255
    expected = ssim_by_definition(x.numpy(), photograph.numpy())
    assert float(ssim(x, photograph)) == pytest.approx(expected, abs=1e-12)
    fused = l1_and_ssim(x.float().numpy(), y.numpy())
    assert fused[1] == pytest.approx(expected, abs=2e-6)
    assert fused[0] == pytest.approx(float((x - photograph).abs().mean()), rel=1e-6)


def test_the_window_sums_to_one_and_is_symmetric():
    assert window().sum() == pytest.approx(1.0)
    np.testing.assert_array_equal(window(), window()[::-1])


# Narrower than the window, wider than one tile of columns, exactly one tile.
@pytest.mark.parametrize("size", [(33, 47), (4, 3), (1, 1), (21, 160), (18, 375)], ids=str)
@pytest.mark.parametrize("weight", [0.0, 0.2, 1.0])
def test_loss_and_gradient_agree_with_float64_autograd(size, weight):
    rendering, photograph = pair(*size)
    results = []
    for dtype in (torch.float32, torch.float64):
        x = rendering.to(dtype).requires_grad_()
        loss = photometric_loss(x, photograph, weight)
        (2.5 * loss).backward()
        results.append((loss.item(), x.grad.double()))
    (fused, fused_gradient), (plain, plain_gradient) = results
    assert fused == pytest.approx(plain, abs=3e-6)
    assert (fused_gradient - plain_gradient).abs().max() <= 1e-5 * plain_gradient.abs().max()


def test_a_target_in_floats_or_bytes_or_wrapped_gives_the_same_loss():
    rendering, photograph = pair(30, 40)
    x = rendering.float()
    loss = photometric_loss(x, photograph)
    torch.testing.assert_close(photometric_loss(x, photograph.float() / 255), loss)
    assert torch.equal(photometric_loss(x, Target.from_image(photograph.numpy())), loss)


def test_a_target_holds_the_photograph_itself_and_no_copy():
    photograph = np.zeros((4, 5, 3), np.uint8)
    target = Target.from_image(photograph)
    photograph[1, 2, 0] = 7
    assert target.image[1, 2, 0] == 7


def test_a_target_can_be_made_from_a_read_only_image():
    _, photograph = pair(6, 7)
    image = photograph.numpy()
    image.setflags(write=False)
    assert torch.equal(Target.from_image(image).image, photograph)


def test_a_perfect_rendering_costs_nothing_and_has_no_gradient():
    _, photograph = pair(30, 40)
    x = (photograph.float() / 255).requires_grad_()
    loss = photometric_loss(x, photograph)
    loss.backward()
    assert abs(loss.item()) < 1e-6
    # L1 has a kink there: float32 may round to either side of it.
    assert x.grad.abs().max() <= 0.81 / x.numel()


def test_gradients_are_the_same_bits_with_one_thread_and_with_several(with_threads):
    rendering, photograph = pair(64, 90)
    results = []
    for count in (1, 2):
        with_threads(count)
        results.append(l1_and_ssim(rendering.float().numpy(), photograph.numpy(), 0.2, want_gradient=True))
    for other in results[1:]:
        assert results[0][:2] == other[:2]
        np.testing.assert_array_equal(results[0][2], other[2])


ROW, BYTES, SCRATCH = np.ones(8, np.float32), np.ones(8, np.uint8), np.ones(ssim_module._SCRATCH, np.float32)
ROWS, ROWS_OF_BYTES, MAPS = (
    np.ones((11, 8), np.float32),
    np.ones((11, 8), np.uint8),
    np.ones((11, 3, 8), np.float32),
)
WINDOW = np.arange(11, dtype=np.uint64), np.ones(11, np.float32)
F = np.float32(0.5)
KERNELS = {
    "_products": (SCRATCH, 0, ROWS, ROWS_OF_BYTES, F, *WINDOW, 0, 8),
    "_similarity": (SCRATCH, 8),
    "_summed_maps": (SCRATCH, 0, MAPS, *WINDOW, 0, 8),
    "_combine": (SCRATCH, ROW, BYTES, F, F, F, ROW),
}


@pytest.mark.parametrize("name", KERNELS)
def test_the_kernels_are_compiled_to_vector_instructions(name):
    """Losing them is silent otherwise, and costs a factor of five."""
    kernel = getattr(ssim_module, name)
    options = {k: v for k, v in kernel.targetoptions.items() if k != "nopython"}
    fresh = numba.njit(kernel.py_func, pipeline_class=kernel._compiler.pipeline_class, **options)
    fresh(*KERNELS[name])
    (code,) = fresh.inspect_llvm().values()
    assert re.search(r"fmul [a-z ]*<(4|8|16) x float>", code)


def test_a_rendering_laid_out_otherwise_is_taken():
    rendering, photograph = pair(20, 30)
    planar = rendering.float().permute(2, 0, 1).contiguous().permute(1, 2, 0).requires_grad_()
    photometric_loss(planar, photograph).backward()
    x = rendering.float().requires_grad_()
    photometric_loss(x, photograph).backward()
    assert torch.equal(planar.grad, x.grad)


def test_the_scale_regularizer_is_the_mean_volume():
    scales = torch.tensor([[1.0, 2.0, 3.0], [0.5, 0.5, 4.0]])
    assert scale_regularizer(scales).item() == pytest.approx(3.5)


def test_scales_are_measured_by_the_extent_of_the_scene_and_beyond_it_by_the_distance():
    means = torch.tensor([[1.0, 0.0, 0.0], [1.0, 0.0, 3.0], [1.0, 40.0, 0.0]])
    unit = scale_unit(means, torch.tensor([1.0, 0.0, 0.0]), 10.0)
    assert unit.flatten().tolist() == pytest.approx([2.0, 2.0, 8.0])


def test_opacities_are_pulled_up_to_a_twentieth_and_no_further():
    opacities = torch.tensor([-0.35, 0.0, 0.04, 0.06, 0.9], requires_grad=True)
    loss = revival_loss(opacities)
    loss.backward()
    assert loss.item() == pytest.approx(0.1 * (0.4 + 0.05 + 0.01) / 5)
    assert opacities.grad.tolist() == pytest.approx([-0.02, -0.02, -0.02, 0, 0])


BITS = {
    "reference_hyper": torch.tensor([4.0, 8.0]),
    "reference": torch.tensor([32.0, 64.0]),
    "covariance": torch.tensor([18.0, 18.0]),
    "residual_hyper": torch.tensor([20.0, 10.0]),
    "residual": torch.tensor([80.0, 240.0]),
}
CHANNELS = {"reference_hyper": 4, "reference": 32, "covariance": 6, "residual_hyper": 10, "residual": 80}


def test_the_rate_by_elements_adds_the_means_of_the_streams():
    assert rate(BITS, CHANNELS, "elements").item() == pytest.approx(
        12 / 8 + 96 / 64 + 36 / 12 + 30 / 20 + 320 / 160
    )


def test_the_rate_by_bits_weighs_every_bit_the_same():
    total = sum(b.sum().item() for b in BITS.values())
    # Two anchors of 132 elements.
    assert rate(BITS, CHANNELS, "bits").item() == pytest.approx(5 * total / (132 * 2))
    leaves = {name: b.clone().requires_grad_() for name, b in BITS.items()}
    rate(leaves, CHANNELS, "bits").backward()
    assert {g.item() for b in leaves.values() for g in b.grad} == {leaves["residual"].grad[0].item()}


def test_both_normalizations_are_equal_where_every_element_costs_the_same():
    bits = {name: torch.tensor(1.7 * n) for name, n in CHANNELS.items()}
    by_bits, by_elements = (rate(bits, CHANNELS, kind).item() for kind in ("bits", "elements"))
    assert by_bits == pytest.approx(by_elements) == pytest.approx(5 * 1.7)


def test_lambda_weighs_the_rate():
    assert rate_distortion_loss(torch.tensor(0.5), torch.tensor(10.0), 0.01).item() == pytest.approx(0.6)


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_cuda_agrees_with_the_cpu():
    rendering, photograph = pair(64, 90)
    results = []
    for device in ("cpu", "cuda"):
        x = rendering.float().to(device).requires_grad_()
        loss = photometric_loss(x, Target.from_image(photograph.numpy(), device))
        loss.backward()
        results.append((loss.item(), x.grad.cpu()))
    assert results[0][0] == pytest.approx(results[1][0], abs=1e-5)
    assert (results[0][1] - results[1][1]).abs().max() <= 1e-3 * results[0][1].abs().max()


# masks


def masked_pair(height, width, seed=0):
    rendering, photograph = pair(height, width, seed)
    counted = np.random.default_rng(seed + 1).random((height, width)) < 0.6
    counted[: height // 2, : width // 3] = False
    counted[-1, -1] = True
    return rendering, photograph, counted


def masked_ssim_by_definition(x, y, counted):
    """Mean SSIM of the pixels that count, window by window; the others are black, as outside of the image."""
    taps = np.exp(-0.5 * (np.arange(-5, 6) / 1.5) ** 2)
    weights = np.outer(taps, taps) / taps.sum() ** 2
    x, y = (np.pad(a * counted[..., None], ((5, 5), (5, 5), (0, 0))) for a in (x, y))
    values = []
    for i, j in np.argwhere(counted):
        for c in range(3):
            p, q = x[i : i + 11, j : j + 11, c], y[i : i + 11, j : j + 11, c]
            m, n = (weights * p).sum(), (weights * q).sum()
            v, w = (weights * p * p).sum() - m * m, (weights * q * q).sum() - n * n
            value = (2 * m * n + 1e-4) * (2 * ((weights * p * q).sum() - m * n) + 9e-4)
            values.append(value / ((m * m + n * n + 1e-4) * (v + w + 9e-4)))
    return np.mean(values)


def test_masked_l1_and_ssim_agree_with_their_definition():
    x, y, counted = masked_pair(19, 23)
    photograph = y.double() / 255
    expected = masked_ssim_by_definition(x.numpy(), photograph.numpy(), counted)
    assert float(ssim(x, photograph, torch.from_numpy(counted))) == pytest.approx(expected, abs=1e-12)
    l1, similarity, _ = l1_and_ssim(x.float().numpy(), y.numpy(), counted=counted)
    assert similarity == pytest.approx(expected, abs=2e-6)
    assert l1 == pytest.approx(float((x - photograph).abs().numpy()[counted].mean()), rel=1e-6)


@pytest.mark.parametrize("size", [(33, 47), (5, 4), (21, 160), (18, 375)], ids=str)
@pytest.mark.parametrize("weight", [0.0, 0.2, 1.0])
def test_masked_loss_and_gradient_agree_with_float64_autograd(size, weight):
    rendering, photograph, counted = masked_pair(*size)
    target = Target.from_image(photograph.numpy(), mask=counted)
    results = []
    for dtype in (torch.float32, torch.float64):
        x = rendering.to(dtype).requires_grad_()
        loss = photometric_loss(x, target, weight)
        (2.5 * loss).backward()
        results.append((loss.item(), x.grad.double()))
    (fused, fused_gradient), (plain, plain_gradient) = results
    assert fused == pytest.approx(plain, abs=3e-6)
    assert (fused_gradient - plain_gradient).abs().max() <= 1e-5 * plain_gradient.abs().max()
    assert not fused_gradient[torch.from_numpy(~counted)].any()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_what_is_masked_does_not_matter_in_either_image(dtype):
    rendering, photograph, counted = masked_pair(30, 40)
    other_rendering, other_photograph = rendering.clone(), photograph.clone()
    other_rendering[torch.from_numpy(~counted)] = 0.7
    other_photograph[torch.from_numpy(~counted)] = 255
    losses = [
        float(photometric_loss(x.to(dtype), Target.from_image(y.numpy(), mask=counted)))
        for x in (rendering, other_rendering)
        for y in (photograph, other_photograph)
    ]
    assert len(set(losses)) == 1


def test_a_mask_of_which_all_counts_changes_nothing():
    rendering, photograph = pair(30, 40)
    every = np.ones((30, 40), dtype=bool)
    x = rendering.float()
    assert torch.equal(
        photometric_loss(x, Target.from_image(photograph.numpy(), mask=every)),
        photometric_loss(x, photograph),
    )


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_view_of_which_nothing_counts_teaches_nothing(dtype):
    rendering, photograph = pair(30, 40)
    x = rendering.to(dtype).requires_grad_()
    loss = photometric_loss(x, Target.from_image(photograph.numpy(), mask=np.zeros((30, 40), dtype=bool)))
    loss.backward()
    assert loss.item() == 0.0 and not x.grad.any()
