"""Photographs that are kept where they are looked at, within a bound on memory."""

from collections.abc import Callable, Hashable

from compgs.losses import Target


class KeptPhotographs:
    """Photographs by key; those that were made first go when there is no room for another."""

    def __init__(self, most_bytes: int) -> None:
        """`most_bytes`: 3 a pixel, without masks."""
        self.most_bytes = most_bytes
        self.targets: dict[Hashable, Target] = {}

    def get(self, key: Hashable, make: Callable[[], Target]) -> Target:
        """The photograph of a key; if it is not kept, what `make` gives."""
        kept = self.targets
        if key not in kept:
            target = make()
            room = self.most_bytes - target.image.numel()
            while kept and sum(t.image.numel() for t in kept.values()) > room:
                del kept[next(iter(kept))]
            kept[key] = target
        return kept[key]
