"""What all trainers have: views in turn, Adam, control of density, and what of a run a checkpoint holds."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar, Protocol

import torch
from torch import Tensor, nn

from compgs.cameras import Camera
from compgs.config import Config
from compgs.gaussians import Gaussians
from compgs.render import RasterResult, RasterSettings, Renderable
from compgs.scene.views import Scene
from compgs.training.optimizers import DECAYS, parameters_of, set_learning_rates
from compgs.training.run.any_trainer import Watch
from compgs.training.run.checkpoint import Checkpoint, Writer, write_checkpoint
from compgs.training.run.distributed import check_identical, sum_gradients, summed_over_ranks
from compgs.training.run.loop import run_to_end
from compgs.training.run.parts import Chance, Memory, Part, Statistics
from compgs.training.run.restoring import restoring
from compgs.training.run.run import Run
from compgs.training.run.seen_points import check_points_seen
from compgs.training.run.status import StepResult, TrainingStatus
from compgs.training.shortcuts.coarse import divided, usual_camera
from compgs.training.step.pictures import Pictures
from compgs.training.step.views_in_turn import ViewsInTurn


class Schedule(Protocol):
    """When statistics for control of density are gathered."""

    def active(self, step: int) -> bool: ...


class Control(Protocol):
    """Control of density, which decides by statistics [N, ...] over several steps."""

    STATISTICS: tuple[str, ...]  # names of its attributes that a checkpoint holds, and the ranks sum


class SceneTrainer(ABC):
    """State of a run on a scene. Each kind of trainer says what it trains, and what it does in a step."""

    kind: ClassVar[str]  # of the primitives, as a progress display calls them
    # What a profile calls the parts of a step: methods of the trainer, or of what it has (`pictures.compare`).
    PROFILED: ClassVar[Mapping[str, str]]

    # Each kind of trainer makes its own.
    trained: nn.Module
    optimizer: torch.optim.Adam
    schedule: Any  # a Schedule
    control: Any  # a Control
    settings: RasterSettings
    pictures: Pictures

    def __init__(self, scene: Scene, config: Config, device: torch.device, method: str) -> None:
        """`method`: as the registry calls it; checkpoints say it. Raises ConfigError for what `ViewsInTurn` refuses."""
        t = config.training
        self.scene = scene
        self.config = config
        self.device = device
        self.method = method
        self.views = ViewsInTurn(scene, device, t.seed + 2, t)
        self.chance = torch.Generator(device).manual_seed(t.seed + 1)  # of growth
        self.step = 0

    @property
    def progress(self) -> float:
        """Return the fraction of the run that is done, 0 to 1."""
        return self.step / self.config.training.steps

    @property
    def watched(self) -> bool:
        """Whether control of density looks at this step."""
        return bool(self.schedule.active(self.step))

    @property
    def lmbda(self) -> float | None:
        """Return the weight of the rate; None where there is none."""
        return None

    @property
    @abstractmethod
    def primitives(self) -> int:
        """Count what `kind` names."""

    def named_parameters(self) -> dict[str, nn.Parameter]:
        """Everything that Adam moves, by names that checkpoints use."""
        return dict(self.trained.named_parameters())

    # one step ------------------------------------------------------------------------------------------------------

    @abstractmethod
    def train_step(self) -> StepResult:
        """Learn from the views that come next, and do what is due after the step."""

    def update(self, views: Sequence[int], loss: Tensor) -> None:
        """Adam's step after these views. Gradients are summed over the ranks, and so is the `loss` [], which becomes
        that of all views.
        """
        of_views = self.views.gradients(views)
        sum_gradients(parameters_of(self.optimizer), loss, *of_views)
        self.set_learning_rates()
        self.move()
        self.optimizer.zero_grad(set_to_none=True)
        self.views.learn(self.progress, views, of_views)

    def set_learning_rates(self) -> None:
        """Give each group of parameters its learning rate of this step."""
        t = self.config.training
        set_learning_rates(self.optimizer, self.progress, DECAYS[t.schedule], t.borders.warm)

    def move(self) -> None:
        """Move the parameters by their gradients."""
        self.optimizer.step()

    @staticmethod
    @abstractmethod
    def stations(
        loss: Tensor, rendered: RasterResult, gaussians: Gaussians
    ) -> Iterable[tuple[str, tuple[Tensor, ...]]]:
        """Name the parts of the backward pass, each with the tensors at which their gradients arrive, for a profile."""

    # the run -------------------------------------------------------------------------------------------------------

    def carry_out(self, run: Run, on_progress: Callable[[TrainingStatus], None] | None = None) -> None:
        """Take all remaining steps as a run is to be carried out. `on_progress`: told in place of the run's own."""
        if run.profile is not None:
            run.profile.watch(self, self.PROFILED, self.stations)
        self.run(run.checkpoint, on_progress or run.on_progress, run.watch)

    def run(
        self,
        path: Path | None,
        on_progress: Callable[[TrainingStatus], None] | None,
        watch: Watch | None = None,
    ) -> None:
        """Take all remaining steps; a checkpoint at `path` every few minutes, at the end, and when interrupted."""
        check_points_seen(self.scene, self.settings.near_plane)
        self.check_ranks()
        run_to_end(self, self.config.training, path, on_progress, watch)

    def held_in_common(self) -> dict[str, Tensor]:
        """Name what all ranks of a torchrun must hold alike."""
        return dict(self.named_parameters())

    def check_ranks(self) -> None:
        """Raises TrainingError if the ranks of a torchrun have come to hold different scenes."""
        check_identical(self.step, self.held_in_common())

    @cached_property
    def usual_camera(self) -> Camera:
        """Return the camera of a training view of the usual size."""
        return usual_camera([view.camera for view in self.scene.train_views])

    def camera_at(self, step: int, divisor: int = 1) -> Camera:
        """Return the camera of a usual training view, as large as a step looks at it, with sides divided by so much."""
        return divided(self.usual_camera, divisor)

    @abstractmethod
    def snapshot(self) -> Renderable:
        """Return the scene of now: a copy that further steps do not change, taken without any chance."""

    @abstractmethod
    def estimated_bytes(self) -> int:
        """Estimate the size of the file if it were written now."""

    def finish(self) -> None:
        """Do what is left to do after the last step; nothing, unless a kind of trainer says otherwise."""
        return None

    # checkpoints ---------------------------------------------------------------------------------------------------

    def save(self, path: Path | None, writer: Writer | None = None) -> None:
        """Write a checkpoint, or let the writer do it. On all ranks at once; None on those that do not write."""
        with summed_over_ranks(self.control, self.control.STATISTICS):
            if path is not None:
                write_checkpoint(path, self.method, self.checkpoint(), writer, device=self.device)

    def checkpoint(self) -> Checkpoint:
        """Return everything that a checkpoint holds."""
        memory = self.memory
        return Checkpoint(
            config=self.config,
            model=self.model_tensors(),
            optimizer=memory.moments(),
            extra=memory.tensors(),
            state={"step": self.step, **self.state(), **memory.state()},
            described=self.described(),
        )

    def model_tensors(self) -> dict[str, Tensor]:
        """Return the tensors of what is trained, for a checkpoint."""
        return dict(self.trained.state_dict())

    def state(self) -> dict[str, Any]:
        """Return what else a checkpoint says of the run, as JSON takes it."""
        return {}

    def described(self) -> dict[str, Any]:
        """Return what a checkpoint says of the model beside its tensors, as JSON takes it."""
        return {}

    def parts(self) -> Sequence[Part]:
        """List what else the run remembers between two steps."""
        return ()

    @property
    def memory(self) -> Memory:
        """What the run remembers between two steps beside the model, the step and `state`."""
        statistics = Statistics(self.control, self.control.STATISTICS)
        parts: tuple[Part, ...] = (statistics, Chance(self.chance), self.views, *self.parts())
        return Memory(self.named_parameters, self.optimizer, parts)

    def go_on(self, path: Path, saved: Checkpoint) -> None:
        """Become what a checkpoint at `path` holds beside the model. Raises CheckpointError if it does not fit."""
        with restoring(path):
            self.restore_state(saved.state)
            self.memory.restore(saved.optimizer, saved.extra, saved.state)
            self.step = saved.state["step"]

    def restore_state(self, state: Mapping[str, Any]) -> None:
        """Inverse of `state`. Raises ValueError and the like for what is none."""
        return None
