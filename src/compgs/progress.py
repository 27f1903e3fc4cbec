"""How far a long computation is, for whoever calls it from Python: one line on a terminal or in a notebook, which
changes; elsewhere lines of the logger `compgs`, at the level INFO, of what takes longer than LOG_SECONDS.

Functions that take long have an argument `progress`: None for this, False for nothing, or a function of one's own. A
training calls it with a `TrainingStatus`, everything else with two numbers: how much is done, and of how much.
"""

import contextlib
import functools
import logging
import sys
import time
from collections.abc import Callable, Iterator
from typing import Any, Literal, ParamSpec, Protocol, TypeVar

from compgs.words import duration, size

LOGGER = logging.getLogger("compgs")
LOG_SECONDS = 15.0  # between two lines of the log
SHOW_SECONDS = 0.1  # between two changes of a line

Given = ParamSpec("Given")
Result = TypeVar("Result")
Counting = Callable[[int, int], None]


class Status(Protocol):
    """What is shown of a training: a `TrainingStatus`."""

    @property
    def step(self) -> int: ...
    @property
    def steps(self) -> int: ...
    @property
    def loss(self) -> float: ...
    @property
    def psnr(self) -> float: ...
    @property
    def primitives(self) -> int: ...
    @property
    def kind(self) -> str: ...
    @property
    def estimated_bytes(self) -> int: ...
    @property
    def seconds_per_step(self) -> float: ...
    @property
    def seconds_left(self) -> float | None: ...
    @property
    def lmbda(self) -> float | None: ...


class Line(Protocol):
    """Where a text stands that changes."""

    overwritten: bool  # by the next text; lines that stay are few

    def show(self, text: str) -> None: ...

    def end(self) -> None: ...


@contextlib.contextmanager
def shown_training(
    progress: Callable[[Any], None] | Literal[False] | None,
) -> Iterator[Callable[[Any], None] | None]:
    """Yields the function that a training calls."""
    if progress is not None:
        yield progress or None
        return
    with _line() as show:
        yield lambda status: show("  ".join(parts_of(status)), status.step == status.steps)


@contextlib.contextmanager
def shown_count(progress: Counting | Literal[False] | None, what: str) -> Iterator[Counting | None]:
    """Yields the function that something calls that can be counted."""
    if progress is not None:
        yield progress or None
        return
    with _line() as show:
        yield lambda done, total: show(f"{what}: {done} of {total}", done == total)


def counted(what: str) -> Callable[[Callable[Given, Result]], Callable[Given, Result]]:
    """Decorate a function that calls its argument `progress`, given by name, with two numbers. They are shown as
    `what`.
    """

    def decorate(function: Callable[Given, Result]) -> Callable[Given, Result]:
        @functools.wraps(function)
        def call(*arguments: Given.args, **named: Given.kwargs) -> Result:
            with shown_count(named.get("progress"), what) as show:  # type: ignore[arg-type]
                named["progress"] = show
                return function(*arguments, **named)

        return call

    return decorate


def parts_of(status: Status) -> list[str]:
    """What there is to say of a training, the most important first."""
    rate = 1 / status.seconds_per_step if status.seconds_per_step > 0 else 0.0
    return [
        f"step {status.step:,} of {status.steps:,}",
        time_left(status),
        f"PSNR {status.psnr:.1f} dB",
        f"~{size(status.estimated_bytes)}",
        f"{status.primitives:,} {status.kind}",
        f"{rate:.1f} steps/s",
        f"loss {status.loss:.4f}",
        *([f"lambda {status.lmbda:.2g}"] if status.lmbda is not None else []),
    ]


def time_left(status: Status) -> str:
    """`4 min 05 s left`."""
    left = status.seconds_left
    seconds = round((status.steps - status.step) * status.seconds_per_step if left is None else left)
    return f"{duration(seconds) if seconds >= 60 else f'{seconds} s'} left"


@contextlib.contextmanager
def _line() -> Iterator[Callable[[str, bool], None]]:
    """Yields `show(text, whether it is the last)`."""
    line, pause = _place()
    begun = last = time.monotonic()
    if line.overwritten:
        last -= pause

    def show(text: str, final: bool) -> None:
        nonlocal last
        now = time.monotonic()
        if now - last >= pause or (final and (line.overwritten or last > begun)):
            line.show(text)
            last = now

    try:
        yield show
    finally:
        line.end()


def _place() -> tuple[Line, float]:
    """Where it is shown, and the seconds between two changes."""
    if _in_notebook():
        return NotebookLine(), SHOW_SECONDS
    if sys.stderr is not None and sys.stderr.isatty():
        return TerminalLine(), SHOW_SECONDS
    return LogLines(), LOG_SECONDS


def _in_notebook() -> bool:
    python = sys.modules.get("IPython")
    shell = python.get_ipython() if python is not None else None
    return type(shell).__name__ == "ZMQInteractiveShell"


class TerminalLine:
    """One line of a terminal."""

    overwritten = True
    used = False

    def show(self, text: str) -> None:
        self.used = True
        sys.stderr.write(f"\r{text}\x1b[K")
        sys.stderr.flush()

    def end(self) -> None:
        if self.used:
            sys.stderr.write("\n")
            sys.stderr.flush()


class NotebookLine:
    """One line below a notebook's cell."""

    overwritten = True
    handle: Any = None

    def show(self, text: str) -> None:
        from IPython.display import display

        content = {"text/plain": text}
        if self.handle is None:
            self.handle = display(content, raw=True, display_id=True)
        else:
            self.handle.update(content, raw=True)

    def end(self) -> None:
        """It stays."""


class LogLines:
    """Lines of the log."""

    overwritten = False

    def show(self, text: str) -> None:
        LOGGER.info("%s", text)

    def end(self) -> None:
        """Nothing is left to do."""
