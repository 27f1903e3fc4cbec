"""Training: what a run decides, does and remembers (CompGS Sec. 3.4); plain 3DGS, to compare with.

| where | what |
|---|---|
| `plan` | every decision that depends on lambda, bytes, views or passes, in one table |
| `start` | the model that a plan begins with |
| `trainer` | the hybrid method: a loop that one reads aloud |
| `hybrid` | from a scene to its trained model: what `compgs.train` does |
| `step/` | what a step does: views, latents, predicted pictures, gradients |
| `shortcuts/` | what saves time in a step |
| `structure/` | what changes the model between steps, and when: growth, pruning, axes, averages |
| `survey` | what the training views see of the model |
| `rate/` | the size of the file, and lambda |
| `optimizers` | Adam's groups, learning rates, and rows that come and go |
| `run/` | carrying a run out, whatever is trained: what all trainers share, loop, checkpoints, processes, profile |
| `splats/` | plain 3DGS, and the methods that build on it |
"""

from compgs.training.hybrid import train, train_hybrid
from compgs.training.plan import Plan
from compgs.training.run.finished import load_run
from compgs.training.run.history import History
from compgs.training.run.profile import StepProfile
from compgs.training.run.run import Run
from compgs.training.run.status import TrainingStatus
from compgs.training.splats.hooks import Drawn, Hooks, SplatRun
from compgs.training.splats.phases import Phase, fine_tuning, train_phases, train_splats
from compgs.training.splats.trainer import SplatTrainer
from compgs.training.start import plan_for
from compgs.training.trainer import Trainer

__all__ = [
    "Drawn",
    "History",
    "Hooks",
    "Phase",
    "Plan",
    "Run",
    "SplatRun",
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
