"""Memory that was freed, and that the process still holds."""

import ctypes


def give_back_freed() -> None:
    """Return all pages that nothing is in to the system. Without glibc nothing happens.

    glibc returns only what lies at the top of its heap. Where small arrays that stay are made between large ones that
    go, the gaps between them stay, too.
    """
    try:
        trim = ctypes.CDLL(None).malloc_trim
    except (AttributeError, OSError, TypeError):
        return
    trim(0)
