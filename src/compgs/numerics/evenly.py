"""A few of many things, evenly spread over their order."""


def evenly(count: int, most: int) -> list[int]:
    """Return indices of at most `most` of `count` things, ascending; of all of them, if they are no more."""
    chosen = max(0, min(count, most))
    return [i * count // chosen for i in range(chosen)]
