"""How far something long is, where there is no terminal: lines of the log, which a command says."""

import logging

import pytest

from compgs.cli.notes import notes_shown
from compgs.notes import note
from compgs.progress import LOG_SECONDS, shown_count


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """A list whose only number is the time."""
    now = [1000.0]
    monkeypatch.setattr("compgs.progress.time.monotonic", lambda: now[0])
    return now


def count(clock: list[float], seconds: float) -> None:
    """Count to three, each step of which takes so long."""
    with shown_count(None, "looking for points, photographs") as show:
        assert show is not None
        for done in range(4):
            show(done, 3)
            clock[0] += seconds


def test_what_takes_long_is_logged_now_and_then_and_at_its_end(
    clock: list[float], caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO, "compgs")
    count(clock, 0.6 * LOG_SECONDS)
    assert caplog.messages == [f"looking for points, photographs: {done} of 3" for done in (2, 3)]


def test_what_takes_a_moment_is_not_logged(clock: list[float], caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO, "compgs")
    count(clock, 0.1 * LOG_SECONDS)
    assert not caplog.messages


def test_a_command_says_it_as_it_is_and_notes_once(
    clock: list[float], capsys: pytest.CaptureFixture[str], tmp_path
) -> None:
    with notes_shown():
        count(clock, LOG_SECONDS)
        note(tmp_path, "two of three")
        note(tmp_path, "two of three")
    count(clock, LOG_SECONDS)  # nobody listens any more
    said = capsys.readouterr().out.splitlines()
    assert said[:3] == [f"looking for points, photographs: {done} of 3" for done in (1, 2, 3)]
    assert said[3].startswith("note: ") and len(said) == 4
