"""Training: the loop, adaptive control, optimizer, checkpoints (CompGS Sec. 3.4)."""

from compgs.training.profile import StepProfile
from compgs.training.run import load_run
from compgs.training.trainer import Trainer, TrainingStatus, train

__all__ = ["StepProfile", "Trainer", "TrainingStatus", "load_run", "train"]
