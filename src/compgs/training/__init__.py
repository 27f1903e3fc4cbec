"""Training: the loop, adaptive control, optimizer, checkpoints (CompGS Sec. 3.4); plain 3DGS to compare with."""

from compgs.training.history import History
from compgs.training.loop import TrainingStatus
from compgs.training.profile import StepProfile
from compgs.training.run import load_run
from compgs.training.splat_trainer import SplatTrainer, train_splats
from compgs.training.trainer import Trainer, train

__all__ = [
    "History",
    "SplatTrainer",
    "StepProfile",
    "Trainer",
    "TrainingStatus",
    "load_run",
    "train",
    "train_splats",
]
