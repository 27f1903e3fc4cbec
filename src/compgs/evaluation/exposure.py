"""Exposure of held-out views, for scenes whose photographs were not all taken alike.

No training knows a held-out view's exposure, so it is fitted to half of the photograph, and the other half is what
counts (the protocol of NeRF in the Wild, Martin-Brualla et al. 2021): an affine change of color between rendering and
photograph, least squares over the left half; PSNR, SSIM and LPIPS are then of the right half alone.
"""

import numpy as np

# Times the number of pixels: keeps the fit near to no change in what the half does not show. Of [0, 1] colors squared.
DAMPING = 1e-4
DESCRIPTION = "affine color of each view, fitted to its left half; metrics of the right half"


def fitted_exposure(
    rendering: np.ndarray,  # [H, W, 3] uint8
    photograph: np.ndarray,  # [H, W, 3] uint8
    mask: np.ndarray | None = None,  # [H, W] bool: pixels that count; None: all
) -> np.ndarray:  # [3, 4] float64: matrix and offset, for colors from 0 to 1
    """The affine change of the rendering's colors that is nearest to the photograph's."""
    counted = np.ones(rendering.shape[:2], dtype=bool) if mask is None else mask
    colors = rendering[counted] / 255.0
    inputs = np.concatenate([colors, np.ones((len(colors), 1))], axis=1)
    change = photograph[counted] / 255.0 - colors
    gram = inputs.T @ inputs + DAMPING * max(len(colors), 1) * np.eye(4)
    return np.eye(3, 4) + np.linalg.solve(gram, inputs.T @ change).T


def at_exposure(rendering: np.ndarray, exposure: np.ndarray) -> np.ndarray:
    """[H, W, 3] uint8 as a camera of that exposure [3, 4] shows it."""
    colors = rendering / 255.0 @ exposure[:, :3].T + exposure[:, 3]
    return np.rint(np.clip(colors, 0, 1) * 255).astype(np.uint8)


def exposed_by_left_half(
    rendering: np.ndarray, photograph: np.ndarray, mask: np.ndarray | None
) -> np.ndarray:
    """The rendering [H, W, 3] uint8 at the exposure of its photograph, as the left half shows it."""
    left = (slice(None), slice(None, rendering.shape[1] // 2))
    exposure = fitted_exposure(rendering[left], photograph[left], None if mask is None else mask[left])
    return at_exposure(rendering, exposure)


def right_half(image: np.ndarray) -> np.ndarray:
    """Return the half of [H, W, ...] that `exposed_by_left_half` has not looked at."""
    return image[:, image.shape[1] // 2 :]
