"""How many steps fit into a time: a few are tried, on the scene as it is, and thrown away."""

import contextlib
import time
from dataclasses import dataclass, replace
from statistics import fmean

from compgs.compressing.deadline import FEWEST
from compgs.config import Config
from compgs.methods import train
from compgs.scene.views import Scene
from compgs.training import Plan, TrainingStatus, plan_for
from compgs.training.run.run import chosen_device

TRIED = 40  # steps; fewer where these alone would take much of the time
LEAST_TRIED = 10  # steps
TRIED_PART = 0.1  # of the time
TRIED_VIEWS = 12
# A step of the whole run, in steps of its beginning: anchors grow, then most of them are pruned, and the rate is always
# counted in (measured: docs/results/compress.md).
WHOLE_RUN = 1.0
# Anchors of a run that looks for points, in those of one that does not (Truck: docs/results/truck.md). Most of a step's
# time is for prediction, which takes as many times as long.
WITH_POINTS = 2.0


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
    pace = WHOLE_RUN * seconds_per_step(scene, config, device, plan, seconds)
    left = seconds - (time.perf_counter() - start)
    steps = max(FEWEST, int(left / pace))
    return Fitting(steps, max(0.0, steps * pace - left))


class _Enough(Exception):
    """The trial has taken its part of the time."""


def seconds_per_step(
    scene: Scene, config: Config, device: str | None, plan: Plan, seconds: float = float("inf")
) -> float:
    """Seconds of a step with everything in it, as long as the steps of a run are on average: the first ones look at
    coarse photographs, as in a whole run. The very first, which loads and compiles kernels, does not count.

    The plan is the whole scene's: the few views that are tried would make another one. No points are looked for, which
    takes minutes; a step of the run takes longer by the anchors that come with them. Of `seconds` the trial takes no
    more than a part.
    """
    end = time.monotonic() + TRIED_PART * seconds
    anchors = WITH_POINTS if plan.dense_points > 0 else 1.0
    plan = replace(plan, dense_points=0.0)
    views = scene.train_views[:: max(1, len(scene.train_views) // TRIED_VIEWS)]
    told: list[TrainingStatus] = []

    def tell(status: TrainingStatus) -> None:
        told.append(status)
        if status.step >= LEAST_TRIED and time.monotonic() > end:
            raise _Enough

    with contextlib.suppress(_Enough):
        train(replace(scene, train_views=views), trial(config), device=device, progress=tell, plan=plan)
    return anchors * fmean(status.seconds_per_step for status in told)


def trial(config: Config) -> Config:
    """The first steps of a run with nothing in them that is not in every step, but with the rate."""
    phases = config.training.borders._replace(rate=0.0, weights=0.0)
    return replace(
        config,
        training=replace(config.training, steps=TRIED, phases=phases, target_bytes=None),
        control=replace(config.control, start=1.0, stop=0.0, prune_at=()),
        entropy=replace(config.entropy, decorrelate_at=()),
    )
