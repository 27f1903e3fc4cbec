"""How large the prediction networks are: the price of a bit decides (not in the paper).

A bit of the networks adds lambda * RATE_PER_BIT / N to the objective (`losses.rate`), as N anchors share it. With a
large lambda and few anchors the networks would be a third to a half of the file: there fewer hidden units and coarser
weights cost less than they save. With half of the units a step takes a tenth to a sixth less, too: they pay long before
that. Where anchors are many, or bits cheap, nothing changes.
"""

from dataclasses import dataclass
from typing import Literal

from compgs.config import Config
from compgs.training.own_residuals import CHEAP_BYTES, Limits, often_seen


@dataclass(frozen=True)
class Dear:
    """From where on bits are dear."""

    price: float  # lambda / N as the run starts, at least
    size: int  # bytes of the file at most, where a size is asked for: it decides then

    def met(self, config: Config, anchors: int) -> bool:
        """Whether they are in a run that starts with so many anchors."""
        t = config.training
        if not config.model.networks_by_price:
            return False
        if t.target_bytes is not None:
            return t.target_bytes <= self.size
        return t.lmbda >= self.price * anchors


# Hidden units. Fox with lambda 0.001 (a price of 1.2e-7) is better with 32, plush (1.6e-7) with 16
# (docs/log/2026-11-25-31-figures.md).
WIDTHS = ((Dear(1.4e-7, 50_000), 16), (Dear(1.5e-6, 9_000), 8))
# In so small a file a context hardly saves what its network costs (docs/log/2026-11-24-21-context.md).
NO_CONTEXT = Dear(6e-7, 26_000)
# Bits by which weights are shorter, from a price on, lambda / N of the anchors that there are in the end.
SHORTER = ((3e-6, 1), (3e-5, 2))


def hidden_width(config: Config, anchors: int) -> int:
    """Hidden units of the networks of a run that starts with so many anchors; at most `model.width`."""
    return min([config.model.width, *(width for dear, width in WIDTHS if dear.met(config, anchors))])


def reference_context(config: Config, anchors: int) -> Literal["neighbours", "hyperprior", "none"]:
    """Of a run that starts with so many anchors."""
    return "none" if NO_CONTEXT.met(config, anchors) else config.model.reference_context


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
