"""Plain 3D Gaussian Splatting (Kerbl et al. 2023): what compression is measured against.

    splats ──activate, harmonics──► Gaussians ──rasterize──► image ──(1 - w) L1 + w (1 - SSIM)──► loss

Same scenes, views, rasterizer, loss and evaluation as the hybrid method's (`training/trainer.py`); no networks, no
quantization, no rate.
"""

import json
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from compgs.cameras import Camera
from compgs.config import Config, config_from_dict
from compgs.devices import placed
from compgs.errors import ConfigError
from compgs.gaussians import Gaussians
from compgs.losses import Target, photometric_loss
from compgs.model.splats import SplatModel
from compgs.render import RasterResult, RasterSettings
from compgs.scene import as_scene
from compgs.scene.views import Scene
from compgs.scene.world import local_scene, world_offset
from compgs.tensors.rasterize import rasterize
from compgs.tensors.splats import Splats, splat_gaussians, splat_radii
from compgs.tensors.visibility import visible_mask
from compgs.training.checkpoint import (
    check_same_run,
    optimizer_tensors,
    read_checkpoint_file,
    restore_optimizer,
    tensors_by_kind,
    write_checkpoint_file,
)
from compgs.training.densification import DensityControl, densify_schedule
from compgs.training.loop import (
    StepResult,
    TrainingStatus,
    checkpoint_path,
    chosen_config,
    chosen_device,
    kept_target,
    next_view,
    run_to_end,
)
from compgs.training.optimizers import exponential_decay, set_learning_rates
from compgs.training.profile import StepProfile
from compgs.training.seen_points import check_points_seen
from compgs.training.splat_parameters import (
    SplatParameters,
    initial_splats,
    make_splat_optimizer,
    reset_opacities,
)

METHOD = "3dgs"
# Numbers of a splat in a .ply file of degree 0: position, normal, color, opacity, scales, rotation.
STORED_NUMBERS = 3 + 3 + 3 + 1 + 3 + 4


def train_splats(
    scene: Scene | str | Path,
    config: Config | None = None,
    *,
    preset: str | None = None,
    output: str | Path | None = None,
    resume: bool = False,
    on_progress: Callable[[TrainingStatus], None] | None = None,
    device: str | torch.device | None = None,
    profile: StepProfile | None = None,
) -> SplatModel:
    """Train plain 3DGS on a scene; the result is ready for `compgs.formats.write_ply`. Arguments as of `train`.

    Of the settings, `splats` applies, and of `training` the steps, the seed, the loss and the checkpoints.

    Raises ConfigError, CheckpointError, OutputError, and TrainingError when the optimization cannot go on.
    """
    config = chosen_config(config, preset)
    scene = as_scene(scene)
    chosen = chosen_device(device)
    path = checkpoint_path(output, resume=resume)
    if resume and path:
        trainer = SplatTrainer.resumed(scene, path, config, chosen)
    else:
        trainer = SplatTrainer(scene, config, chosen)
    if profile is not None:
        profile.watch(trainer, PARTS, stations)
    trainer.run(path, on_progress)
    splats = trainer.parameters.trained().arrays(trainer.world_offset)
    return placed(SplatModel(splats, scene.background), chosen)


class SplatTrainer:
    """State of a run: splats, optimizer, density control, and the order in which views come."""

    kind = "splats"
    lmbda = None  # no rate in the loss

    def __init__(
        self,
        scene: Scene,
        config: Config,
        device: torch.device,
        splats: Splats | None = None,
        offset: tuple[float, float, float] | None = None,  # world units, of these splats; None: the scene's
    ) -> None:
        if not scene.train_views:
            raise ConfigError(f"{scene.name}: no training views are left after holding out the test views")
        self.world_offset = world_offset(scene) if offset is None else offset
        scene = self.scene = local_scene(scene, self.world_offset)
        self.config = config
        self.device = device
        self.parameters = SplatParameters((splats or initial_splats(scene.points, config.splats)).to(device))
        self.optimizer = make_splat_optimizer(self.parameters, config.splats, scene.extent)
        self.schedule = densify_schedule(config.splats, config.training.steps, len(scene.train_views))
        self.control = DensityControl(config.splats, scene.extent, len(self.parameters), device)
        self.chance = torch.Generator(device).manual_seed(config.training.seed + 1)  # of splits
        self.shuffle = np.random.default_rng(config.training.seed + 2)
        self.order: list[int] = []
        self.targets: dict[int, Target] = {}
        self.settings = RasterSettings(background=scene.background)
        self.step = 0

    @property
    def primitives(self) -> int:
        return len(self.parameters)

    def degree(self) -> int:
        """Of the harmonics in use: it rises with the run, so that colors settle before their variation."""
        s, steps = self.config.splats, self.config.training.steps
        every = max(1, round(s.harmonics_every * steps))
        return min(s.harmonics, self.step // every)

    # one step ------------------------------------------------------------------------------------------------------

    def train_step(self) -> StepResult:
        """Activate, rasterize, compare, pull; then control density."""
        index = next_view(self.order, len(self.scene.train_views), self.shuffle)
        view = self.scene.train_views[index]
        splats = self.parameters.splats()
        gaussians = self.activate(splats, self.inside(splats, view.camera), view.camera)
        rendered = self.rasterize(gaussians, view.camera)
        loss = self.compare(rendered, self.target(index))
        self.backward(loss, rendered, gaussians)
        self.update()
        self.observe(rendered, view.camera)
        self.step += 1
        self.control_density()
        return StepResult(loss.detach(), rendered.image.detach(), view)

    def inside(self, splats: Splats, camera: Camera) -> Tensor:
        """[M] bool: splats that may be in the image."""
        return visible_mask(splats.means.detach(), splat_radii(splats), camera, self.settings)

    def activate(self, splats: Splats, inside: Tensor, camera: Camera) -> Gaussians:
        return splat_gaussians(splats, camera, self.degree(), inside)

    def rasterize(self, gaussians: Gaussians, camera: Camera) -> RasterResult:
        rendered = rasterize(gaussians, camera, self.settings)
        if self.schedule.active(self.step):
            rendered.means2d.retain_grad()
        return rendered

    def compare(self, rendered: RasterResult, target: Target) -> Tensor:
        return photometric_loss(rendered.image, target, self.config.training.ssim_weight)

    def backward(self, loss: Tensor, rendered: RasterResult, gaussians: Gaussians) -> None:
        """Compute the gradients. The arguments are the tensors at which a profile takes the time (`stations`)."""
        loss.backward()

    def update(self) -> None:
        set_learning_rates(self.optimizer, self.step / self.config.training.steps, exponential_decay)
        self.optimizer.step()
        self.optimizer.zero_grad(set_to_none=True)

    def observe(self, rendered: RasterResult, camera: Camera) -> None:
        if self.schedule.active(self.step) and rendered.means2d.grad is not None:
            self.control.observe(rendered.means2d.grad, rendered.visible, camera)

    def control_density(self) -> None:
        """What the schedule asks for after so many steps."""
        if self.schedule.due(self.step):
            self.control.act(
                self.parameters,
                self.optimizer,
                self.chance,
                remove_large=self.step > self.schedule.reset_every,
            )
        if self.schedule.reset_due(self.step):
            reset_opacities(self.parameters, self.optimizer, self.config.splats.reset_opacity)

    def target(self, view_index: int) -> Target:
        return kept_target(self.targets, view_index, self.scene.train_views, self.device)

    # the run -------------------------------------------------------------------------------------------------------

    def run(self, path: Path | None, on_progress: Callable[[TrainingStatus], None] | None) -> None:
        """All remaining steps; a checkpoint at `path` every few minutes, at the end, and when interrupted."""
        check_points_seen(self.scene, self.settings.near_plane)
        run_to_end(self, self.config.training, path, on_progress)

    def estimated_bytes(self) -> int:
        """Size of the .ply file if it were written now, without its header."""
        return 4 * len(self.parameters) * (STORED_NUMBERS + self.parameters.rest[0].numel())

    def finish(self) -> None:
        """Nothing is left to do: the file holds the splats as they are."""

    # checkpoints ---------------------------------------------------------------------------------------------------

    def save(self, path: Path) -> None:
        tensors = {f"model/{name}": p for name, p in vars(self.parameters.trained()).items()}
        moments = optimizer_tensors(self.parameters, self.optimizer)
        tensors |= {f"optimizer/{name}": value for name, value in moments.items()}
        tensors |= {f"extra/control/{n}": getattr(self.control, n) for n in DensityControl.STATISTICS}
        tensors["extra/chance"] = self.chance.get_state()
        state = {
            "step": self.step,
            "order": self.order,
            "shuffle": self.shuffle.bit_generator.state,
            "views": [view.name for view in self.scene.train_views],
            "world_offset": self.world_offset,
        }
        metadata = {"config": json.dumps(self.config.to_dict()), "state": json.dumps(state)}
        write_checkpoint_file(path, METHOD, tensors, metadata)

    @classmethod
    def resumed(cls, scene: Scene, path: Path, config: Config, device: torch.device) -> "SplatTrainer":
        """Raises CheckpointError if there is no checkpoint, or the run was another scene's or had other settings."""
        tensors, metadata = read_checkpoint_file(path, METHOD)
        state = json.loads(metadata["state"])
        saved = config_from_dict(json.loads(metadata["config"]), str(path))
        check_same_run(saved, config, state["views"], scene)
        parts = tensors_by_kind(tensors)
        offset = tuple(state.get("world_offset", (0.0, 0.0, 0.0)))  # older checkpoints have none
        trainer = cls(scene, config, device, Splats(**parts["model"]), offset)
        restore_optimizer(trainer.parameters, trainer.optimizer, parts["optimizer"])
        for name in DensityControl.STATISTICS:
            setattr(trainer.control, name, parts["extra"][f"control/{name}"].to(device))
        trainer.chance.set_state(parts["extra"]["chance"])
        trainer.shuffle.bit_generator.state = state["shuffle"]
        trainer.order = state["order"]
        trainer.step = state["step"]
        return trainer


# What a profile calls the parts of a step.
PARTS = {
    "inside": "culling",
    "activate": "activation and harmonics",
    "rasterize": "projection and rasterization",
    "compare": "loss",
    "backward": "activation and harmonics, backward",
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
