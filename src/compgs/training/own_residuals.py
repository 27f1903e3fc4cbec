"""Whether anchors have their own residual embeddings, where the settings leave it to training (not in the paper).

Few views show a place from few sides, so that an anchor's primitives need to say less of how it looks from others, and
more of what is there.
"""

from compgs.config import Config
from compgs.training.few_views import fewness

# Bytes for each anchor of the beginning, from which on own residual embeddings are worth theirs in a file of a size
# that is asked for: 10 to 19 where they were, with lambda 0.001 (docs/log/2026-11-23-15-residuals.md)
BYTES_FOR_RESIDUALS = 12
FEW_ENOUGH = 0.5  # `fewness` from which on they pay


def own_residuals(config: Config, anchors: int, views: int) -> bool:
    """Whether each anchor has its own in a run that starts with so many anchors."""
    m, t = config.model, config.training
    if m.residuals or m.residuals_where_few == 0 or fewness(views) < FEW_ENOUGH:
        return m.residuals
    if t.target_bytes is not None:
        return t.target_bytes >= BYTES_FOR_RESIDUALS * anchors
    return t.lmbda <= m.residuals_where_few
