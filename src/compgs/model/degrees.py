"""How many spherical harmonics there are of a degree."""

MAX_DEGREE = 3


def coefficients(degree: int) -> int:
    """Number of basis functions up to a degree: 1, 4, 9 or 16."""
    return (degree + 1) ** 2


def harmonics_above_dc(degree: int) -> int:
    """Number of basis functions of degree 1 to `degree`: 0, 3, 8 or 15."""
    return coefficients(degree) - 1


def degree_of(count: int) -> int:
    """Inverse of `harmonics_above_dc`."""
    return next(d for d in range(MAX_DEGREE + 1) if harmonics_above_dc(d) == count)
