"""A run's folder after training."""

from pathlib import Path

from compgs.errors import CheckpointError
from compgs.trained_model import TrainedModel
from compgs.training.run.checkpoint import CHECKPOINT_NAME
from compgs.training.run.model_checkpoint import load_checkpoint


def load_run(folder: str | Path) -> TrainedModel:
    """The model of a finished run. Raises CheckpointError if there is none, or the run has not finished."""
    path = Path(folder) / CHECKPOINT_NAME
    checkpoint = load_checkpoint(path)
    step, steps = checkpoint.state["step"], checkpoint.saved.config.training.steps
    if step < steps:
        raise CheckpointError(
            f"{path}: the run stopped at step {step} of {steps}; continue it with resume=True"
        )
    return checkpoint.model
