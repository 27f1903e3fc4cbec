"""Colors of renderings beside photographs that were not all exposed and balanced alike.

No training knows what the camera of a held-out view chose. So quality is told twice: as it is, and with the colors of
each rendering fitted to its photograph by the affine change with the least squared error.
"""

import numpy as np

# Times the number of pixels: keeps the fit near to no change in what a view does not show. Of [0, 1] colors squared.
DAMPING = 1e-4


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


def with_fitted_colors(
    rendering: np.ndarray, photograph: np.ndarray, mask: np.ndarray | None = None
) -> np.ndarray:
    """The rendering [H, W, 3] uint8 in the colors of its photograph."""
    return at_exposure(rendering, fitted_exposure(rendering, photograph, mask))
