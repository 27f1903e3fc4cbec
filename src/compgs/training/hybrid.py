"""Training of the hybrid method, from a scene to a model: what `compgs.train` does."""

from collections.abc import Callable
from pathlib import Path

import torch

from compgs.config import Config
from compgs.scene import as_scene
from compgs.scene.views import Scene
from compgs.trained_model import TrainedModel
from compgs.training.run.model_checkpoint import METHOD
from compgs.training.run.profile import StepProfile
from compgs.training.run.run import Run, chosen_config
from compgs.training.run.status import TrainingStatus
from compgs.training.trainer import Trainer


def train(
    scene: Scene | str | Path,
    config: Config | None = None,
    *,
    preset: str | None = None,
    output: str | Path | None = None,
    resume: bool = False,
    progress: Callable[[TrainingStatus], None] | None = None,
    device: str | torch.device | None = None,
    profile: StepProfile | None = None,
) -> TrainedModel:
    """Train a scene, or the one in a folder; the result is ready for `compgs.encode`.

    Settings are those of `config`, or of a preset, `default` if there is neither. With `output`, a folder, checkpoints
    are written there, also when the run is interrupted; `resume` continues from the last one exactly as if the run had
    not stopped. `compgs train --resume` cannot continue such a run, as the folder does not say how the scene was read.
    `profile` gathers where the time goes. Default device: CUDA where there is one.

    Raises ConfigError, CheckpointError, OutputError, and TrainingError when the optimization cannot go on.
    """
    config = chosen_config(config, preset)
    run = Run(METHOD, output=output, resume=resume, on_progress=progress, device=device, profile=profile)
    return train_hybrid(as_scene(scene), config, run)


def train_hybrid(scene: Scene, config: Config, run: Run) -> TrainedModel:
    """Train a scene, as `train` does. Raises as it does."""
    if run.earlier:
        trainer = Trainer.resumed(scene, run.earlier, config, run.device)
    else:
        trainer = Trainer(scene, config, run.device, planned=run.plan)
    trainer.carry_out(run)
    return trainer.model
