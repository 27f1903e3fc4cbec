"""What people read."""

import io
import sys
from dataclasses import dataclass

import pytest

from compgs.cli import console, progress
from compgs.codec.reader import RangeInfo


def test_components_are_shown_with_their_sum(capsys: pytest.CaptureFixture[str]) -> None:
    console.print_components({"positions": 300, "reference embeddings": 700}, anchors=100, coupled=800)
    lines = capsys.readouterr().out.splitlines()
    assert lines[1].split() == ["positions", "300", "30.0", "%", "24.00", "3.00"]
    assert lines[3].split() == ["total", "1,000", "100.0", "%", "80.00", "10.00"]


def test_beginnings_of_a_file_are_shown_with_what_they_hold(capsys: pytest.CaptureFixture[str]) -> None:
    console.print_ranges([RangeInfo(3, 59, 4118, 200), RangeInfo(8, 12_800, 84_019, 60_000)])
    lines = capsys.readouterr().out.splitlines()
    assert lines[1].split() == ["3", "59", "4,118"]
    assert lines[2].split() == ["8", "12,800", "84,019"]


class InterruptedAfterWriting(io.StringIO):
    """A standard output that takes its first line, and then a person presses Ctrl-C before the write returns."""

    interrupted = False

    def write(self, text: str) -> int:
        count = super().write(text)
        if text.endswith("\n") and not self.interrupted:
            self.interrupted = True
            raise KeyboardInterrupt
        return count


def test_an_announced_line_that_an_interrupt_meets_is_not_written_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    out = InterruptedAfterWriting()
    monkeypatch.setattr(sys, "stdout", out)
    with pytest.raises(KeyboardInterrupt):
        console.announce("tiny.cgs: an address")
    console.say("ended")
    assert out.getvalue() == "tiny.cgs: an address\nended\n"


@dataclass(frozen=True)
class Status:
    step: int
    steps: int = 100
    loss: float = 0.05
    psnr: float = 27.94
    primitives: int = 4211
    kind: str = "anchors"
    estimated_bytes: int = 181_000
    seconds_per_step: float = 0.08
    lmbda: float = 0.001
    seconds_left: float | None = None


def test_a_status_says_what_matters_most_first() -> None:
    text = "  ".join(progress.parts_of(Status(10)))  # type: ignore[arg-type]
    assert text == (
        "step 10 of 100  7 s left  PSNR 27.9 dB  ~181.0 kB  4,211 anchors  12.5 steps/s  loss 0.0500  lambda 0.001"
    )


@pytest.mark.parametrize(
    ("room", "text"),
    [
        (5, "step 10 of 100"),
        (23, "step 10 of 100"),
        (24, "step 10 of 100  7 s left"),
        (38, "step 10 of 100  7 s left  PSNR 27.9 dB"),
        (67, "step 10 of 100  7 s left  PSNR 27.9 dB  ~181.0 kB  4,211 anchors"),
    ],
)
def test_a_narrow_terminal_loses_whole_parts_from_the_end(room: int, text: str) -> None:
    assert progress.fitting(Status(10), room) == text  # type: ignore[arg-type]


def test_in_80_columns_a_long_run_still_shows_steps_time_left_quality_and_size() -> None:
    status = Status(12_340, 300_000, psnr=27.94, estimated_bytes=12_340_000)
    shown = progress.fitting(status, 80 - progress.BAR_WIDTH - 1)  # type: ignore[arg-type]
    assert shown == "step 12,340 of 300,000  6 h 23 min left  PSNR 27.9 dB  ~12.34 MB"


def test_without_a_terminal_progress_is_a_few_plain_lines(capsys: pytest.CaptureFixture[str]) -> None:
    with progress.training() as show:
        for step in range(10, 101, 10):
            show(Status(step))  # type: ignore[arg-type]
    with progress.counting("reading views") as count:
        for done in range(1, 6):
            count(done, 5)
    lines = capsys.readouterr().out.splitlines()
    assert [line[:24] for line in lines] == [
        "training: step 10 of 100",
        "training: step 100 of 10",
        "reading views: 5 of 5",
    ]


def test_markup_in_names_is_taken_literally(capsys: pytest.CaptureFixture[str]) -> None:
    console.say("runs/[bold]garden[/bold]")
    assert capsys.readouterr().out == "runs/[bold]garden[/bold]\n"
