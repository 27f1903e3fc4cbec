"""Progress: bars on a terminal, a plain line now and then elsewhere."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from compgs.cli.console import console, say
from compgs.progress import parts_of

if TYPE_CHECKING:
    from compgs.training import TrainingStatus

WORTH_SAYING = 600.0  # seconds of a training on large photographs
LINE_SECONDS = 15.0  # between two plain lines
BAR_WIDTH = 12  # columns of the bar beside the words of a training


@contextmanager
def counting(what: str) -> Iterator[Callable[[int, int], None]]:
    """Yields `progress(done, total)`, for things that can be counted."""
    if not console.is_terminal:
        yield counting_lines(what)
        return
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, transient=True) as bars:
        task = bars.add_task(what, total=None)
        yield lambda done, total: bars.update(task, completed=done, total=total)


@contextmanager
def counting_runs(runs: str) -> Iterator[Callable[[int, int, str], None]]:
    """Yields `progress(done, total, what)`: a bar, or a line for each of the `runs` (a word) that begins."""
    if not console.is_terminal:
        yield lambda done, total, what: say(f"{done} of {total} {runs} done" + (f"; {what}" if what else ""))
        return
    columns = (
        TextColumn(runs),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("{task.description}"),
    )
    with Progress(*columns, console=console) as bars:
        task = bars.add_task("", total=None)
        yield lambda done, total, what: bars.update(task, completed=done, total=total, description=what)


@contextmanager
def training() -> Iterator[Callable[["TrainingStatus"], None]]:
    """Yields `on_progress(status)`: steps, time left, quality, size, and as much else as there is room for."""
    if not console.is_terminal:
        yield _training_lines()
        return
    columns = (TextColumn("{task.description}"), BarColumn(bar_width=BAR_WIDTH))
    with Progress(*columns, console=console) as bars:
        task = bars.add_task("training: the first step", total=None)

        def show(status: "TrainingStatus") -> None:
            room = console.width - BAR_WIDTH - 1
            bars.update(task, completed=status.step, total=status.steps, description=fitting(status, room))

        yield show


class SizesSaid:
    """Says once what a training on large photographs takes, and what it would take on smaller ones."""

    def __init__(self) -> None:
        self.said = False

    def __call__(self, status: "TrainingStatus", pixels: int, downscale: int) -> None:
        """`pixels` of a photograph as it is read, at 1 / `downscale` of its size."""
        seconds = status.seconds_by_divisor
        if self.said or not seconds:
            return
        self.said = True
        if seconds[1] < WORTH_SAYING:
            return
        others = ", ".join(
            f"-r {divisor * downscale} {about(each)}" for divisor, each in seconds.items() if divisor > 1
        )
        say(f"photographs of {pixels / 1e6:.1f} megapixels take {about(seconds[1])} here; with {others}")


def about(seconds: float) -> str:
    """`about 5 min`, `about 3 h 20 min`."""
    minutes = max(1, round(seconds / 60))
    if minutes < 60:
        return f"about {minutes} min"
    return (
        f"about {minutes // 60} h {minutes % 60 // 10 * 10} min"
        if minutes % 60 >= 10
        else f"about {minutes // 60} h"
    )


def fitting(status: "TrainingStatus", room: int) -> str:
    """The first parts, as many as fit into the columns of the terminal."""
    shown, *others = parts_of(status)
    for part in others:
        if len(shown) + 2 + len(part) > room:
            break
        shown += f"  {part}"
    return shown


def counting_lines(what: str) -> Callable[[int, int], None]:
    last = time.monotonic()

    def show(done: int, total: int) -> None:
        nonlocal last
        now = time.monotonic()
        if done == total or now - last >= LINE_SECONDS:
            say(f"{what}: {done} of {total}")
            last = now

    return show


def _training_lines() -> Callable[["TrainingStatus"], None]:
    last = -LINE_SECONDS

    def show(status: "TrainingStatus") -> None:
        nonlocal last
        now = time.monotonic()
        if status.step == status.steps or now - last >= LINE_SECONDS:
            say(f"training: {'  '.join(parts_of(status))}")
            last = now

    return show
