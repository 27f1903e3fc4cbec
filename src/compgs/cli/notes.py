"""What the program logs, shown to a person while a command runs: notes (`compgs.notes`), and how far something long is
(`compgs.progress`) where no terminal shows it.
"""

import logging
from collections.abc import Iterator
from contextlib import contextmanager

from compgs.cli.console import say
from compgs.notes import LOGGER


class Shown(logging.Handler):
    """Says each note once: a command may open a file more than once."""

    def __init__(self) -> None:
        super().__init__()
        self.said: set[str] = set()

    def emit(self, record: logging.LogRecord) -> None:
        text = record.getMessage()
        if record.levelno < logging.WARNING:
            say(text)
        elif text not in self.said:
            self.said.add(text)
            say(f"note: {text}")


@contextmanager
def notes_shown() -> Iterator[None]:
    """Notes, and progress, are shown while this lasts."""
    handler, level = Shown(), LOGGER.level
    LOGGER.addHandler(handler)
    LOGGER.setLevel(logging.INFO)
    try:
        yield
    finally:
        LOGGER.setLevel(level)
        LOGGER.removeHandler(handler)
