"""Plain 3D Gaussian Splatting (Kerbl et al. 2023): what compression is measured against.

    splats ──activate, harmonics──► Gaussians ──rasterize──► image ──(1 - w) L1 + w (1 - SSIM)──► loss

Same scenes, views, rasterizer, loss and evaluation as the hybrid method's (`training/trainer.py`); no networks, no
quantization, no rate. Methods that compress splats build on it by `training/splats/hooks.py`.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from compgs.cameras import Camera
from compgs.config import Config
from compgs.devices import placed
from compgs.gaussians import Gaussians
from compgs.losses import SSIM_WEIGHT
from compgs.model.splats import SplatModel
from compgs.render import RasterResult, RasterSettings
from compgs.scene.views import Scene
from compgs.scene.world import local_scene, world_offset
from compgs.tensors.splats import Splats, splat_gaussians, splat_radii
from compgs.tensors.visibility import visible_mask
from compgs.training.optimizers import exponential_decay, rates_for, set_learning_rates
from compgs.training.run.checkpoint import checkpoint_of
from compgs.training.run.distributed import share_of_rank, summed_over_ranks
from compgs.training.run.parts import Part
from compgs.training.run.restoring import check_tensor, finite, restoring
from compgs.training.run.scene_trainer import SceneTrainer
from compgs.training.run.status import StepResult
from compgs.training.splats.densification import DensityControl, densify_schedule
from compgs.training.splats.hooks import HOOKS, Drawn, Hooks, HookState, hook_state, parameter_groups
from compgs.training.splats.parameters import (
    SplatParameters,
    initial_splats,
    make_splat_optimizer,
    of_degree,
    replace_rows_of,
    replace_splats,
    reset_opacities,
)
from compgs.training.step.pictures import Pictures

METHOD = "3dgs"


# What a profile calls the parts of a step: methods of the trainer and of what it has.
PARTS = {
    "inside": "culling",
    "activate": "activation and harmonics",
    "pictures.rasterize": "projection and rasterization",
    "compare": "loss",
    "pictures.backward": "activation and harmonics, backward",
    "update": "optimizer",
    "control_density": "density control",
}


def stations(
    loss: Tensor, rendered: RasterResult, gaussians: Gaussians
) -> Iterator[tuple[str, tuple[Tensor, ...]]]:
    """Where the gradients of a step arrive. Autograd goes back through the projection, then through the harmonics."""
    yield "loss, backward", (rendered.image,)
    yield "rasterization, backward", (rendered.means2d,)
    yield "projection, backward", (gaussians.colors,)


class SplatTrainer(SceneTrainer):
    """State of a run: splats, optimizer, density control, and the order in which views come."""

    kind = "splats"
    PROFILED = PARTS
    stations = staticmethod(stations)

    def __init__(
        self,
        scene: Scene,
        config: Config,
        device: torch.device,
        start: SplatModel | None = None,  # trained splats to begin with; None: the scene's points
        hooks: Hooks | None = None,
        *,
        phase: int = 0,  # of the run, and the method whose run it is: checkpoints say them
        method: str = METHOD,
    ) -> None:
        super().__init__(scene, config, device, method)
        t = config.training
        if t.learns_poses(in_doubt=bool(scene.poses_in_doubt)):
            self.views.learn_poses()
        self.world_offset = world_offset(scene) if start is None else start.world_offset
        scene = self.scene = local_scene(scene, self.world_offset)
        self.phase = phase
        self.hooks = (hooks or Hooks()).to(device)
        splats = (
            initial_splats(scene.points, config.splats)
            if start is None
            else of_degree(Splats.of(start.splats), config.splats.harmonics)
        )
        self.parameters = self.trained = SplatParameters(splats.to(device))
        self.optimizer = make_splat_optimizer(self.parameters, config.splats, scene.extent, t.views_per_step)
        self.schedule = densify_schedule(config.splats, t.steps, len(scene.train_views), t.views_per_step)
        self.control = DensityControl(config.splats, scene.extent, len(self.parameters), device)
        self.settings = RasterSettings(background=scene.background)
        self.pictures = Pictures(self.settings, SSIM_WEIGHT)

    def begin(self) -> None:
        """Let the hooks make what depends on the splats: before the first step of a run that is not resumed."""
        self.hooks.begin(self)
        self.train_hooks()

    def train_hooks(self) -> None:
        """Add the hooks' parameters to the optimizer, those that are not in it: after a hook made new ones."""
        there = {group["name"] for group in self.optimizer.param_groups}
        self.hooks.to(self.device)
        for name, parameters in parameter_groups(self.hooks).items():
            if HOOKS + name not in there:
                rates = rates_for(self.config.training.views_per_step, self.hooks.rates[name])
                group = {"name": HOOKS + name, "params": parameters, "lr": rates[0], "rates": rates}
                self.optimizer.add_param_group(group)

    @property
    def primitives(self) -> int:
        return len(self.parameters)

    def degree(self) -> int:
        """Return the degree of the harmonics in use: it rises with the run, so that colors settle before their
        variation.
        """
        s, steps = self.config.splats, self.config.training.steps
        every = round(s.harmonics_every * steps)
        return min(s.harmonics, self.step // max(1, every)) if s.harmonics_every > 0 else s.harmonics

    # one step ------------------------------------------------------------------------------------------------------

    def train_step(self) -> StepResult:
        """Activate, rasterize, compare, pull, for each view; then move, and control density."""
        views = self.views.next()
        results = [self.learn_from(view) for view in share_of_rank(views)]
        loss = torch.stack([result.loss for result in results]).sum()
        self.update(views, loss)
        self.step += 1
        self.control_density()
        self.hooks.after_step(self)
        return replace(results[-1], loss=loss / len(views))

    def learn_from(self, view: int) -> StepResult:
        """The gradients of a view."""
        drawn = self.draw(view)
        loss = self.compare(drawn)
        self.pictures.backward(loss, drawn.rendered, drawn.gaussians)
        self.observe(drawn.rendered, drawn.camera)
        return StepResult(loss.detach(), drawn.rendered.image.detach(), drawn.photograph)

    def draw(self, index: int) -> Drawn:
        """A training view as the hooks want it looked at."""
        photograph = self.views.photograph(index)
        camera, photograph = self.hooks.view(self.scene.train_views[index].camera, photograph, self)
        splats = self.hooks.transform(self.parameters.splats(), self)
        gaussians = self.activate(splats, self.inside(splats, camera), camera)
        posed = self.views.posed(index, gaussians, camera)
        rendered = self.pictures.rasterize(posed, camera, watched=self.watched)
        photograph = self.views.trusted(index, rendered.image, photograph)
        return Drawn(camera, photograph, splats, gaussians, rendered)

    def inside(self, splats: Splats, camera: Camera) -> Tensor:
        """[M] bool: splats that may be in the image."""
        return visible_mask(splats.means.detach(), splat_radii(splats), camera, self.settings)

    def activate(self, splats: Splats, inside: Tensor, camera: Camera) -> Gaussians:
        return splat_gaussians(splats, camera, self.degree(), inside)

    def compare(self, drawn: Drawn) -> Tensor:
        """[] by how much the picture differs from its photograph, and what the hooks add to that."""
        loss = self.pictures.compare(drawn.rendered, drawn.photograph)
        added = self.hooks.loss(drawn, self)
        return loss if added is None else loss + added

    def set_learning_rates(self) -> None:
        """Give each group of parameters its learning rate of this step."""
        set_learning_rates(self.optimizer, self.progress, self.learning_rate)

    def learning_rate(self, first: float, last: float, progress: float) -> float:
        """Return the learning rate of a group, at some progress of the phase."""
        return exponential_decay(first, last * self.hooks.slowing, progress)

    def observe(self, rendered: RasterResult, camera: Camera) -> None:
        """Gather the statistics that density control goes by, where it watches the step."""
        if self.watched and rendered.means2d.grad is not None:
            self.control.observe(rendered.means2d.grad, rendered.visible, camera)

    def control_density(self) -> None:
        """What the schedule asks for after so many steps."""
        if self.schedule.due(self.step):
            large = self.step > self.schedule.reset_every
            with summed_over_ranks(self.control, DensityControl.STATISTICS):
                kept, added, origins = self.control.chosen(
                    self.parameters.trained(), self.as_drawn(), self.chance, remove_large=large
                )
                self.replace(kept, added, origins)
                self.control.forget(len(self.parameters))
            self.hooks.densified(self)
            self.check_ranks()
        if self.schedule.reset_due(self.step):
            reset_opacities(self.parameters, self.optimizer, self.config.splats.reset_opacity)

    def held_in_common(self) -> dict[str, Tensor]:
        """Name what all ranks of a torchrun must hold alike: buffers of the hooks, too."""
        own = {HOOKS + name: value for name, value in hook_state(self.hooks).items()}
        return {**self.named_parameters(), **own}

    @torch.no_grad()
    def as_drawn(self) -> Splats:
        """The splats as the hooks' `transform` leaves them, without gradients."""
        splats = self.hooks.transform(self.parameters.splats(), self)
        return Splats(**{name: value.detach() for name, value in vars(splats).items()})

    def keep(self, kept: Tensor) -> None:
        """Remove the splats outside of `kept` [M] bool; all that belongs to them goes, too."""
        none = torch.zeros(0, dtype=torch.int64, device=self.device)
        self.replace(kept, self.parameters.trained().rows(none), none)
        self.control.keep(kept)

    def replace(self, kept: Tensor, added: Splats, origins: Tensor) -> None:
        """Keep some splats, [M] bool, and append others, which came from those of the rows `origins` [A] int64."""
        replace_splats(self.parameters, self.optimizer, kept, added)
        for name in self.hooks.per_splat:
            replace_rows_of(self.hooks, name, self.optimizer, kept, origins)

    # the run -------------------------------------------------------------------------------------------------------

    def estimated_bytes(self) -> int:
        """Size of the method's file if it were written now; of a .ply file without its header."""
        known = self.hooks.estimated_bytes(self)
        if known is not None:
            return known
        # In a .ply file: position, normal, color, opacity, scales, rotation, and the higher harmonics.
        numbers = 3 + 3 + 3 + 1 + 3 + 4 + self.parameters.rest[0].numel()
        return 4 * len(self.parameters) * numbers

    def finish(self) -> None:
        """Plain 3DGS has nothing left to do: the file holds the splats as they are."""
        self.hooks.finish(self)

    def camera_at(self, step: int, divisor: int = 1) -> Camera:
        """Return the camera of a usual training view, as large as a step looks at it, with sides divided by so much."""
        return self.hooks.sized(super().camera_at(step, divisor), step / self.config.training.steps)

    def snapshot(self) -> SplatModel:
        """Return the splats before any `transform`, for which a hook may draw random numbers."""
        return self.model()

    def model(self) -> SplatModel:
        """The splats of now, before any `transform`."""
        arrays = self.parameters.trained().arrays(self.world_offset)
        return placed(SplatModel(arrays, self.scene.background), self.device)

    # checkpoints ---------------------------------------------------------------------------------------------------

    def state(self) -> dict[str, Any]:
        return {"phase": self.phase, "world_offset": self.world_offset}

    def parts(self) -> Sequence[Part]:
        return (HookState(self.hooks, self.train_hooks),)

    def named_parameters(self) -> dict[str, nn.Parameter]:
        """All that is trained."""
        own = {HOOKS + name: parameter for name, parameter in self.hooks.named_parameters()}
        return {**dict(self.parameters.named_parameters()), **own}

    @classmethod
    def resumed(
        cls,
        scene: Scene,
        path: Path,
        config: Config,
        device: torch.device,
        hooks: Hooks | None = None,
        *,
        phase: int = 0,
        method: str = METHOD,
    ) -> "SplatTrainer":
        """Raises CheckpointError if there is no checkpoint, or the run was another scene's or had other settings."""
        saved = checkpoint_of(path, method, config, scene, device)
        with restoring(path):
            x, y, z = finite(saved.state["world_offset"], 3, "world_offset")
            start = SplatModel(checked_splats(saved.model).arrays((x, y, z)), scene.background)
        trainer = cls(scene, config, device, start, hooks, phase=phase, method=method)
        trainer.go_on(path, saved)
        return trainer


def checked_splats(tensors: dict[str, Tensor]) -> Splats:
    """Read the splats of a checkpoint. Raises ValueError and the like for what does not belong together."""
    count, harmonics = len(tensors["means"]), tensors["rest"].shape[1]
    shapes = {"means": (3,), "log_scales": (3,), "quaternions": (4,), "opacity_logits": (), "dc": (3,)}
    for name, shape in {**shapes, "rest": (harmonics, 3)}.items():
        check_tensor(tensors[name], (count, *shape), torch.float32, name)
    if harmonics + 1 not in (1, 4, 9, 16):
        raise ValueError(f"{harmonics} harmonics are those of no degree")
    return Splats(**tensors)
