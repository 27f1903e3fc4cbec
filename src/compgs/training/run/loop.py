"""What training is, whatever is trained: steps to the end, progress, checkpoints, a stop at any time."""

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from compgs import devices
from compgs.cameras import Camera
from compgs.config import Config, TrainingConfig, check_config, load_config
from compgs.errors import ConfigError, TrainingError
from compgs.gaussians import Gaussians
from compgs.interrupt import held_back
from compgs.losses import Target, exposed
from compgs.render import RasterResult, RasterSettings, Renderable
from compgs.tensors.rasterize import rasterize
from compgs.training.plan import Plan
from compgs.training.run.allocation import freed_memory_kept
from compgs.training.run.checkpoint import CHECKPOINT_NAME, Writer
from compgs.training.run.distributed import local_device, on_any_rank, rank, stopping_together, world
from compgs.training.run.profile import StepProfile
from compgs.training.run.time_left import TimeLeft

REPORT_EVERY = 10  # steps between two status reports
ESTIMATE_EVERY = 100  # steps between two estimates of the file's size: it may look at every primitive


@dataclass(frozen=True)
class TrainingStatus:
    """What a progress display shows."""

    step: int
    steps: int
    loss: float
    psnr: float  # dB, of the last training view
    primitives: int
    kind: str  # of primitives: "anchors", "splats"
    estimated_bytes: int
    seconds_per_step: float
    lmbda: (
        float | None
    )  # weight of the rate, which follows the size where one is asked for; None: there is no rate
    seconds_left: float | None = None  # None: the steps that are left, at the present pace
    # Of the whole run, where the sides of the photographs are divided by so much; empty unless they are large.
    seconds_by_divisor: Mapping[int, float] = field(default_factory=dict)


@dataclass(frozen=True)
class StepResult:
    loss: Tensor  # []; a tensor, so that the CPU waits for the GPU only when somebody reads it
    image: Tensor  # [H, W, 3] rendered
    photograph: Target  # what it was compared with


class Run:
    """How a training is carried out, whatever is trained: nothing of it is a setting of what comes out."""

    def __init__(
        self,
        method: str,  # as it is called in the registry; checkpoints say it
        *,
        output: str | Path | None = None,  # folder for checkpoints
        resume: bool = False,
        on_progress: Callable[[TrainingStatus], None] | None = None,
        device: str | torch.device | None = None,  # None: CUDA where there is one
        profile: StepProfile | None = None,
        watch: "Watch | None" = None,
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


class Trains(Protocol):
    """State of a run, at a step."""

    step: int

    @property
    def primitives(self) -> int: ...

    @property
    def kind(self) -> str: ...

    @property
    def lmbda(self) -> float | None: ...

    def train_step(self) -> StepResult: ...

    def estimated_bytes(self) -> int: ...

    def snapshot(self) -> Renderable:
        """The scene of now, to be rendered: a copy that further steps do not change, taken without any chance."""
        ...

    def camera_at(self, step: int, divisor: int = 1) -> Camera:
        """Return the camera of a usual training view, as large as a step looks at it.

        The photographs' sides are divided by `divisor`.
        """
        ...

    def finish(self) -> None: ...

    def save(self, path: Path | None, writer: Writer | None = None) -> None:
        """Write a checkpoint, or let the writer do it. On all ranks at once; None on those that do not write."""
        ...


# Called between any two steps, for whoever wants to look at the scene as it grows.
Watch = Callable[[Trains], None]


def rasterize_step(
    gaussians: Gaussians, camera: Camera, settings: RasterSettings, *, watched: bool
) -> RasterResult:
    """A training view. Where growth watches the step, the gradients by the 2D means are kept: it goes by them."""
    rendered = rasterize(gaussians, camera, settings)
    if watched:
        rendered.means2d.retain_grad()
    return rendered


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


def diverged(step: int, what: str, value: float) -> TrainingError:
    """The error to raise for a value that is not finite any more."""
    return TrainingError(f"step {step}: the {what} is {value}; try a lower learning rate or another seed")


class Pace:
    """Seconds per step, of the last steps; what the first step takes to compile or load kernels does not count."""

    def __init__(self) -> None:
        self.seconds = 0.0  # unknown before the second step
        self._size: object = None
        self._since: float | None = None
        self._steps = 0

    def step(self) -> None:
        """Count a step."""
        if self._since is None:
            self._since = time.perf_counter()
        else:
            self._steps += 1

    def look(self, size: object = None) -> float:
        """Seconds per step, smoothed; the mean is forgotten when steps become twice as fast, as after compiling, or
        look at pictures of another size.
        """
        now = time.perf_counter()
        if self._since is not None and self._steps:
            recent = (now - self._since) / self._steps
            steady = self.seconds and size == self._size and recent >= 0.5 * self.seconds
            self._size = size
            self.seconds = 0.9 * self.seconds + 0.1 * recent if steady else recent
            self._since, self._steps = now, 0
        return self.seconds

    def pause(self, seconds: float) -> None:
        """Leave out seconds that were spent on something else than steps."""
        if self._since is not None:
            self._since += seconds


class Saving:
    """A run's checkpoint: written every few minutes, at the end, and when the run is stopped.

    A run that takes the place of an earlier one leaves the earlier checkpoint until it has been going for long enough
    to write one of its own: whoever stops it at once keeps what there was.

    Those on the way are written beside the steps that follow. Of several ranks only rank 0 writes, and decides, but a
    checkpoint needs all of them.
    """

    def __init__(self, trainer: Trains, path: Path | None, minutes: float) -> None:
        self.trainer = trainer
        self.path = path
        self.writer = Writer()
        self.begun = False
        self.seconds = 60 * minutes
        self.saved = time.perf_counter()
        (self.writes,) = on_any_rank(path is not None)
        (self.replaces,) = on_any_rank(path is not None and trainer.step == 0 and path.exists())

    def due(self) -> bool:
        if not self.writes:
            return False
        waited = time.perf_counter() - self.saved > self.seconds
        (due,) = on_any_rank(self.path is not None and waited and not self.begun)
        return due

    def save(self, writer: Writer | None = None) -> float:
        """Seconds that it took. Whoever stops the run meanwhile is heard when the checkpoint is whole."""
        start = time.perf_counter()
        if self.writes:
            with held_back():
                self.trainer.save(self.path, writer)
        self.saved, self.replaces = time.perf_counter(), False
        return self.saved - start

    def begin(self) -> float:
        """Let a checkpoint be written while the run goes on; seconds that it waited."""
        self.begun = self.path is not None
        return self.save(self.writer)

    def last(self) -> None:
        """The checkpoint of the end."""
        with held_back():
            self.writer.finish()
            self.save()

    def ended(self) -> bool:
        """Whether one that was begun has been written since this was asked last. Raises OutputError if it could not."""
        ended = self.begun and not self.writer.busy
        self.begun = self.begun and not ended
        self.writer.check()
        return ended

    def stopped(self) -> None:
        """Save, unless an earlier run's checkpoint would be lost."""
        if not self.replaces:
            self.last()


@freed_memory_kept()
def run_to_end(
    trainer: Trains,
    config: TrainingConfig,
    path: Path | None,
    on_progress: Callable[[TrainingStatus], None] | None,
    watch: Watch | None = None,
) -> None:
    """All remaining steps; checkpoints at `path` as `Saving` says. Progress is reported now and then, and right after
    each checkpoint. What `watch` does takes its time, and changes nothing. Of several ranks rank 0 alone writes
    and reports."""
    if rank() > 0:
        path, on_progress, watch = None, None, None
    saving, pace, estimate = Saving(trainer, path, config.checkpoint_minutes), Pace(), 0
    left = TimeLeft(trainer, config.steps, -(-config.views_per_step // world()))
    try:
        while trainer.step < config.steps:
            with stopping_together():
                with held_back():
                    result = trainer.train_step()
                pace.step()
                told = trainer.step % REPORT_EVERY == 0 or trainer.step == config.steps or saving.ended()
                saves = saving.due()
                # Before anything is computed from what has diverged.
                if (told or saves) and not torch.isfinite(result.loss):
                    raise diverged(trainer.step, "loss", float(result.loss))
                if saves:
                    pace.pause(saving.begin())
                if on_progress and told:
                    seconds = pace.look(left.size)
                    pace.pause(left.look(seconds))
                    if trainer.step % ESTIMATE_EVERY == 0 or not estimate:
                        estimate = trainer.estimated_bytes()
                    on_progress(_status(trainer, config.steps, result, estimate, seconds, left))
                if watch:
                    watch(trainer)
        with stopping_together():
            trainer.finish()
    except KeyboardInterrupt:
        saving.stopped()
        raise
    saving.last()


def _status(
    trainer: Trains, steps: int, result: StepResult, estimate: int, pace: float, left: TimeLeft
) -> TrainingStatus:
    photograph, counted = result.photograph.image.to(result.image.dtype) / 255.0, result.photograph.counted
    image = exposed(result.image, result.photograph.exposure).detach()
    squares = (image.clamp(0, 1) - photograph) ** 2
    error = float((squares if counted is None else squares[counted]).mean())
    psnr = -10.0 * float(np.log10(max(error, 1e-10)))
    return TrainingStatus(
        step=trainer.step,
        steps=steps,
        loss=float(result.loss),
        psnr=psnr,
        primitives=trainer.primitives,
        kind=trainer.kind,
        estimated_bytes=estimate,
        seconds_per_step=pace,
        lmbda=trainer.lmbda,
        seconds_left=left.seconds(),
        seconds_by_divisor=left.by_divisor(),
    )
