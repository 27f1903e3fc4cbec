"""How many steps fit into a time: a few are tried, on the scene as it is, and thrown away."""

import contextlib
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from statistics import fmean

from compgs.compressing.deadline import FEWEST
from compgs.config import Config
from compgs.methods import train
from compgs.scene.views import Scene
from compgs.training import Plan, TrainingStatus, plan_for
from compgs.training.run.run import chosen_device

TRIED = 60  # steps; fewer where these alone would take much of the time
LEAST_TRIED = 10  # steps
TRIED_PART = 0.1  # of the time
# Fewer than the first steps, which do not count: a view is slow when it is looked at for the first time, as nothing is
# known of what hides there.
TRIED_VIEWS = 8
# What a run's steps take longer for each time as many points as the trial's anchors that are found before it: most are
# pruned again in the first half of the run (docs/results/truck.md#what-a-plan-says-beforehand).
FOR_POINTS = 0.18


@dataclass(frozen=True)
class Fitting:
    """The steps that fit into a time, FEWEST at least."""

    steps: int
    late: float = 0.0  # seconds after the time, in which the fewest steps end where they do not fit


def steps_within(
    scene: Scene, config: Config, seconds: float, device: str | None, *, points_at_hand: bool = False
) -> Fitting:
    """Steps of a training that ends about `seconds` from now. `points_at_hand`: none are looked for before it."""
    start = time.perf_counter()
    plan = plan_for(scene, config, chosen_device(device), points_at_hand=points_at_hand)
    pace = seconds_per_step(scene, config, device, plan, seconds)
    left = seconds - (time.perf_counter() - start)
    steps = max(FEWEST, int(left / pace))
    return Fitting(steps, max(0.0, steps * pace - left))


class _Enough(Exception):
    """The trial has taken its part of the time."""


def seconds_per_step(
    scene: Scene, config: Config, device: str | None, plan: Plan, seconds: float = float("inf")
) -> float:
    """Seconds of a step with everything in it, as long as the steps of a run are on average: a part of them looks at
    coarse photographs. The first ones, in which kernels are loaded and views are new, do not count.

    The plan is the whole scene's: the few views that are tried would make another one. No points are looked for, which
    takes minutes; a step of the run takes longer by the anchors that would come with them. Of `seconds` the trial takes
    no more than a part.
    """
    end = time.monotonic() + TRIED_PART * seconds
    found = plan.start.findable if plan.dense_points > 0 else 0
    longer = 1.0 + FOR_POINTS * found / plan.start.anchors
    plan = replace(plan, dense_points=0.0)
    views = scene.train_views[:: max(1, len(scene.train_views) // TRIED_VIEWS)]
    told: list[tuple[TrainingStatus, float]] = []  # and when

    def tell(status: TrainingStatus) -> None:
        told.append((status, time.monotonic()))
        if status.step >= LEAST_TRIED and time.monotonic() > end:
            raise _Enough

    with contextlib.suppress(_Enough):
        train(replace(scene, train_views=views), trial(config), device=device, progress=tell, plan=plan)
    pace = mean_pace([(status.step, now) for status, now in told], plan.coarse_until, TRIED)
    return longer * (told[0][0].seconds_per_step if pace is None else pace)


def mean_pace(told: Sequence[tuple[int, float]], coarse_until: float, steps: int) -> float | None:
    """Seconds of a step of a run, by when some of a trial's `steps` were done: (step, seconds on a clock), ascending.
    Both look at coarse photographs until the same share of their steps. None if fewer than two were told.
    """
    coarse, whole = [], []
    for (before, since), (step, now) in pairwise(told):
        pace = (now - since) / (step - before)
        if step <= coarse_until * steps:
            coarse.append(pace)
        elif before >= coarse_until * steps:
            whole.append(pace)
    if not coarse or not whole:  # a trial that was cut short, or steps of one kind
        return fmean(coarse or whole) if coarse or whole else None
    return coarse_until * fmean(coarse) + (1.0 - coarse_until) * fmean(whole)


def trial(config: Config) -> Config:
    """The first steps of a run with nothing in them that is not in every step, but with the rate."""
    phases = config.training.borders._replace(rate=0.0, weights=0.0)
    return replace(
        config,
        training=replace(config.training, steps=TRIED, phases=phases, target_bytes=None),
        control=replace(config.control, start=1.0, stop=0.0, prune_at=()),
        entropy=replace(config.entropy, decorrelate_at=()),
    )
