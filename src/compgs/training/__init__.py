"""Training: what a run decides, does and remembers (CompGS Sec. 3.4); plain 3DGS, to compare with.

| where | what |
|---|---|
| `plan` | every decision that depends on lambda, bytes, views or passes, in one table |
| `start` | the model that a plan begins with |
| `trainer` | the loop of the hybrid method: one step, and what is due between steps |
| `step/` | what happens in a step |
| `shortcuts/` | what saves time in a step |
| `structure/` | what changes the model between steps: growth, pruning, axes, averages |
| `survey` | what the training views see of the model |
| `rate/` | the size of the file, and lambda |
| `optimizers` | Adam's groups, learning rates, and rows that come and go |
| `run/` | carrying a run out: loop, checkpoints, processes, profile |
| `splats/` | plain 3DGS, and the methods that build on it |
"""

from compgs.training.plan import Plan
from compgs.training.run.finished import load_run
from compgs.training.run.history import History
from compgs.training.run.loop import Run, TrainingStatus
from compgs.training.run.profile import StepProfile
from compgs.training.splats.hooks import Drawn, Hooks
from compgs.training.splats.phases import Phase, fine_tuning, train_phases
from compgs.training.splats.trainer import SplatTrainer, train_splats
from compgs.training.start import plan_for
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
