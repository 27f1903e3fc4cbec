import math
import sys

import numpy as np
import pytest
import torch
from torch import nn

from compgs import metrics
from compgs.errors import CompGSError
from compgs.numerics.ssim import ssim

RNG = np.random.default_rng(0)
PHOTOGRAPH = RNG.integers(0, 256, (40, 50, 3), dtype=np.uint8)


def disturbed(amount):
    noise = RNG.integers(-amount, amount + 1, PHOTOGRAPH.shape)
    return np.clip(PHOTOGRAPH.astype(int) + noise, 0, 255).astype(np.uint8)


def test_psnr_has_its_closed_form():
    black = np.zeros((8, 9, 3), np.uint8)
    assert metrics.psnr(black, black + 255) == pytest.approx(0.0)
    assert metrics.psnr(black, black + 16) == pytest.approx(20 * math.log10(255 / 16))
    one_wrong = black.copy()
    one_wrong[3, 4, 1] = 255
    assert metrics.psnr(black, one_wrong) == pytest.approx(10 * math.log10(8 * 9 * 3))


def test_identical_images_have_infinite_psnr_and_an_ssim_of_one():
    assert metrics.psnr(PHOTOGRAPH, PHOTOGRAPH.copy()) == math.inf
    assert metrics.ssim(PHOTOGRAPH, PHOTOGRAPH.copy()) == pytest.approx(1.0, abs=1e-6)


def test_of_pictures_that_may_be_equal_the_mean_is_finite_unless_all_are():
    assert metrics.mean_psnr([30.0, 40.0]) == 35.0
    assert metrics.mean_psnr([math.inf, 40.0]) == 70.0
    assert metrics.mean_psnr([120.0, 40.0]) == 70.0
    assert metrics.mean_psnr([math.inf, math.inf]) == math.inf


@pytest.mark.parametrize("metric", [metrics.psnr, metrics.ssim])
def test_metrics_are_symmetric_and_fall_with_the_disturbance(metric):
    values = [metric(PHOTOGRAPH, disturbed(amount)) for amount in (2, 20, 100)]
    assert values[0] > values[1] > values[2]
    other = disturbed(20)
    assert metric(PHOTOGRAPH, other) == pytest.approx(metric(other, PHOTOGRAPH), rel=1e-5)


def test_ssim_agrees_with_float64():
    # Flat images are the hardest for single precision: their variances are differences of equal numbers.
    flat, other = np.full((60, 70, 3), 100, np.uint8), np.full((60, 70, 3), 150, np.uint8)
    for a, b in ((PHOTOGRAPH, disturbed(30)), (flat, other)):
        x, y = (torch.tensor(image).double() / 255 for image in (a, b))
        assert metrics.ssim(a, b) == pytest.approx(ssim(x, y).item(), abs=3e-5)


def test_renderings_are_rounded_and_clamped_not_truncated():
    image = torch.tensor([[[0.9 / 255, 0.4 / 255, 254.6 / 255], [-0.3, 1.7, 1.0]]])
    assert metrics.to_8bit(image).tolist() == [[[1, 0, 255], [0, 255, 255]]]


@pytest.mark.parametrize(
    "other", [PHOTOGRAPH[:, :49], PHOTOGRAPH / 255.0, PHOTOGRAPH[..., 0]], ids=["size", "floats", "gray"]
)
def test_images_that_cannot_be_compared_are_refused(other):
    for metric in (metrics.psnr, metrics.ssim, metrics.lpips):
        with pytest.raises(ValueError, match=r"\[H, W, 3\]|size"):
            metric(PHOTOGRAPH, other)


class MadeNetwork(nn.Module):
    """LPIPS in kind (distance of normalized features), with made weights; keeps what it was given."""

    def __init__(self):
        super().__init__()
        torch.manual_seed(0)
        self.features = nn.Conv2d(3, 8, 3)
        self.seen = []

    def forward(self, a, b):
        self.seen.append((a, b))
        a, b = (nn.functional.normalize(self.features(x), dim=1) for x in (a, b))
        return (a - b).square().sum(1).mean()


def test_lpips_gives_its_network_planar_images_in_minus_one_to_one():
    network = MadeNetwork()
    image = np.zeros((6, 7, 3), np.uint8)
    image[0, 1, 2] = 255
    metrics.lpips(image, image, network)
    ((given, _),) = network.seen
    assert given.shape == (1, 3, 6, 7)
    assert given.min() == -1.0 and given[0, 2, 0, 1] == 1.0 and (given == 1.0).sum() == 1


def test_lpips_is_zero_for_identical_images_and_grows_with_the_disturbance():
    network = MadeNetwork()
    assert metrics.lpips(PHOTOGRAPH, PHOTOGRAPH, network) == 0.0
    near, far = (metrics.lpips(PHOTOGRAPH, disturbed(amount), network) for amount in (2, 100))
    assert 0.0 < near < far


def test_lpips_without_its_packages_names_the_extra_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "torchvision", None)
    metrics.lpips_network.cache_clear()
    with pytest.raises(metrics.Unavailable, match=r"pip install '\.\[lpips\]' in the project's folder"):
        metrics.lpips(PHOTOGRAPH, PHOTOGRAPH)
    assert issubclass(metrics.Unavailable, CompGSError)


def test_lpips_without_weights_says_which_file_is_missing_and_downloads_nothing(monkeypatch, tmp_path):
    pytest.importorskip("torchvision", reason="torchvision is not installed")
    pytest.importorskip("torchmetrics", reason="torchmetrics is not installed")
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path))
    metrics.lpips_network.cache_clear()
    with pytest.raises(metrics.Unavailable, match=r"alexnet.*missing"):
        metrics.lpips(PHOTOGRAPH, PHOTOGRAPH, "alex")
    assert list(tmp_path.iterdir()) == []
