"""Bjontegaard delta rate: how many bytes one codec needs of another's at equal quality.

Both curves are interpolated as log(bytes) over quality by monotone piecewise cubics (PCHIP, as in the JVET's
common test conditions; the single cubic of Bjontegaard 2001 overshoots between unevenly spaced points), and
the mean difference over the qualities that both reach is turned back into a ratio.
"""

from collections.abc import Sequence

import numpy as np

from compgs.errors import ConfigError
from compgs.extras import require

Curve = Sequence[tuple[float, float]]  # (bytes, quality), one pair per encoded file, in any order


def bd_rate(reference: Curve, test: Curve) -> float:
    """Mean change of bytes at equal quality, from `reference` to `test`: -0.3 means 30 % smaller files.

    Quality is a number that is larger for better images (PSNR in dB, SSIM). Raises ConfigError for curves of
    fewer than two points, curves on which more bytes do not mean more quality, and curves that share no
    quality; MissingDependency without scipy.
    """
    require("train", "BD-rate")
    from scipy.interpolate import PchipInterpolator

    reference_quality, reference_log_bytes = _sorted_curve(reference, "reference")
    test_quality, test_log_bytes = _sorted_curve(test, "test")
    low = max(reference_quality[0], test_quality[0])
    high = min(reference_quality[-1], test_quality[-1])
    if not low < high:
        raise ConfigError(
            f"BD-rate: no common quality: {reference_quality[0]:.4g} to {reference_quality[-1]:.4g} "
            f"and {test_quality[0]:.4g} to {test_quality[-1]:.4g}; encode at more rates"
        )
    reference_area = PchipInterpolator(reference_quality, reference_log_bytes).integrate(low, high)
    test_area = PchipInterpolator(test_quality, test_log_bytes).integrate(low, high)
    return float(np.expm1((test_area - reference_area) / (high - low)))


def _sorted_curve(curve: Curve, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Qualities, ascending, and log bytes; both [P] float64."""
    if len(curve) < 2:
        raise ConfigError(f"BD-rate: the {name} curve has {len(curve)} points, at least two are needed")
    points = np.asarray(sorted(curve), dtype=np.float64)
    size, quality = points[:, 0], points[:, 1]
    if not (np.isfinite(points).all() and (size > 0).all()):
        raise ConfigError(
            f"BD-rate: the {name} curve holds a size that is not positive or a value that is not finite"
        )
    if not (np.diff(quality) > 0).all():
        raise ConfigError(
            f"BD-rate: on the {name} curve more bytes do not always mean more quality; drop those points"
        )
    return quality, np.log(size)
