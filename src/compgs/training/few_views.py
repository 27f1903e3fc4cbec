"""How few the training views are, for what helps where few look and does no good where many do."""

FEW_VIEWS = 15  # and fewer are few; twice as many are not any more


def fewness(views: int) -> float:
    """1 where training views are few, 0 where they are many."""
    return min(1.0, max(0.0, 2.0 - views / FEW_VIEWS))
