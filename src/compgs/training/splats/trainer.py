"""Plain 3D Gaussian Splatting (Kerbl et al. 2023): what compression is measured against.

    splats ──activate, harmonics──► Gaussians ──rasterize──► image ──(1 - w) L1 + w (1 - SSIM)──► loss

Same scenes, views, rasterizer, loss and evaluation as the hybrid method's (`training/trainer.py`); no networks, no
quantization, no rate. Methods that compress splats build on it by `training/splats/hooks.py`.
"""

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor, nn

from compgs.cameras import Camera
from compgs.config import Config, config_from_dict
from compgs.devices import placed
from compgs.gaussians import Gaussians
from compgs.losses import photometric_loss
from compgs.model.splats import SplatModel
from compgs.render import RasterResult, RasterSettings
from compgs.scene import as_scene
from compgs.scene.views import Scene
from compgs.scene.world import local_scene, world_offset
from compgs.tensors.splats import Splats, splat_gaussians, splat_radii
from compgs.tensors.visibility import visible_mask
from compgs.training.optimizers import exponential_decay, parameters_of, rates_for, set_learning_rates
from compgs.training.run.checkpoint import (
    Writer,
    check_same_run,
    read_checkpoint_file,
    tensors_by_kind,
    write_checkpoint_file,
)
from compgs.training.run.distributed import check_identical, mine, sum_gradients, whole
from compgs.training.run.loop import (
    Run,
    StepResult,
    TrainingStatus,
    Watch,
    chosen_config,
    rasterize_step,
    run_to_end,
)
from compgs.training.run.parts import Chance, Memory, Statistics
from compgs.training.run.profile import StepProfile
from compgs.training.run.restoring import (
    check_step,
    check_tensor,
    finite,
    restoring,
)
from compgs.training.run.seen_points import check_points_seen
from compgs.training.shortcuts.coarse import usual_camera
from compgs.training.splats.densification import DensityControl, densify_schedule
from compgs.training.splats.hooks import Drawn, Hooks, hook_state, parameter_groups, restore_hooks
from compgs.training.splats.parameters import (
    SplatParameters,
    initial_splats,
    make_splat_optimizer,
    of_degree,
    replace_rows_of,
    replace_splats,
    reset_opacities,
)
from compgs.training.step.views_in_turn import ViewsInTurn

METHOD = "3dgs"
HOOKS = "hooks/"  # before the names of the hooks' parameters, in checkpoints and in the optimizer
# Numbers of a splat in a .ply file of degree 0: position, normal, color, opacity, scales, rotation.
STORED_NUMBERS = 3 + 3 + 3 + 1 + 3 + 4


def train_splats(
    scene: Scene | str | Path,
    config: Config | None = None,
    *,
    preset: str | None = None,
    output: str | Path | None = None,
    resume: bool = False,
    progress: Callable[[TrainingStatus], None] | None = None,
    device: str | torch.device | None = None,
    profile: StepProfile | None = None,
) -> SplatModel:
    """Train plain 3DGS on a scene; the result is ready for `compgs.formats.write_ply`. Arguments as of `train`.

    Of the settings, `splats` applies, and of `training` the steps, the seed, the loss and the checkpoints.

    Raises ConfigError, CheckpointError, OutputError, and TrainingError when the optimization cannot go on.
    """
    from compgs.training.splats.phases import Phase, train_phases

    config = chosen_config(config, preset)
    run = Run(METHOD, output=output, resume=resume, on_progress=progress, device=device, profile=profile)
    return train_phases(as_scene(scene), (Phase(config),), run).model()


class SplatTrainer:
    """State of a run: splats, optimizer, density control, and the order in which views come."""

    kind = "splats"
    lmbda = None  # no rate in the loss

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
        t = config.training
        per_step = t.views_per_step
        self.views = ViewsInTurn(scene, device, t.seed + 2, exposure=t.exposure, per_step=per_step)
        self.world_offset = world_offset(scene) if start is None else start.world_offset
        scene = self.scene = local_scene(scene, self.world_offset)
        self.config = config
        self.device = device
        self.phase = phase
        self.method = method
        self.hooks = (hooks or Hooks()).to(device)
        splats = (
            initial_splats(scene.points, config.splats)
            if start is None
            else of_degree(Splats.of(start.splats), config.splats.harmonics)
        )
        self.parameters = SplatParameters(splats.to(device))
        self.optimizer = make_splat_optimizer(self.parameters, config.splats, scene.extent, per_step)
        self.schedule = densify_schedule(config.splats, t.steps, len(scene.train_views), per_step)
        self.control = DensityControl(config.splats, scene.extent, len(self.parameters), device)
        self.chance = torch.Generator(device).manual_seed(t.seed + 1)  # of splits
        self.settings = RasterSettings(background=scene.background)
        self.step = 0

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
        results = [self.learn_from(view) for view in mine(views)]
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
        self.backward(loss, drawn.rendered, drawn.gaussians)
        self.observe(drawn.rendered, drawn.camera)
        return StepResult(loss.detach(), drawn.rendered.image.detach(), drawn.photograph)

    @property
    def progress(self) -> float:
        """Return the fraction of this phase that is done, 0 to 1."""
        return self.step / self.config.training.steps

    def draw(self, index: int) -> Drawn:
        """A training view as the hooks want it looked at."""
        photograph = self.views.photograph(index)
        camera, photograph = self.hooks.view(self.scene.train_views[index].camera, photograph, self)
        splats = self.hooks.transform(self.parameters.splats(), self)
        gaussians = self.activate(splats, self.inside(splats, camera), camera)
        return Drawn(camera, photograph, splats, gaussians, self.rasterize(gaussians, camera))

    def inside(self, splats: Splats, camera: Camera) -> Tensor:
        """[M] bool: splats that may be in the image."""
        return visible_mask(splats.means.detach(), splat_radii(splats), camera, self.settings)

    def activate(self, splats: Splats, inside: Tensor, camera: Camera) -> Gaussians:
        return splat_gaussians(splats, camera, self.degree(), inside)

    def rasterize(self, gaussians: Gaussians, camera: Camera) -> RasterResult:
        return rasterize_step(gaussians, camera, self.settings, watched=self.schedule.active(self.step))

    def compare(self, drawn: Drawn) -> Tensor:
        loss = photometric_loss(drawn.rendered.image, drawn.photograph, self.config.training.ssim_weight)
        added = self.hooks.loss(drawn, self)
        return loss if added is None else loss + added

    def backward(self, loss: Tensor, rendered: RasterResult, gaussians: Gaussians) -> None:
        """Compute the gradients. The arguments are the tensors at which a profile takes the time (`stations`)."""
        loss.backward()

    def update(self, views: Sequence[int], loss: Tensor) -> None:
        """Adam's step after these views. Over the ranks gradients are summed, and the `loss` [], which becomes that of
        all views.
        """
        exposures = self.views.exposure_gradients(views)
        sum_gradients(parameters_of(self.optimizer), loss, *exposures)
        set_learning_rates(self.optimizer, self.progress, self.learning_rate)
        self.optimizer.step()
        self.optimizer.zero_grad(set_to_none=True)
        self.views.learn(self.progress, views, exposures)

    def learning_rate(self, first: float, last: float, progress: float) -> float:
        """Return the learning rate of a group, at some progress of the phase."""
        return exponential_decay(first, last * self.hooks.slowing, progress)

    def observe(self, rendered: RasterResult, camera: Camera) -> None:
        if self.schedule.active(self.step) and rendered.means2d.grad is not None:
            self.control.observe(rendered.means2d.grad, rendered.visible, camera)

    def control_density(self) -> None:
        """What the schedule asks for after so many steps."""
        if self.schedule.due(self.step):
            large = self.step > self.schedule.reset_every
            with whole(self.control, DensityControl.STATISTICS):
                kept, added, origins = self.control.chosen(
                    self.parameters.trained(), self.as_drawn(), self.chance, remove_large=large
                )
                self.replace(kept, added, origins)
                self.control.forget(len(self.parameters))
            self.hooks.densified(self)
            self.check_ranks()
        if self.schedule.reset_due(self.step):
            reset_opacities(self.parameters, self.optimizer, self.config.splats.reset_opacity)

    def check_ranks(self) -> None:
        """Raises TrainingError if the ranks of a torchrun have come to hold different splats."""
        own = {HOOKS + name: value for name, value in hook_state(self.hooks).items()}
        check_identical(self.step, {**self.named_parameters(), **own})

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

    def run(
        self,
        path: Path | None,
        on_progress: Callable[[TrainingStatus], None] | None,
        watch: Watch | None = None,
    ) -> None:
        """All remaining steps; a checkpoint at `path` every few minutes, at the end, and when interrupted."""
        check_points_seen(self.scene, self.settings.near_plane)
        self.check_ranks()
        run_to_end(self, self.config.training, path, on_progress, watch)

    def estimated_bytes(self) -> int:
        """Size of the method's file if it were written now; of a .ply file without its header."""
        known = self.hooks.estimated_bytes(self)
        if known is not None:
            return known
        return 4 * len(self.parameters) * (STORED_NUMBERS + self.parameters.rest[0].numel())

    def finish(self) -> None:
        """Plain 3DGS has nothing left to do: the file holds the splats as they are."""
        self.hooks.finish(self)

    def camera_at(self, step: int, divisor: int = 1) -> Camera:
        """Return the camera of a usual training view, as large as a step looks at it."""
        camera = usual_camera([view.camera for view in self.scene.train_views], divisor)
        return self.hooks.sized(camera, step / self.config.training.steps)

    def snapshot(self) -> SplatModel:
        """Return the splats before any `transform`, for which a hook may draw random numbers."""
        return self.model()

    def model(self) -> SplatModel:
        """The splats of now, before any `transform`."""
        arrays = self.parameters.trained().arrays(self.world_offset)
        return placed(SplatModel(arrays, self.scene.background), self.device)

    # checkpoints ---------------------------------------------------------------------------------------------------

    def save(self, path: Path | None, writer: Writer | None = None) -> None:
        with whole(self.control, DensityControl.STATISTICS):
            if path is not None:
                self.write(path, writer)

    def write(self, path: Path, writer: Writer | None) -> None:
        memory = self.memory
        tensors = {f"model/{name}": p for name, p in vars(self.parameters.trained()).items()}
        tensors |= {f"optimizer/{name}": value for name, value in memory.moments().items()}
        tensors |= {f"extra/{name}": value for name, value in memory.tensors().items()}
        tensors |= {f"extra/{HOOKS}{name}": value for name, value in hook_state(self.hooks).items()}
        place = {"step": self.step, "phase": self.phase, "world_offset": self.world_offset}
        metadata = {
            "config": json.dumps(self.config.to_dict()),
            "state": json.dumps({**place, **memory.state()}),
        }
        write_checkpoint_file(path, self.method, tensors, metadata, writer, device=self.device)

    @property
    def memory(self) -> Memory:
        """What the run remembers between two steps, but for the splats, the hooks and the step."""
        statistics = Statistics(self.control, DensityControl.STATISTICS)
        parts = (statistics, Chance(self.chance), self.views)
        return Memory(self.named_parameters, self.optimizer, parts)

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
        tensors, metadata = read_checkpoint_file(path, method, device)
        with restoring(path):
            state = json.loads(metadata["state"])
            saved = config_from_dict(json.loads(metadata["config"]), str(path), type(config))
            check_same_run(saved, config, state["views"], scene)
            check_step(state, config.training.steps)
            parts = tensors_by_kind(tensors)
            x, y, z = finite(state.get("world_offset", [0.0] * 3), 3, "world_offset")  # older ones have none
            start = SplatModel(checked_splats(parts["model"]).arrays((x, y, z)), scene.background)
        trainer = cls(scene, config, device, start, hooks, phase=phase, method=method)
        with restoring(path):
            extra = parts["extra"]
            own = {name.removeprefix(HOOKS): v for name, v in extra.items() if name.startswith(HOOKS)}
            restore_hooks(trainer.hooks, own)
            trainer.train_hooks()
            trainer.memory.restore(parts["optimizer"], extra, state)
            trainer.step = state["step"]
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
