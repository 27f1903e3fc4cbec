"""How large a picture may be, so that it is there in time: found from what the last ones took."""

import math
from dataclasses import dataclass

LEAST_SHARE = 0.25  # of the sides: less cannot be recognized, and what does not depend on the size remains
# Of the sides, from one picture to the next: one that took long for another reason is not followed at once.
MOST_CHANGE = 1.5


@dataclass
class Pace:
    """The share of a picture's sides that fits into some seconds. Time is taken to follow the number of pixels."""

    seconds: float  # that a picture should take; infinite: all are of full size
    share: float = 1.0  # for the next picture

    def took(self, seconds: float) -> None:
        """A picture of `share` took so many seconds."""
        wanted = self.share * math.sqrt(self.seconds / max(seconds, 1e-6))
        step = min(max(wanted / self.share, 1 / MOST_CHANGE), MOST_CHANGE)
        self.share = min(max(self.share * step, LEAST_SHARE), 1.0)
