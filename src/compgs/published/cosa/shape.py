"""What the causal chain is made of: groups of numbers of an anchor, and the networks between them. Free of torch.

coordinates ─► geometry ─┬─► latent, channel after channel ─► embedding ─┐
                         └──────────────────────────────────────────────┴─► anchor ─┬─► feature, position scale
                                            position scale ─► scale embedding ──────┴─► offsets, sizes
"""

from collections.abc import Iterator
from dataclasses import dataclass

SCALE_EMBEDDING = 8  # channels of the embedded position scale
COORDINATES = 3
# In the order in which they are decoded.
GROUPS = ("latent", "feature", "position_scale", "offset", "size")


@dataclass(frozen=True)
class ChainShape:
    """Sizes of a chain."""

    coupled: int  # K, slots of an anchor
    features: int
    latents: int
    context: int

    def network_sizes(self) -> Iterator[tuple[str, int, int]]:
        """Name, inputs and outputs of each network, in the file's order. Those of groups give means and scales."""
        both = self.context + SCALE_EMBEDDING
        yield "geometry", COORDINATES, self.context
        for channel in range(self.latents):
            yield f"latent{channel}", self.context + channel, 2
        yield "embedding", self.latents, self.context
        yield "anchor", 2 * self.context, self.context
        yield "feature", self.context, 2 * self.features
        yield "position_scale", self.context, 2
        yield "scale_embedding", 1, SCALE_EMBEDDING
        yield "offset", both, 6 * self.coupled
        yield "size", both, 6

    def channels(self, group: str) -> int:
        """Numbers of an anchor; of an offset, those of a coupled primitive."""
        return {
            "latent": self.latents,
            "feature": self.features,
            "position_scale": 1,
            "offset": 3,
            "size": 3,
        }[group]
