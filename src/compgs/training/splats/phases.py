"""Plain 3DGS and what follows it, one phase after the other, as one run: fine-tuning after pruning or quantization.

A checkpoint says in which phase it was written. A phase begins with the splats that the one before it ended with.
"""

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import torch

from compgs.config import Config
from compgs.model.splats import SplatModel
from compgs.scene import as_scene
from compgs.scene.views import Scene
from compgs.training.run.checkpoint import read_checkpoint_file
from compgs.training.run.profile import StepProfile
from compgs.training.run.restoring import restoring
from compgs.training.run.run import Run, chosen_config
from compgs.training.run.status import TrainingStatus
from compgs.training.splats.hooks import Hooks
from compgs.training.splats.trainer import METHOD, SplatTrainer


@dataclass(frozen=True)
class Phase:
    """Steps of a run that have the same settings and hooks."""

    config: Config
    hooks: Callable[[], Hooks] = field(default=Hooks)


def fine_tuning(config: Config, steps: int) -> Config:
    """Settings of a phase in which trained splats settle: no growth, all harmonics, positions at their last rate."""
    last = config.splats.position_lr[1]
    return replace(
        config,
        training=replace(config.training, steps=steps),
        splats=replace(config.splats, densify_stop=0.0, harmonics_every=0.0, position_lr=(last, last)),
    )


def train_splats(
    scene: Scene | str | Path,
    config: Config | None = None,
    *,
    preset: str | None = None,
    output: str | Path | None = None,
    resume: bool = False,
    progress: Callable[[TrainingStatus], None] | None = None,
    device: str | torch.device | None = None,
    profile: StepProfile | None = None,
) -> SplatModel:
    """Train plain 3DGS on a scene; the result is ready for `compgs.formats.write_ply`. Arguments as of `train`.

    Of the settings, `splats` applies, and of `training` the steps, the seed, the loss and the checkpoints.

    Raises ConfigError, CheckpointError, OutputError, and TrainingError when the optimization cannot go on.
    """
    config = chosen_config(config, preset)
    run = Run(METHOD, output=output, resume=resume, on_progress=progress, device=device, profile=profile)
    return train_phases(as_scene(scene), (Phase(config),), run).model()


def train_phases(
    scene: Scene, phases: Sequence[Phase], run: Run, start: SplatModel | None = None
) -> SplatTrainer:
    """The state after the last phase. `start`: trained splats in place of what the first phase would give.

    Raises CheckpointError, OutputError, and TrainingError when the optimization cannot go on.
    """
    total = sum(phase.config.training.steps for phase in phases)
    number = _phase_of(run, len(phases))
    trainer = None
    for index in range(number, len(phases)):
        phase = phases[index]
        if index == number and run.earlier:
            trainer = SplatTrainer.resumed(
                scene, run.earlier, phase.config, run.device, phase.hooks(), phase=index, method=run.method
            )
        else:
            trainer = SplatTrainer(
                scene,
                phase.config,
                run.device,
                start if trainer is None else trainer.model(),
                phase.hooks(),
                phase=index,
                method=run.method,
            )
            if index == 0 and start is not None:
                trainer.step = phase.config.training.steps
            else:
                trainer.begin()
        before = sum(phase.config.training.steps for phase in phases[:index])
        trainer.carry_out(run, _of_whole(run.on_progress, before, total))
    assert trainer is not None
    return trainer


def _phase_of(run: Run, phases: int) -> int:
    """Return the phase in which the run to be continued was; 0 for a new one."""
    if run.earlier is None:
        return 0
    _, metadata = read_checkpoint_file(run.earlier, run.method)
    with restoring(run.earlier):
        phase = json.loads(metadata["state"]).get("phase", 0)
        if phase not in range(phases):
            raise ValueError(f"phase {phase!r} of {phases}")
        return int(phase)


def _of_whole(
    show: Callable[[TrainingStatus], None] | None, before: int, total: int
) -> Callable[[TrainingStatus], None] | None:
    """Progress of a phase as one of the whole run."""
    if show is None:
        return None

    def show_whole(status: TrainingStatus) -> None:
        # Later phases at the present pace.
        later = (total - before - status.steps) * status.seconds_per_step
        left = None if status.seconds_left is None else status.seconds_left + later
        show(replace(status, step=before + status.step, steps=total, seconds_left=left))

    return show_whole
