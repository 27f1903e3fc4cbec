"""What training is, whatever is trained: steps to the end, progress, checkpoints, a stop at any time."""

from collections.abc import Callable
from pathlib import Path

import torch

from compgs.config import TrainingConfig
from compgs.interrupt import held_back
from compgs.numerics.freed_memory import freed_memory_kept
from compgs.training.run.any_trainer import AnyTrainer, Watch
from compgs.training.run.distributed import rank, stopping_together, world
from compgs.training.run.divergence import diverged
from compgs.training.run.pace import Pace
from compgs.training.run.saving import Saving
from compgs.training.run.shown_size import ShownSize
from compgs.training.run.status import StepResult, TrainingStatus, training_psnr
from compgs.training.run.time_left import TimeLeft


@freed_memory_kept()
def run_to_end(
    trainer: AnyTrainer,
    config: TrainingConfig,
    path: Path | None,
    on_progress: Callable[[TrainingStatus], None] | None,
    watch: Watch | None = None,
) -> None:
    """All remaining steps; checkpoints at `path` as `Saving` says. Progress is reported now and then, and right after
    each checkpoint. What `watch` does takes its time, and changes nothing. Of several ranks rank 0 alone writes
    and reports."""
    if rank() > 0:
        path, on_progress, watch = None, None, None
    saving, pace, size = Saving(trainer, path), Pace(), ShownSize(trainer.estimated_bytes)
    left = TimeLeft(trainer, config.steps, -(-config.views_per_step // world()))
    try:
        while trainer.step < config.steps:
            with stopping_together():
                with held_back():
                    result = trainer.train_step()
                pace.step()
                told = trainer.step % 10 == 0 or trainer.step == config.steps or saving.ended()
                saves = saving.due()
                # Before anything is computed from what has diverged.
                if (told or saves) and not torch.isfinite(result.loss):
                    raise diverged(trainer.step, "loss", float(result.loss))
                if saves:
                    pace.pause(saving.begin())
                if on_progress and told:
                    seconds = pace.look(left.size)
                    pace.pause(left.look(seconds))
                    pace.pause(size.look(last=trainer.step == config.steps))
                    on_progress(_status(trainer, config.steps, result, size.bytes, seconds, left))
                if watch:
                    watch(trainer)
        with stopping_together():
            trainer.finish()
    except KeyboardInterrupt:
        saving.stopped()
        raise
    saving.last()


def _status(
    trainer: AnyTrainer, steps: int, result: StepResult, estimate: int, pace: float, left: TimeLeft
) -> TrainingStatus:
    return TrainingStatus(
        step=trainer.step,
        steps=steps,
        loss=float(result.loss),
        psnr=training_psnr(result),
        primitives=trainer.primitives,
        kind=trainer.kind,
        estimated_bytes=estimate,
        seconds_per_step=pace,
        lmbda=trainer.lmbda,
        seconds_left=left.seconds(),
        seconds_by_divisor=left.by_divisor(),
    )
