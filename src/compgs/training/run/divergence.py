"""What is said of a run whose numbers are not finite any more."""

from compgs.errors import TrainingError


def diverged(step: int, what: str, value: float) -> TrainingError:
    """The error to raise for a value that is not finite any more."""
    return TrainingError(
        f"step {step}: the {what} is {value}; try another seed (--seed), or smaller learning rates "
        "(settings that end in _lr)"
    )
