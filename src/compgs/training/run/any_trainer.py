"""What the loop needs of a trainer, whatever it trains."""

from collections.abc import Callable
from pathlib import Path
from typing import Protocol

from compgs.cameras import Camera
from compgs.render import Renderable
from compgs.training.run.checkpoint import Writer
from compgs.training.run.status import StepResult


class AnyTrainer(Protocol):
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
Watch = Callable[[AnyTrainer], None]
