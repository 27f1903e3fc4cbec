"""What a method adds to plain 3DGS: the moments of a run at which it may act (`training/splats/trainer.py`).

    parameters ──transform──► splats ──rasterize──► image ──compare, + loss──► gradients ──► step ──► after_step
                               at the steps of density control: ──► densified

A hook's own parameters (codebooks, masks, decoders) are those of a `torch.nn.Module`: the run trains them at the
`rates` they name, and checkpoints keep them with its buffers.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import torch
from torch import Tensor, nn

from compgs.cameras import Camera
from compgs.gaussians import Gaussians
from compgs.losses import Target
from compgs.render import RasterResult, RasterSettings
from compgs.scene.views import Scene
from compgs.tensors.splats import Splats
from compgs.training.splats.parameters import SplatParameters

HOOKS = "hooks/"  # before the names of the hooks' parameters, in checkpoints and in the optimizer


@dataclass(frozen=True)
class Drawn:
    """A training view as it was drawn, in the autograd graph."""

    camera: Camera
    photograph: Target
    splats: Splats  # as they were drawn: after the hooks' `transform`
    gaussians: Gaussians
    rendered: RasterResult


class SplatRun(Protocol):
    """What hooks see of a run (`training/splats/trainer.py`), and what they may ask of it."""

    scene: Scene
    config: Any
    device: torch.device
    step: int
    settings: RasterSettings
    parameters: SplatParameters
    optimizer: torch.optim.Adam
    schedule: Any
    world_offset: tuple[float, float, float]
    hooks: "Hooks"

    @property
    def progress(self) -> float:
        """Return the fraction of the phase that is done, 0 to 1."""
        ...

    def inside(self, splats: Splats, camera: Camera) -> Tensor:
        """[M] bool: splats that may be in the image."""
        ...

    def as_drawn(self) -> Splats:
        """The splats as the hooks' `transform` leaves them, without gradients."""
        ...

    def keep(self, kept: Tensor) -> None:
        """Remove the splats outside of `kept` [M] bool; all that belongs to them goes, too."""
        ...

    def train_hooks(self) -> None:
        """Let Adam move the hooks' parameters that are new."""
        ...


class Hooks(nn.Module):
    """Plain 3DGS: nothing is added. A method overrides what it needs.

    All methods but `transform` and `loss` are called without an autograd graph of the step being kept.
    """

    # First and last learning rate (exponential between them) of parameters, or of modules of them, by name.
    rates: Mapping[str, tuple[float, float]] = {}
    # Names of parameters and buffers [M, ...] with a row for each splat: the rows follow when splats are cloned, split
    # or removed. A new splat has the row of the one it came from.
    per_splat: tuple[str, ...] = ()
    # By which all learning rates are multiplied at the end of the phase (exponential from 1), beside their own decay.
    slowing: float = 1.0

    def begin(self, trainer: SplatRun) -> None:
        """Make what depends on the splats there are, before the first step; not when a run is resumed."""

    def view(self, camera: Camera, photograph: Target, trainer: SplatRun) -> tuple[Camera, Target]:
        """What this step looks at: the view as it is, a smaller one, another picture of it."""
        return camera, photograph

    def sized(self, camera: Camera, progress: float) -> Camera:
        """Make a camera as large as `view` does at a `progress` of the run, 0 to 1."""
        return camera

    def transform(self, splats: Splats, trainer: SplatRun) -> Splats:
        """The splats as they are drawn, differentiable: quantized, masked, decoded. Density control judges these."""
        return splats

    def loss(self, drawn: Drawn, trainer: SplatRun) -> Tensor | None:
        """[] to add to the loss of a view: a penalty, a rate, a distillation."""
        return None

    def densified(self, trainer: SplatRun) -> None:
        """Right after splats were cloned, split and removed."""

    def after_step(self, trainer: SplatRun) -> None:
        """Act after each step; `trainer.step` is the number of steps done."""

    def finish(self, trainer: SplatRun) -> None:
        """Act after the last step. It is called again if the finished run is resumed: the second time must change
        nothing.
        """

    def estimated_bytes(self, trainer: SplatRun) -> int | None:
        """Estimate the bytes of the file if it were written now; None: those of a .ply file."""
        return None


def hook_state(hooks: Hooks) -> dict[str, Tensor]:
    """Parameters and buffers by name."""
    return dict(hooks.state_dict())


def restore_hooks(hooks: Hooks, tensors: Mapping[str, Tensor]) -> None:
    """Inverse of `hook_state`, also for what `begin` or later steps would have made, of whatever shape."""
    trained = {
        name for rate in hooks.rates for name in tensors if name == rate or name.startswith(f"{rate}.")
    }
    for name, value in tensors.items():
        path, _, attribute = name.rpartition(".")
        module = hooks.get_submodule(path)
        if name in trained:
            setattr(module, attribute, nn.Parameter(value))
        else:
            module.register_buffer(attribute, value)


@dataclass(frozen=True)
class HookState:
    """The parameters and buffers of hooks, as a run remembers them."""

    hooks: Hooks
    restored: Callable[[], None]  # called when they are back

    def tensors(self) -> dict[str, Tensor]:
        """All of them, for a checkpoint."""
        return {HOOKS + name: value for name, value in hook_state(self.hooks).items()}

    def state(self) -> dict[str, Any]:
        """Nothing beside the tensors."""
        return {}

    def restore(self, tensors: Mapping[str, Tensor], state: Mapping[str, Any]) -> None:
        """Inverse of `tensors`. Raises ValueError and the like."""
        own = {name.removeprefix(HOOKS): v for name, v in tensors.items() if name.startswith(HOOKS)}
        restore_hooks(self.hooks, own)
        self.restored()


def parameter_groups(hooks: Hooks) -> dict[str, list[nn.Parameter]]:
    """The parameters that there are now, by the name of their learning rate in `rates`."""
    named = list(hooks.named_parameters())
    groups = {
        rate: [p for name, p in named if name == rate or name.startswith(f"{rate}.")] for rate in hooks.rates
    }
    return {rate: parameters for rate, parameters in groups.items() if parameters}
