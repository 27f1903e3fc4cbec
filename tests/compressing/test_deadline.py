"""A compression keeps to its time when the machine becomes slower: steps are passed over, evenly."""

from dataclasses import dataclass, field

import pytest

from compgs.compressing.compression import rough
from compgs.compressing.deadline import ENOUGH, FEWEST, Deadline
from compgs.training import TrainingStatus


@dataclass
class Machine:
    """A clock and a run on it; steps take `seconds` each."""

    steps: int
    seconds: float
    now: float = 100.0
    step: int = 0
    passed: list[int] = field(default_factory=list)

    def skip_steps(self, steps: int) -> None:
        self.passed.extend(range(self.step, self.step + steps))
        self.step += steps

    def status(self) -> TrainingStatus:
        left = (self.steps - self.step) * self.seconds
        return TrainingStatus(
            self.step, self.steps, 0.0, 0.0, 1, "anchors", 1, self.seconds, None, seconds_left=left
        )


def went(machine: Machine, deadline: Deadline, slower_at: int = -1, by: float = 1.0) -> None:
    while machine.step < machine.steps:
        if machine.step >= slower_at >= 0:
            machine.seconds, slower_at = machine.seconds * by, -1
        machine.now += machine.seconds
        machine.step += 1
        if machine.step % 10 == 0 or machine.passed:
            deadline.tell(machine.status())
        deadline(machine)


@pytest.fixture
def machine(monkeypatch: pytest.MonkeyPatch) -> Machine:
    found = Machine(2000, 0.05)
    monkeypatch.setattr("compgs.compressing.deadline.time.monotonic", lambda: found.now)
    return found


def test_a_run_that_is_in_time_takes_all_its_steps(machine: Machine) -> None:
    deadline = Deadline(machine.now + 101.0, machine.steps)
    went(machine, deadline)
    assert deadline.taken == machine.steps and not machine.passed


@pytest.mark.parametrize("by", [1.5, 3.0, 6.0])
def test_a_machine_that_becomes_slower_does_not_make_it_late(machine: Machine, by: float) -> None:
    end = machine.now + 101.0
    deadline = Deadline(end, machine.steps)
    went(machine, deadline, slower_at=600, by=by)
    assert machine.step == machine.steps
    assert end - 12.0 < machine.now < end + 3.0
    assert deadline.taken + len(machine.passed) == machine.steps
    # What is passed over is spread over the rest of the run.
    middle = sum(600 <= step < 1300 for step in machine.passed)
    assert 0.4 < middle / len(machine.passed) < 0.6
    assert machine.passed[0] >= 600


def test_the_last_step_is_taken_and_some_steps_always_are(machine: Machine) -> None:
    deadline = Deadline(machine.now + 1.0, machine.steps)
    went(machine, deadline)
    assert FEWEST <= deadline.taken < FEWEST + 30
    assert machine.steps - 1 not in machine.passed


def test_few_steps_are_called_rough() -> None:
    assert rough(ENOUGH) == ()
    (said,) = rough(412)
    assert "412 steps are few" in said and "rough" in said
