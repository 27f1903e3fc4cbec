"""How large a picture may be, so that it is there in time: found from what the last ones took.

A picture takes fixed + each * share^2 seconds: prediction and projection do not depend on the number of pixels.
"""

import math
from dataclasses import dataclass, field

import numpy as np

LEAST_SHARE = 0.25  # of the sides: less cannot be recognized
# Of the sides, from one picture to the next: one that took long for another reason is not followed at once.
MOST_CHANGE = 1.5
KEPT = 0.8  # of the weight of earlier pictures, with each new one
LEAST_SPREAD = 1e-3  # variance of share^2 from which on the two parts can be told apart
# Of the fixed part: where that alone takes too long, pixels may cost this much more. Smaller would be no quicker.
LEAST_PIXELS = 0.25


@dataclass
class Pace:
    """The share of a picture's sides that fits into some seconds."""

    seconds: float  # that a picture should take; infinite: all are of full size
    share: float = 1.0  # for the next picture
    # Weighted sums of 1, x, x^2, t and x t over the pictures, x = share^2 and t = seconds; the last estimate of `each`.
    _sums: np.ndarray = field(default_factory=lambda: np.zeros(5))
    _each: float | None = None

    def took(self, seconds: float, share: float | None = None) -> None:
        """A picture of `share` took so many seconds; by default one of the share that was asked for."""
        pixels = (self.share if share is None else share) ** 2
        self._sums = KEPT * self._sums + (1, pixels, pixels**2, seconds, pixels * seconds)
        fixed, each = self._parts()
        wanted = math.inf
        if each > 0:
            wanted = math.sqrt(max(self.seconds - fixed, LEAST_PIXELS * fixed) / each)
        step = min(max(wanted / self.share, 1 / MOST_CHANGE), MOST_CHANGE)
        self.share = min(max(self.share * step, LEAST_SHARE), 1.0)

    def _parts(self) -> tuple[float, float]:
        """What does not depend on the size, and what a full picture adds; all is that until sizes have differed."""
        x, xx, t, xt = self._sums[1:] / self._sums[0]
        if xx - x * x > LEAST_SPREAD:
            self._each = max((xt - x * t) / (xx - x * x), 0.0)
        each = min(t / x if self._each is None else self._each, t / x)
        return t - each * x, each
