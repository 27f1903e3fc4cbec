"""How large codebooks are: as published, or as small as a small scene asks for."""

from collections.abc import Callable


def entries_within(
    published: int,  # entries of the codebook as published, or of the largest of several
    other_bytes: float,  # of the file, without the codebooks
    bytes_of: Callable[[int], float],  # bytes of the codebooks of so many entries, growing with them
    share: float,  # of the file that they may take; 1: whatever they take
) -> int:
    """Return as many entries as published, or half as many, and so on, until the codebooks take at most a share of the
    file.
    """
    entries = published
    while entries > 1 and share < 1 and bytes_of(entries) > share / (1 - share) * other_bytes:
        entries = (entries + 1) // 2
    return entries
