"""Training of such anchors without rate; methods add theirs (`training/run/loop.py` has the loop)."""

import json
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from compgs.cameras import Camera
from compgs.config import Config, config_from_dict
from compgs.errors import ConfigError
from compgs.gaussians import Gaussians
from compgs.losses import Target, photometric_loss, scale_regularizer, scale_unit
from compgs.methods.anchors.model import AnchorModel, control_settings, initial_anchors
from compgs.methods.anchors.prediction import AnchorValues, predict_anchors
from compgs.methods.anchors.scene import Frame
from compgs.render import RasterResult, RasterSettings, Renderable
from compgs.scene.points import COORDINATE_BITS
from compgs.scene.views import Scene
from compgs.scene.world import local_scene
from compgs.tensors.prediction import Prediction, camera_center
from compgs.tensors.visibility import visible_mask
from compgs.training.optimizers import ADAM_EPSILON, DECAYS, set_learning_rates
from compgs.training.run.checkpoint import (
    Writer,
    check_same_run,
    read_checkpoint_file,
    tensors_by_kind,
    write_checkpoint_file,
)
from compgs.training.run.distributed import world
from compgs.training.run.loop import Run, StepResult, rasterize_step, run_to_end
from compgs.training.run.parts import Chance, Memory, Statistics
from compgs.training.run.restoring import (
    check_step,
    check_tensor,
    check_tensors,
    finite,
    restoring,
)
from compgs.training.run.seen_points import check_points_seen
from compgs.training.shortcuts.coarse import usual_camera
from compgs.training.step.views_in_turn import ViewsInTurn
from compgs.training.structure.control import AdaptiveControl, make_schedule
from compgs.training.trainer import stations, vanishing_loss


class AnchorTrainer:
    """State of a run: model, optimizer, control, and the order in which views come, one a step.

        values ──predict──► Gaussians ──rasterize──► image ──compare, + added──► loss ──► step ──► finish_step

    A method says in a class of its own which model is trained (`kind_of_model`, with further parameters in
    `groups`), what `values` it is seen with, what is `added` to the loss, and what else is due after a step.
    """

    kind = "anchors"  # what a progress display counts
    kind_of_model: type[AnchorModel] = AnchorModel

    def __init__(
        self,
        scene: Scene,
        config: Config,
        device: torch.device,
        method: str,  # as the registry calls it; checkpoints say it
        model: AnchorModel | None = None,
    ) -> None:
        t = config.training
        if world() > 1 or t.views_per_step > 1:
            raise ConfigError(
                f"method {method} trains in one process, with one view a step; found {world()} and "
                f"{t.views_per_step}: start it without torchrun, and without training.views_per_step"
            )
        self.views = ViewsInTurn(scene, device, t.seed + 2, exposure=t.exposure)
        self.config = config
        self.device = device
        self.method = method
        self.model = (model or initial_anchors(self.kind_of_model, scene, config)).to(device)
        self.scene = local_scene(scene, self.model.frame.world_offset)
        groups = [{"name": n, "params": p, "lr": r[0], "rates": r} for n, (p, r) in self.groups().items()]
        self.optimizer = torch.optim.Adam(groups, lr=1e-3, eps=ADAM_EPSILON, fused=True)
        self.schedule = make_schedule(config.control, t.steps, len(scene.train_views))
        shape = self.model.anchors, config.model.coupled_primitives
        self.control = AdaptiveControl(control_settings(config), self.schedule, shape, device)
        self.chance = torch.Generator(device).manual_seed(t.seed + 1)  # of growth
        self.settings = RasterSettings(background=scene.background)
        self.step = 0

    def groups(self) -> dict[str, tuple[list[Tensor], tuple[float, float]]]:
        """Parameters with their first and last learning rate, by a name."""
        m, t, own = self.model, self.config.training, getattr(self.config, "anchors")  # noqa: B009
        networks = {"opacity": t.opacity_lr, "color": t.color_lr, "covariance": t.covariance_lr}
        return {
            "features": ([m.features], own.feature_lr),
            "offsets": ([m.offsets], own.offset_lr),
            "log_scales": ([m.log_scales], t.log_scale_lr),
            **{name: (list(m.networks.of(name)), rates) for name, rates in networks.items()},
        }

    @property
    def progress(self) -> float:
        """Return the fraction of the run that is done, 0 to 1."""
        return self.step / self.config.training.steps

    @property
    def primitives(self) -> int:
        return self.model.anchors

    @property
    def lmbda(self) -> float | None:
        """Weight of the rate, where there is one."""
        return None

    # one step ------------------------------------------------------------------------------------------------------

    def train_step(self) -> StepResult:
        """Predict, rasterize, compare, pull; then grow and prune."""
        (index,) = self.views.next()
        camera, photograph = self.scene.train_views[index].camera, self.views.photograph(index)
        values = self.values()
        rows = self.visible_anchors(values, camera)
        if len(rows) == 0:
            return self.skip(photograph)
        prediction = self.predict(values.rows(rows), camera)
        rendered = self.rasterize(prediction.gaussians, camera)
        loss = self.compare(rendered, photograph) + self.regularize(prediction, camera)
        added = self.added()
        loss = loss if added is None else loss + added
        self.backward(loss, rendered, prediction.gaussians)
        self.update(index)
        self.observe(rows, prediction, rendered, camera)
        self.finish_step()
        return StepResult(loss.detach(), rendered.image.detach(), photograph)

    def values(self) -> AnchorValues:
        """All anchors as this step sees them."""
        return self.model.values()

    def added(self) -> Tensor | None:
        """[] to add to the loss of a step, after `values`; None: nothing."""
        return None

    def weights(self) -> dict[str, Tensor]:
        """Return the networks' weights, as this step computes with them."""
        return self.model.networks.weights()

    @torch.no_grad()
    def visible_anchors(self, values: AnchorValues, camera: Camera) -> Tensor:
        """[V] int64: anchors whose primitives may be in the image."""
        radii = values.radii(self.model.voxel_size)
        return torch.nonzero(visible_mask(values.positions, radii, camera, self.settings)).view(-1)

    def predict(self, values: AnchorValues, camera: Camera) -> Prediction:
        return predict_anchors(self.weights(), values, camera_center(camera, self.device), self.model.frame)

    def rasterize(self, gaussians: Gaussians, camera: Camera) -> RasterResult:
        return rasterize_step(gaussians, camera, self.settings, watched=self.schedule.active(self.step))

    def compare(self, rendered: RasterResult, target: Target) -> Tensor:
        return photometric_loss(rendered.image, target, self.config.training.ssim_weight)

    def regularize(self, prediction: Prediction, camera: Camera) -> Tensor:
        """Penalties on large primitives and on a vanishing scene."""
        gaussians = prediction.gaussians
        unit = scale_unit(gaussians.means, camera_center(camera, self.device), self.scene.extent)
        volumes = scale_regularizer(gaussians.scales / unit, prediction.drawn)
        return self.config.training.scale_weight * volumes + self.vanishing(prediction)

    def vanishing(self, prediction: Prediction) -> Tensor | float:
        """Keeps a scene of which hardly anything is drawn from vanishing."""
        return vanishing_loss(prediction)

    def backward(self, loss: Tensor, rendered: RasterResult, gaussians: Gaussians) -> None:
        """Compute the gradients. The arguments are the tensors at which a profile takes the time (`stations`)."""
        loss.backward()

    def update(self, view: int) -> None:
        t = self.config.training
        exposures = self.views.exposure_gradients([view])
        set_learning_rates(self.optimizer, self.progress, DECAYS[t.schedule], t.head_warm_up)
        self.optimizer.step()
        self.optimizer.zero_grad(set_to_none=True)
        self.views.learn(self.progress, [view], exposures)

    def observe(self, rows: Tensor, prediction: Prediction, rendered: RasterResult, camera: Camera) -> None:
        """The statistics that growth and pruning go by."""
        if self.schedule.active(self.step) and rendered.means2d.grad is not None:
            self.control.observe(rows, prediction, rendered.means2d.grad, camera)

    def finish_step(self) -> None:
        """Whatever is due after this step."""
        if self.schedule.due(self.step):
            with torch.no_grad():
                means = self.model.values().means(self.model.voxel_size)
            self.control.act(self.model, self.optimizer, means, self.chance, 0.0)
        self.step += 1

    def skip(self, photograph: Target) -> StepResult:
        """A step on a view that no anchor is in: nothing can be learned from it."""
        self.finish_step()
        background = torch.tensor(self.scene.background, device=self.device)
        return StepResult(torch.zeros(()), background.expand(*photograph.image.shape), photograph)

    # the run -------------------------------------------------------------------------------------------------------

    def run(self, run: Run) -> None:
        """All remaining steps."""
        check_points_seen(self.scene, self.settings.near_plane)
        run_to_end(self, self.config.training, run.checkpoint, run.on_progress, run.watch)

    def camera_at(self, step: int, divisor: int = 1) -> Camera:
        """Return the camera of a usual training view, as large as a step looks at it."""
        camera = usual_camera([view.camera for view in self.scene.train_views], divisor)
        return camera

    def snapshot(self) -> Renderable:
        return self.model.as_hybrid_model()

    def estimated_bytes(self) -> int:
        """Count the bytes of all numbers in single precision."""
        return 4 * sum(p.numel() for p in self.model.parameters())

    def finish(self) -> None:
        """Nothing is left to do."""

    # checkpoints ---------------------------------------------------------------------------------------------------

    def save(self, path: Path | None, writer: Writer | None = None) -> None:
        assert path is not None, "it trains in one process"
        memory = self.memory
        tensors = {f"model/{name}": value for name, value in self.model.state_dict().items()}
        tensors |= {f"optimizer/{name}": value for name, value in memory.moments().items()}
        tensors |= {f"extra/{name}": value for name, value in memory.tensors().items()}
        state = {"step": self.step, **memory.state(), **self.more_state()}
        frame = {name: value for name, value in vars(self.model.frame).items()}
        metadata = {
            "config": json.dumps(self.config.to_dict()),
            "frame": json.dumps(frame),
            "state": json.dumps(state),
        }
        write_checkpoint_file(path, self.method, tensors, metadata, writer, device=self.device)

    @property
    def memory(self) -> Memory:
        """What the run remembers between two steps, but for the model and the step."""
        statistics = Statistics(self.control, AdaptiveControl.STATISTICS)
        parts = (statistics, Chance(self.chance), self.views)
        return Memory(lambda: dict(self.model.named_parameters()), self.optimizer, parts)

    def more_state(self) -> dict[str, Any]:
        """What else a checkpoint says, as JSON takes it."""
        return {}

    def restore_state(self, state: dict[str, Any]) -> None:
        """Inverse of `more_state`. Raises ValueError and the like."""

    @classmethod
    def resumed(
        cls, scene: Scene, path: Path, config: Config, device: torch.device, method: str
    ) -> "AnchorTrainer":
        """Raises CheckpointError if there is no checkpoint, or the run was another scene's or had other settings."""
        tensors, metadata = read_checkpoint_file(path, method, device)
        with restoring(path):
            state = json.loads(metadata["state"])
            saved = config_from_dict(json.loads(metadata["config"]), str(path), type(config))
            check_same_run(saved, config, state["views"], scene)
            check_step(state, config.training.steps)
            parts = tensors_by_kind(tensors)
            model = cls._model(config, json.loads(metadata["frame"]), parts["model"])
        trainer = cls(scene, config, device, method, model)
        with restoring(path):
            trainer.memory.restore(parts["optimizer"], parts["extra"], state)
            trainer.restore_state(state)
            trainer.step = state["step"]
        return trainer

    @classmethod
    def _model(cls, config: Config, frame: dict[str, Any], tensors: dict[str, Tensor]) -> AnchorModel:
        """Raises ValueError and the like for what does not belong together."""
        coordinates = tensors["coordinates"]
        check_tensor(coordinates, (len(coordinates), 3), torch.int32, "coordinates")
        if len(coordinates) == 0 or coordinates.abs().max() >= 1 << (COORDINATE_BITS - 1):
            raise ValueError(
                f"{len(coordinates)} anchors, expected some, at coordinates of {COORDINATE_BITS} bits"
            )
        if len(tensors["features"]) != len(coordinates):  # before as much memory is taken
            raise ValueError(f"features of {len(tensors['features'])} anchors, expected {len(coordinates)}")
        (voxel_size, unit) = finite([frame["voxel_size"], frame["distance_unit"]], 2, "units", above=0.0)
        red, green, blue = finite(frame["background"], 3, "background")
        x, y, z = finite(frame["world_offset"], 3, "world_offset")
        model = cls.kind_of_model(config, coordinates, Frame(voxel_size, unit, (red, green, blue), (x, y, z)))
        check_tensors(tensors, model.state_dict(), "model")
        model.load_state_dict(tensors)
        return model


def train_anchors(kind: type[AnchorTrainer], scene: Scene, config: Config, run: Run) -> Any:
    """The model after the last step, of the kind that the trainer has. Raises CheckpointError, OutputError,
    TrainingError.
    """
    if run.earlier:
        trainer = kind.resumed(scene, run.earlier, config, run.device, run.method)
    else:
        trainer = kind(scene, config, run.device, run.method)
    if run.profile is not None:
        run.profile.watch(trainer, PARTS, stations)
    trainer.run(run)
    return trainer.model


# What a profile calls the parts of a step.
PARTS = {
    "values": "quantization and entropy",
    "visible_anchors": "culling",
    "predict": "prediction",
    "rasterize": "projection and rasterization",
    "compare": "loss",
    "regularize": "loss",
    "added": "quantization and entropy",
    "backward": "prediction and entropy, backward",
    "update": "optimizer",
    "observe": "control",
    "finish_step": "control",
}
