"""What is to be said about an input that is read, but not as it stands: one line each, of the logger `compgs`.

The command line shows each line once, as a note. In a Python program they are warnings of `logging`, which prints
them unless it is told otherwise.
"""

import logging
from pathlib import Path

LOGGER = logging.getLogger("compgs")


def note(place: Path, text: str) -> None:
    """Say something about a file."""
    LOGGER.warning("%s: %s", place, text)
