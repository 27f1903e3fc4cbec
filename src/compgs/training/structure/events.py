"""What is due after which step of a run, besides the step itself."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass


@dataclass(frozen=True)
class Event:
    """Something to be done after some steps; steps count from 0."""

    due: Callable[[int], bool]
    act: Callable[[], None]


def at_shares(shares: Iterable[float], steps: int) -> frozenset[int]:
    """Steps at these shares of a run."""
    return frozenset(round(share * steps) for share in shares)
