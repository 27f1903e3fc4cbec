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

from compgs.cli.console import console, duration, say, size

if TYPE_CHECKING:
    from compgs.training import TrainingStatus

LINE_SECONDS = 15.0  # between two plain lines


@contextmanager
def counting(what: str) -> Iterator[Callable[[int, int], None]]:
    """Yields `progress(done, total)`, for things that can be counted."""
    if not console.is_terminal:
        yield _counting_lines(what)
        return
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, transient=True) as bars:
        task = bars.add_task(what, total=None)
        yield lambda done, total: bars.update(task, completed=done, total=total)


@contextmanager
def training() -> Iterator[Callable[["TrainingStatus"], None]]:
    """Yields `on_progress(status)`: rate, loss, quality, primitives, estimated size and time left."""
    if not console.is_terminal:
        yield _training_lines()
        return
    columns = (
        TextColumn("training"),
        BarColumn(bar_width=24),
        MofNCompleteColumn(),
        TextColumn("{task.description}"),
        TimeElapsedColumn(),
        TextColumn("{task.fields[left]}"),
    )
    with Progress(*columns, console=console) as bars:
        task = bars.add_task(
            "the first steps take longer: kernels are loaded or compiled", total=None, left=""
        )

        def show(status: "TrainingStatus") -> None:
            bars.update(
                task,
                completed=status.step,
                total=status.steps,
                description=describe(status),
                left=time_left(status),
            )

        yield show


def describe(status: "TrainingStatus") -> str:
    """`12.3 steps/s  loss 0.0512  PSNR 27.9 dB  4,211 anchors  ~181.0 kB  lambda 0.001`."""
    rate = 1 / status.seconds_per_step if status.seconds_per_step > 0 else 0.0
    rate_weight = f"  lambda {status.lmbda:.2g}" if status.lmbda is not None else ""
    return (
        f"{rate:.1f} steps/s  loss {status.loss:.4f}  PSNR {status.psnr:.1f} dB  {status.primitives:,} {status.kind}  "
        f"~{size(status.estimated_bytes)}{rate_weight}"
    )


def time_left(status: "TrainingStatus") -> str:
    """`4 min 05 s left`."""
    seconds = round((status.steps - status.step) * status.seconds_per_step)
    return f"{duration(seconds) if seconds >= 60 else f'{seconds} s'} left"


def _counting_lines(what: str) -> Callable[[int, int], None]:
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
            say(f"training: step {status.step} of {status.steps}  {describe(status)}  {time_left(status)}")
            last = now

    return show
