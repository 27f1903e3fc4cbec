"""How large the prediction networks are: the price of a bit decides (not in the paper).

A bit of the networks adds lambda * RATE_PER_BIT / N to the objective (`losses.rate`), as N anchors share it. With a
large lambda and few anchors the networks would be a third to a half of the file: there fewer hidden units and coarser
weights cost less than they save. Where anchors are many, or bits cheap, nothing changes.
"""

from typing import Literal

from compgs.config import Config
from compgs.training.own_residuals import CHEAP_BYTES, Limits, often_seen

# Hidden units from a price of a bit on, lambda / N as the run starts (docs/log/2026-11-23-14-pruning.md).
WIDTHS = ((6e-7, 24), (1e-6, 16), (1.5e-6, 8))
# And up to a size of the file, where one is asked for.
WIDTHS_OF_SIZES = ((26_000, 24), (18_000, 16), (9_000, 8))
# Bits by which weights are shorter, from a price on, lambda / N of the anchors that there are in the end.
SHORTER = ((3e-6, 1), (3e-5, 2))


def hidden_width(config: Config, anchors: int) -> int:
    """Hidden units of the networks of a run that starts with so many anchors; at most `model.width`."""
    return min([config.model.width, *_narrower(config, anchors)])


def reference_context(config: Config, anchors: int) -> Literal["neighbours", "hyperprior", "none"]:
    """Of a run that starts with so many anchors: none where networks are narrower. In so small a file a context hardly
    saves what its network costs.
    """
    return "none" if _narrower(config, anchors) else config.model.reference_context


def _narrower(config: Config, anchors: int) -> list[int]:
    """Hidden units that the price of a bit, or the size that is asked for, leaves to the networks."""
    t = config.training
    if not config.model.networks_by_price:
        return []
    if t.target_bytes is not None:
        return [width for size, width in WIDTHS_OF_SIZES if t.target_bytes <= size]
    return [width for price, width in WIDTHS if t.lmbda >= price * anchors]


def head_bits(config: Config, lmbda: float, anchors: int) -> int:
    """Of a weight of the networks, sign included; at most `entropy.head_bits`."""
    most = config.entropy.head_bits
    if not config.model.networks_by_price:
        return most
    return most - max([0, *(bits for price, bits in SHORTER if lmbda >= price * anchors)])


def head_layout(config: Config, anchors: int, views: int) -> Literal["separate", "paired"]:
    """Of a run that starts with so many anchors: separate networks also where a run that sees its views often has the
    time for them, and bits are so cheap that twice as many weights hardly count.
    """
    cheap = Limits(config.model.separate_where_long, CHEAP_BYTES).met(config, anchors)
    return "separate" if cheap and often_seen(config, views) else config.model.heads
