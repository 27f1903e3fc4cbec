"""BD-rate against closed forms."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from compgs.errors import ConfigError
from compgs.evaluation.bd_rate import bd_rate


def log_linear(slope: float, offset: float, qualities: list[float]) -> list[tuple[float, float]]:
    """log(bytes) = slope * quality + offset: what PCHIP reproduces exactly."""
    return [(math.exp(slope * q + offset), q) for q in qualities]


def test_a_curve_against_itself_is_zero() -> None:
    curve = [(100e3, 27.0), (150e3, 28.1), (300e3, 29.0), (700e3, 29.6)]
    assert bd_rate(curve, curve) == pytest.approx(0.0, abs=1e-12)


@given(st.floats(0.05, 20), st.lists(st.floats(20, 40), min_size=4, max_size=8, unique=True))
def test_a_constant_factor_in_bytes_is_found(factor: float, qualities: list[float]) -> None:
    spaced = [q + i for i, q in enumerate(sorted(qualities))]
    reference = [(1e3 * (1 + i) ** 2, q) for i, q in enumerate(spaced)]
    test = [(factor * size, q) for size, q in reference]
    assert bd_rate(reference, test) == pytest.approx(factor - 1, rel=1e-9, abs=1e-9)


def test_log_linear_curves_have_a_closed_form() -> None:
    reference = log_linear(0.5, 1.0, [20, 24, 27, 30])
    test = log_linear(0.8, -9.0, [22, 25, 29, 33])
    # mean of (0.8 - 0.5) q - 10 over the common qualities 22 to 30, whose mean is 26
    assert bd_rate(reference, test) == pytest.approx(math.exp(0.3 * 26 - 10) - 1, rel=1e-9)


def test_swapping_the_curves_inverts_the_ratio() -> None:
    a = [(90e3, 26.0), (140e3, 27.5), (260e3, 28.7), (600e3, 29.5)]
    b = [(60e3, 26.2), (95e3, 27.4), (190e3, 28.9), (420e3, 29.4)]
    assert (1 + bd_rate(a, b)) * (1 + bd_rate(b, a)) == pytest.approx(1.0, rel=1e-12)


def test_order_of_the_points_does_not_matter() -> None:
    a = [(90e3, 26.0), (140e3, 27.5), (260e3, 28.7)]
    b = [(60e3, 26.2), (95e3, 27.4), (190e3, 28.9)]
    assert bd_rate(a[::-1], [b[1], b[2], b[0]]) == bd_rate(a, b)


def test_dense_sampling_approaches_the_integral() -> None:
    def log_bytes(q: np.ndarray) -> np.ndarray:
        return 0.02 * (q - 20) ** 2

    q = np.linspace(24, 32, 200)
    reference = [(float(np.exp(3.0)) * (1 + i * 1e-9), float(v)) for i, v in enumerate(q)]
    test = [(float(np.exp(log_bytes(v))), float(v)) for v in q]
    mean = 0.02 * ((32 - 20) ** 3 - (24 - 20) ** 3) / 3 / 8 - 3.0
    assert bd_rate(reference, test) == pytest.approx(math.exp(mean) - 1, rel=1e-4)


@pytest.mark.parametrize(
    ("reference", "test", "word"),
    [
        ([(1.0, 20.0)], [(1.0, 20.0), (2.0, 21.0)], "two"),
        ([(1.0, 20.0), (2.0, 21.0)], [(1.0, 25.0), (2.0, 26.0)], "quality"),
        ([(1.0, 21.0), (2.0, 20.0)], [(1.0, 20.0), (2.0, 21.0)], "more bytes"),
        ([(0.0, 20.0), (2.0, 21.0)], [(1.0, 20.0), (2.0, 21.0)], "positive"),
        ([(1.0, 20.0), (2.0, float("nan"))], [(1.0, 20.0), (2.0, 21.0)], "finite"),
    ],
)
def test_curves_that_cannot_be_compared_are_refused(reference, test, word) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(ConfigError, match=word):
        bd_rate(reference, test)
