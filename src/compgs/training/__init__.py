"""Training: the loop, adaptive control, optimizer, checkpoints (CompGS Sec. 3.4); plain 3DGS to compare with."""

from compgs.training.history import History
from compgs.training.hooks import Drawn, Hooks
from compgs.training.loop import Run, TrainingStatus
from compgs.training.phases import Phase, fine_tuning, train_phases
from compgs.training.profile import StepProfile
from compgs.training.run import load_run
from compgs.training.splat_trainer import SplatTrainer, train_splats
from compgs.training.trainer import Trainer, train, train_hybrid

__all__ = [
    "Drawn",
    "History",
    "Hooks",
    "Phase",
    "Run",
    "SplatTrainer",
    "StepProfile",
    "Trainer",
    "TrainingStatus",
    "fine_tuning",
    "load_run",
    "train",
    "train_hybrid",
    "train_phases",
    "train_splats",
]
