"""Training: the loop, adaptive control, optimizer, checkpoints (CompGS Sec. 3.4); plain 3DGS to compare with."""

from compgs.training.history import History
from compgs.training.hooks import Drawn, Hooks
from compgs.training.initial import plan_for
from compgs.training.loop import Run, TrainingStatus
from compgs.training.phases import Phase, fine_tuning, train_phases
from compgs.training.plan import Plan
from compgs.training.profile import StepProfile
from compgs.training.run import load_run
from compgs.training.splat_trainer import SplatTrainer, train_splats
from compgs.training.trainer import Trainer, train, train_hybrid

__all__ = [
    "Drawn",
    "History",
    "Hooks",
    "Phase",
    "Plan",
    "Run",
    "SplatTrainer",
    "StepProfile",
    "Trainer",
    "TrainingStatus",
    "fine_tuning",
    "load_run",
    "plan_for",
    "train",
    "train_hybrid",
    "train_phases",
    "train_splats",
]
