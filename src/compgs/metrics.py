"""Image quality: PSNR, SSIM, LPIPS, FLIP. Every number the project reports follows these conventions.

- Images are uint8 [H, W, 3], display RGB: a rendering is *rounded* to 8 bits (`to_8bit`), as a file would be,
  not truncated and not left in floating point.
- PSNR: of the mean squared error over pixels and channels, data range 255; identical images give infinity.
- SSIM: 11 x 11 Gaussian window, sigma 1.5, zeros outside the image, data range 1, C1 = 0.01^2, C2 = 0.03^2,
  mean over pixels and channels: the one of 3DGS (`compgs.numerics.ssim`).
- LPIPS: version 0.1 on VGG16 (`compgs.lpips`), in both conventions that are in use: `lpips` gives the network images
  in [-1, 1], as it is meant; `lpips_3dgs` gives it [0, 1], as the releases of 3DGS and CompGS do. The second is what
  tables of Gaussian splatting have; the two do not compare.
- FLIP: what people see of the difference when the two images take turns on a screen, by a model of their eyes; no
  learned weights. NVIDIA's implementation, of images of low dynamic range, seen at 67 pixels a degree (its default: a
  screen of 3 840 pixels on 0.7 m, from as far away); mean over the pixels, 0 to 1, less is better.

- With a mask [H, W] bool, True where a pixel counts (`compgs.scene.masks`): PSNR and SSIM are means over the pixels
  that count; for SSIM the others are black in both images, as what lies outside of an image is. LPIPS: black in both,
  and the distance is divided by the share of pixels that count. FLIP: black in both, mean over the pixels that count.

A metric over views is the mean of the views' metrics.
"""

import functools
import math
from collections.abc import Callable, Sequence
from statistics import fmean
from typing import Any

import numpy as np

from compgs.errors import Unavailable, install_line
from compgs.lpips import LpipsDistances, LpipsNetwork, lpips_network
from compgs.numerics.ssim import l1_and_ssim

__all__ = [
    "LpipsDistances",
    "LpipsNetwork",
    "Unavailable",
    "check_flip",
    "flip",
    "lpips",
    "lpips_network",
    "mean_psnr",
    "psnr",
    "ssim",
    "to_8bit",
]

PIXELS_A_DEGREE = 67.0206  # of FLIP
SAME_PICTURE = 100.0  # dB, about what one level in one pixel of one channel comes to


def to_8bit(image: np.ndarray) -> np.ndarray:
    """[H, W, 3] rendered, 0 to 1 -> uint8: clamped and rounded."""
    return np.rint(np.clip(np.asarray(image), 0.0, 1.0) * np.float32(255.0)).astype(np.uint8)


def _check(a: np.ndarray, b: np.ndarray, mask: np.ndarray | None) -> None:
    for image in (a, b):
        if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3:
            raise ValueError(
                f"expected uint8 images [H, W, 3] (see to_8bit), found {image.dtype} {list(image.shape)}"
            )
    if a.shape != b.shape:
        raise ValueError(f"images of different size: {list(a.shape[:2])} and {list(b.shape[:2])} (H, W)")
    if mask is not None and (mask.dtype != np.bool_ or mask.shape != a.shape[:2] or not mask.any()):
        raise ValueError(
            f"expected a mask {list(a.shape[:2])} of bool that is True somewhere, found {mask.dtype} {list(mask.shape)}"
        )


def psnr(a: np.ndarray, b: np.ndarray, mask: np.ndarray | None = None) -> float:
    """Peak signal-to-noise ratio in dB of uint8 images [H, W, 3], over the pixels of a mask or all."""
    _check(a, b, mask)
    difference = a.astype(np.int32) - b.astype(np.int32)
    counted = difference if mask is None else difference[mask]
    error = float(np.mean(np.square(counted), dtype=np.float64))
    return math.inf if error == 0.0 else 10.0 * math.log10(255.0**2 / error)


def mean_psnr(values: Sequence[float]) -> float:
    """dB, of pictures that may be equal: those count as SAME_PICTURE, unless all are; then it is infinite."""
    return math.inf if min(values) == math.inf else fmean(min(value, SAME_PICTURE) for value in values)


def ssim(a: np.ndarray, b: np.ndarray, mask: np.ndarray | None = None) -> float:
    """Structural similarity of uint8 images [H, W, 3], over the pixels of a mask or all; 1 for identical images."""
    _check(a, b, mask)
    x = a.astype(np.float32) / np.float32(255.0)
    # Writable, as in training: read-only arrays would be compiled for anew.
    return l1_and_ssim(np.ascontiguousarray(x), np.require(b, requirements=("C", "W")), counted=mask)[1]


def flip(a: np.ndarray, b: np.ndarray, mask: np.ndarray | None = None) -> float:
    """Visible difference (Andersson et al. 2020) of uint8 images [H, W, 3], `b` the true one; 0 for identical images.

    Mean over the pixels of a mask or all. Raises Unavailable where the package is missing.
    """
    _check(a, b, mask)
    evaluate = _flip_evaluate()
    black = np.uint8(1) if mask is None else mask[:, :, None].astype(np.uint8)
    seen, true = ((image * black).astype(np.float32) / np.float32(255.0) for image in (a, b))
    errors = np.asarray(
        evaluate(
            true, seen, "LDR", applyMagma=False, computeMeanError=False, parameters={"ppd": PIXELS_A_DEGREE}
        )[0]
    ).reshape(a.shape[:2])
    return float(np.mean(errors if mask is None else errors[mask], dtype=np.float64))


def check_flip() -> None:
    """Raises Unavailable, with the remedy, where FLIP cannot be measured."""
    _flip_evaluate()


@functools.cache
def _flip_evaluate() -> Callable[..., Any]:
    try:
        from flip_evaluator import evaluate
    except ImportError as error:
        raise Unavailable(f"FLIP needs flip-evaluator ({error}): {install_line('flip')}") from error
    return evaluate


def lpips(
    a: np.ndarray, b: np.ndarray, network: LpipsNetwork | None = None, mask: np.ndarray | None = None
) -> LpipsDistances:
    """Learned perceptual distances (Zhang et al. 2018) of uint8 images [H, W, 3] in both conventions; 0 if identical.

    `network`: of `lpips_network`, which takes a file of weights and a device; None: the weights that are installed.
    Raises Unavailable where torch or the weights are missing; nothing is downloaded.
    """
    _check(a, b, mask)
    chosen = network or _installed_network()
    if mask is None:
        return chosen.distances(a, b)
    black, share = mask[:, :, None].astype(np.uint8), float(mask.mean())
    return LpipsDistances(*(distance / share for distance in chosen.distances(a * black, b * black)))


@functools.cache
def _installed_network() -> LpipsNetwork:
    return lpips_network()
