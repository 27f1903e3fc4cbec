"""How few the training views are, for what helps where few look and does no good where many do."""

from compgs.config import Config

FEW_VIEWS = 15  # and fewer are few; twice as many are not any more
# Bytes for each anchor of the beginning, from which on own residual embeddings are worth theirs in a file of a size
# that is asked for: 10 to 19 where they were, with lambda 0.001 (docs/log/2026-11-23-15-residuals.md)
BYTES_FOR_RESIDUALS = 12


def fewness(views: int) -> float:
    """1 where training views are few, 0 where they are many."""
    return min(1.0, max(0.0, 2.0 - views / FEW_VIEWS))


def own_residuals(config: Config, anchors: int, views: int) -> bool:
    """Whether each anchor has its own residual embeddings in a run that starts with so many anchors.

    Few views show a place from few sides, so that an anchor's primitives need to say less of how it looks from others,
    and more of what is there (not in the paper, where they always do).
    """
    m, t = config.model, config.training
    if m.residuals or m.residuals_where_few == 0 or fewness(views) < 0.5:
        return m.residuals
    if t.target_bytes is not None:
        return t.target_bytes >= BYTES_FOR_RESIDUALS * anchors
    return t.lmbda <= m.residuals_where_few
