"""When in the run a step comes, and what it does therefore."""

from dataclasses import dataclass

from compgs.config import TrainingConfig
from compgs.training.plan import Plan
from compgs.training.shortcuts.rare_rate import times_counted


@dataclass(frozen=True)
class Moment:
    """What the phases of a run ask of one step."""

    progress: float  # share of the run that is done, 0 to 1
    lmbda: float  # weight of the rate
    rate_weight: (
        int  # steps that the rate of this one stands for: it is in the loss so many times; 0: not at all
    )
    passes_over: bool  # anchors that were hidden may be passed over
    hard: bool  # the likelihood sees symbols in place of noise
    stored: bool  # the networks compute with weights rounded as the file will hold them
    watched: bool  # control of density looks at this step


def moment(step: int, lmbda: float, training: TrainingConfig, plan: Plan, *, watched: bool) -> Moment:
    """Find what is due in a step. Once the rate has joined the loss, steps without it pass over hidden anchors."""
    progress, counted = step / training.steps, times_counted(step, plan.rate_every)
    borders = training.borders
    joined = progress >= borders.rate
    return Moment(
        progress=progress,
        lmbda=lmbda,
        rate_weight=counted if joined else 0,
        passes_over=joined and not counted,
        hard=progress >= borders.symbols,
        stored=progress >= borders.weights,
        watched=watched,
    )
