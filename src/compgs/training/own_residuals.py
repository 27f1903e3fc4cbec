"""Whether anchors have their own residual embeddings, and how many, where the settings leave it to training (not in the
paper).

Few views show a place from few sides, so that an anchor's primitives need to say less of how it looks from others, and
more of what is there. Where views are many the same bits are better spent on more anchors, until bits are so cheap that
more anchors bring nothing either; and then only a long run has the time to learn them.
"""

from dataclasses import dataclass

from compgs.config import Config
from compgs.training.few_views import fewness

FEW_ENOUGH = 0.5  # `fewness` from which on views are few here
PASSES = (
    45  # over the training views, where these are many: 46 were enough, with 23 to 43 shared ones were better
)
# Of a file for each anchor of the beginning, where a size is asked for: from here on bits are as cheap as with a lambda
# of 1e-5 (docs/log/2026-11-23-16-top.md).
CHEAP_BYTES = 40
# From here on, where views are few, as with a lambda of 1e-4 (docs/log/2026-11-24-22-time.md).
CHEAP_BYTES_WHERE_FEW = 60
MOST_COUPLED = 64  # that a file can hold of an anchor


@dataclass(frozen=True)
class Limits:
    """Up to which what costs bits is worth them."""

    lmbda: float  # 0: never
    # For each anchor of the beginning, where a file's size is asked for: what files had with that lambda
    # (docs/log/2026-11-23-15-residuals.md).
    bytes: int

    def met(self, config: Config, anchors: int) -> bool:
        """Whether bits are as cheap in a run that starts with so many anchors."""
        t = config.training
        if self.lmbda == 0:
            return False
        if t.target_bytes is not None:
            return t.target_bytes >= self.bytes * anchors
        return t.lmbda <= self.lmbda


def own_residuals(config: Config, anchors: int, views: int) -> bool:
    """Whether each anchor has its own in a run that starts with so many anchors."""
    return config.model.residuals or _limits(config, views).met(config, anchors)


def _limits(config: Config, views: int) -> Limits:
    m = config.model
    if fewness(views) >= FEW_ENOUGH:
        return Limits(m.residuals_where_few, 12)
    if long_run(config, views):
        return Limits(m.residuals_where_many, CHEAP_BYTES)
    return Limits(0.0, 0)


def long_run(config: Config, views: int) -> bool:
    """Whether there is the time to learn what many views show beyond what all anchors can share."""
    return fewness(views) < FEW_ENOUGH and often_seen(config, views)


def often_seen(config: Config, views: int) -> bool:
    """Whether a run passes over its training views often."""
    return config.training.steps * config.training.views_per_step >= PASSES * views


def coupled_primitives(config: Config, anchors: int, views: int) -> int:
    """K of a run that starts with so many anchors: twice as many where few views look and bits are cheap."""
    m = config.model
    cheap = Limits(m.twice_coupled_where_few, CHEAP_BYTES_WHERE_FEW).met(config, anchors)
    twice = cheap and fewness(views) >= FEW_ENOUGH
    return min(2 * m.coupled_primitives, MOST_COUPLED) if twice else m.coupled_primitives
