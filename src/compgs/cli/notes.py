"""Notes of the program (`compgs.notes`), shown to a person while a command runs."""

import logging
from collections.abc import Iterator
from contextlib import contextmanager

from compgs.cli.console import say
from compgs.notes import LOGGER


class Shown(logging.Handler):
    """Says each line once: a command may open a file more than once."""

    def __init__(self) -> None:
        super().__init__()
        self.said: set[str] = set()

    def emit(self, record: logging.LogRecord) -> None:
        text = record.getMessage()
        if text not in self.said:
            self.said.add(text)
            say(f"note: {text}")


@contextmanager
def notes_shown() -> Iterator[None]:
    """Notes are shown while this lasts."""
    handler = Shown()
    LOGGER.addHandler(handler)
    try:
        yield
    finally:
        LOGGER.removeHandler(handler)
