"""What training is, whatever is trained: views in turn, steps to the end, progress, checkpoints, a stop at any time."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from compgs.config import TrainingConfig
from compgs.errors import ConfigError, TrainingError
from compgs.losses import Target
from compgs.scene.views import View
from compgs.training.allocation import freed_memory_kept
from compgs.training.checkpoint import CHECKPOINT_NAME
from compgs.training.interrupt import held_back

REPORT_EVERY = 10  # steps between two status reports
ESTIMATE_EVERY = 100  # steps between two estimates of the file's size: it may look at every primitive


@dataclass(frozen=True)
class TrainingStatus:
    """What a progress display shows."""

    step: int
    steps: int
    loss: float
    psnr: float  # dB, of the last training view
    primitives: int
    kind: str  # of primitives: "anchors", "splats"
    estimated_bytes: int
    seconds_per_step: float
    lmbda: (
        float | None
    )  # weight of the rate, which follows the size where one is asked for; None: there is no rate


@dataclass(frozen=True)
class StepResult:
    loss: Tensor  # []; a number only when somebody reads it: a GPU is not waited for
    image: Tensor  # [H, W, 3]
    view: View


class Trains(Protocol):
    """State of a run, at a step."""

    step: int

    @property
    def primitives(self) -> int: ...

    @property
    def kind(self) -> str: ...

    @property
    def lmbda(self) -> float | None: ...

    def train_step(self) -> StepResult: ...

    def estimated_bytes(self) -> int: ...

    def finish(self) -> None: ...

    def save(self, path: Path) -> None: ...


def chosen_device(device: str | torch.device | None) -> torch.device:
    """The given one, else CUDA where there is one."""
    return torch.device(device or ("cuda" if torch.cuda.is_available() else "cpu"))


def checkpoint_path(output: str | Path | None, *, resume: bool) -> Path | None:
    """In the run's folder, if there is one. Raises ConfigError if there is none to resume from."""
    if output is None and resume:
        raise ConfigError("resume needs an output folder: the one of the run to continue")
    return None if output is None else Path(output) / CHECKPOINT_NAME


def kept_target(
    targets: dict[int, Target], view_index: int, views: Sequence[View], device: torch.device
) -> Target:
    """The photograph of a view; each goes to the device once and stays there."""
    if view_index not in targets:
        targets[view_index] = Target.from_image(views[view_index].image, device)
    return targets[view_index]


def next_view(order: list[int], views: int, shuffle: np.random.Generator) -> int:
    """Every view once in random order, then again. `order`: the views to come in this round, taken from its end."""
    if not order:
        order.extend(int(i) for i in shuffle.permutation(views))
    return order.pop()


def diverged(step: int, what: str, value: float) -> TrainingError:
    """For a value that is not finite any more."""
    return TrainingError(f"step {step}: the {what} is {value}; try a lower learning rate or another seed")


@freed_memory_kept()
def run_to_end(
    trainer: Trains,
    config: TrainingConfig,
    path: Path | None,
    on_progress: Callable[[TrainingStatus], None] | None,
) -> None:
    """All remaining steps; a checkpoint at `path` every few minutes, at the end, and when interrupted."""
    saved = reported = time.perf_counter()
    estimate, pace, counted = 0, 0.0, trainer.step
    try:
        while trainer.step < config.steps:
            with held_back():
                result = trainer.train_step()
            now = time.perf_counter()
            told = trainer.step % REPORT_EVERY == 0 or trainer.step == config.steps
            # Before anything is computed from what has diverged.
            if told and not torch.isfinite(result.loss):
                raise diverged(trainer.step, "loss", float(result.loss))
            if on_progress and told:
                if trainer.step % ESTIMATE_EVERY == 0 or not estimate:
                    estimate = trainer.estimated_bytes()
                recent = (now - reported) / (trainer.step - counted)
                # Smoothed, but not for long: the first steps compile kernels and say nothing of the rest.
                pace = recent if not pace or recent < 0.5 * pace else 0.9 * pace + 0.1 * recent
                reported, counted = now, trainer.step
                on_progress(_status(trainer, config.steps, result, estimate, pace))
            if path and now - saved > 60 * config.checkpoint_minutes:
                trainer.save(path)
                saved = now
        trainer.finish()
    except KeyboardInterrupt:
        if path:
            trainer.save(path)
        raise
    if path:
        trainer.save(path)


def _status(trainer: Trains, steps: int, result: StepResult, estimate: int, pace: float) -> TrainingStatus:
    photograph = result.image.new_tensor(result.view.image) / 255.0
    error = float(((result.image.clamp(0, 1) - photograph) ** 2).mean())
    psnr = -10.0 * float(np.log10(max(error, 1e-10)))
    return TrainingStatus(
        step=trainer.step,
        steps=steps,
        loss=float(result.loss),
        psnr=psnr,
        primitives=trainer.primitives,
        kind=trainer.kind,
        estimated_bytes=estimate,
        seconds_per_step=pace,
        lmbda=trainer.lmbda,
    )
