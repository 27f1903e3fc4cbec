"""Where a step's time goes, by a clock that the test moves."""

from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import pytest

from compgs.training.run.profile import StepProfile


class Steps:
    """A trainer whose methods take the seconds that they say; `prune` looks at a view as a step does."""

    def __init__(self) -> None:
        self.now = 0.0

    def wait(self, seconds: float) -> None:
        self.now += seconds

    def look(self) -> None:
        self.wait(1.0)

    def prune(self) -> None:
        self.wait(10.0)
        self.look()
        self.wait(100.0)

    def backward(self) -> None:
        self.wait(1_000.0)

    def train_step(self) -> Any:
        self.look()
        self.backward()
        self.prune()
        return SimpleNamespace()


PARTS = {"look": "culling", "prune": "control"}


def none() -> Iterator[tuple[str, tuple[()]]]:
    yield from ()


def test_a_part_has_all_that_it_calls_also_what_is_another_part_elsewhere() -> None:
    steps = Steps()
    profile = StepProfile(warm_up=0, clock=lambda: steps.now)
    profile.watch(steps, PARTS, none)
    steps.train_step()
    steps.train_step()
    # What is between two parts is the latter's.
    assert profile.milliseconds() == {"culling": 1e3, "control": 1_111e3}


def test_steps_to_warm_up_are_not_counted() -> None:
    steps = Steps()
    profile = StepProfile(warm_up=1, clock=lambda: steps.now)
    profile.watch(steps, PARTS, none)
    steps.train_step()
    assert profile.steps == 0 and not profile.seconds
    steps.train_step()
    assert profile.steps == 1 and profile.seconds["culling"] == 1.0


def test_a_part_that_fails_leaves_the_profile_as_it_was() -> None:
    steps = Steps()
    profile = StepProfile(warm_up=0, clock=lambda: steps.now)
    profile.watch(steps, PARTS | {"wait": "waiting"}, none)
    for _ in range(2):
        with pytest.raises(TypeError):
            steps.wait("never")  # type: ignore[arg-type]
    steps.train_step()
    assert profile.milliseconds()["culling"] == 1e3
