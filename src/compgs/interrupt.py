"""Ctrl-C and the request to end arrive between two steps, never inside one: half a step could not be continued exactly.

The request to end (SIGTERM: batch systems, containers) is one only where something has been set up to answer it, as
`ended_on_request` does; else it ends the process at once, as everywhere.
"""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

SIGNALS = (signal.SIGINT, signal.SIGTERM)


class Terminated(KeyboardInterrupt):
    """The process was asked to end (SIGTERM). Handled like Ctrl-C by all who know no better."""


@contextmanager
def held_back() -> Iterator[None]:
    """Inside, Ctrl-C and the request to end wait; they arrive when the block is done, as KeyboardInterrupt mostly."""
    if threading.current_thread() is not threading.main_thread():
        yield  # signals arrive in the main thread alone
        return
    arrived: list[tuple[Any, ...]] = []
    handlers = {number: signal.getsignal(number) for number in SIGNALS}
    # What is ignored, or ends the process at once, stays so.
    held = {number: handler for number, handler in handlers.items() if callable(handler)}
    for number in held:
        signal.signal(number, lambda *arguments: arrived.append(arguments))
    try:
        yield
    finally:
        for number, handler in held.items():
            signal.signal(number, handler)
    if arrived:
        held[arrived[0][0]](*arrived[0])


@contextmanager
def ended_on_request() -> Iterator[None]:
    """Inside, SIGTERM raises Terminated, so that there is time to keep what has been done."""
    if (
        threading.current_thread() is not threading.main_thread()
        or signal.getsignal(signal.SIGTERM) is not signal.SIG_DFL
    ):
        yield  # somebody else answers
        return

    def end(*_: object) -> None:
        raise Terminated

    signal.signal(signal.SIGTERM, end)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
