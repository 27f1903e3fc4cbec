"""How a training is carried out: nothing of it is a setting of what comes out."""

from collections.abc import Callable
from pathlib import Path

import torch

from compgs import devices
from compgs.config import Config, check_config, load_config
from compgs.errors import ConfigError
from compgs.training.plan import Plan
from compgs.training.run.any_trainer import Watch
from compgs.training.run.checkpoint import CHECKPOINT_NAME
from compgs.training.run.distributed import local_device
from compgs.training.run.profile import StepProfile
from compgs.training.run.status import TrainingStatus


class Run:
    """Folder, device and onlookers of a training, whatever is trained."""

    def __init__(
        self,
        method: str,  # as it is called in the registry; checkpoints say it
        *,
        output: str | Path | None = None,  # folder for checkpoints
        resume: bool = False,
        on_progress: Callable[[TrainingStatus], None] | None = None,
        device: str | torch.device | None = None,  # None: CUDA where there is one
        profile: StepProfile | None = None,
        watch: Watch | None = None,
        plan: Plan | None = None,
    ) -> None:
        """`plan`: what has been decided already; None: the run makes its own.

        Raises ConfigError if there is no folder to resume from.
        """
        if output is None and resume:
            raise ConfigError("resume needs an output folder: the one of the run to continue")
        self.method = method
        self.checkpoint = None if output is None else Path(output) / CHECKPOINT_NAME
        self.resume = resume
        self.on_progress = on_progress
        self.device = chosen_device(device)
        devices.prepare_device(str(self.device))
        self.profile = profile
        self.watch = watch
        self.plan = plan

    @property
    def earlier(self) -> Path | None:
        """The checkpoint to go on from, if that is asked for."""
        return self.checkpoint if self.resume else None


def chosen_device(device: str | torch.device | None) -> torch.device:
    """The given device, or the best that works here; of several processes on a machine each has its own GPU.

    Raises ConfigError for a device that is not known or not there, MissingDependency where packages for it are missing.
    """
    return local_device(torch.device(devices.chosen_device(device)))


def chosen_config(config: Config | None, preset: str | None) -> Config:
    """The given one, or a preset's; of neither, the preset `default`. Raises ConfigError for both, or a bad one."""
    if config is not None and preset is not None:
        raise ConfigError(
            f"config and preset={preset!r} were both given: give one; compgs.load_config({preset!r}) is a config"
        )
    if config is not None and not isinstance(config, Config):
        raise ConfigError(
            f"config: expected what compgs.load_config gives, found {config!r}; a preset is given as preset='quick'"
        )
    chosen = config or load_config(preset or "default")
    check_config(chosen)
    return chosen
