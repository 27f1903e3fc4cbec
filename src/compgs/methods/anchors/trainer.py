"""Training of such anchors without rate; methods add theirs (`training/run/loop.py` has the loop)."""

from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from compgs.cameras import Camera
from compgs.config import Config
from compgs.errors import ConfigError
from compgs.losses import SSIM_WEIGHT
from compgs.methods.anchors.model import AnchorModel, control_settings, initial_anchors
from compgs.methods.anchors.prediction import AnchorValues, predict_anchors
from compgs.published.anchors import Frame
from compgs.render import RasterResult, RasterSettings, Renderable
from compgs.scene.points import COORDINATE_BITS
from compgs.scene.views import Scene
from compgs.scene.world import local_scene
from compgs.tensors.prediction import Prediction, camera_center
from compgs.tensors.visibility import visible_mask
from compgs.training.optimizers import ADAM_EPSILON
from compgs.training.run.checkpoint import checkpoint_of
from compgs.training.run.distributed import world
from compgs.training.run.restoring import check_tensor, check_tensors, finite, restoring
from compgs.training.run.run import Run
from compgs.training.run.scene_trainer import SceneTrainer
from compgs.training.run.status import StepResult, nothing_shown
from compgs.training.step.pictures import Pictures, vanishing_loss, volume_loss
from compgs.training.step.profiled import stations
from compgs.training.structure.control import AdaptiveControl, make_schedule

# What a profile calls the parts of a step: methods of the trainer and of what it has.
PARTS = {
    "values": "quantization and entropy",
    "visible_anchors": "culling",
    "predict": "prediction",
    "pictures.rasterize": "projection and rasterization",
    "pictures.compare": "loss",
    "regularize": "loss",
    "added": "quantization and entropy",
    "pictures.backward": "prediction and entropy, backward",
    "update": "optimizer",
    "observe": "control",
    "finish_step": "control",
}


class AnchorTrainer(SceneTrainer):
    """State of a run: model, optimizer, control, and the order in which views come, one a step.

        values ──predict──► Gaussians ──rasterize──► image ──compare, + added──► loss ──► step ──► finish_step

    A method says in a class of its own which model is trained (`kind_of_model`, with further parameters in
    `groups`), what `values` it is seen with, what is `added` to the loss, and what else is due after a step.
    """

    kind = "anchors"
    PROFILED = PARTS
    stations = staticmethod(stations)
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
        super().__init__(scene, config, device, method)
        if t.learns_poses(in_doubt=bool(scene.poses_in_doubt)):
            self.views.learn_poses()
        self.model = self.trained = (model or initial_anchors(self.kind_of_model, scene, config)).to(device)
        self.scene = local_scene(scene, self.model.frame.world_offset)
        groups = [{"name": n, "params": p, "lr": r[0], "rates": r} for n, (p, r) in self.groups().items()]
        self.optimizer = torch.optim.Adam(groups, lr=1e-3, eps=ADAM_EPSILON, fused=True)
        self.schedule = make_schedule(config.control, t.steps, len(scene.train_views))
        shape = self.model.anchors, config.model.coupled_primitives
        self.control = AdaptiveControl(control_settings(config), self.schedule, shape, device)
        self.settings = RasterSettings(background=scene.background)
        self.pictures = Pictures(self.settings, SSIM_WEIGHT)

    def groups(self) -> dict[str, tuple[list[Tensor], tuple[float, float]]]:
        """Parameters with their first and last learning rate, by a name."""
        m, t, own = self.model, self.config.training, getattr(self.config, "anchors")  # noqa: B009
        networks = {"opacity": own.opacity_lr, "color": own.color_lr, "covariance": own.covariance_lr}
        return {
            "features": ([m.features], own.feature_lr),
            "offsets": ([m.offsets], own.offset_lr),
            "log_scales": ([m.log_scales], t.log_scale_lr),
            **{name: (list(m.networks.of(name)), rates) for name, rates in networks.items()},
        }

    @property
    def primitives(self) -> int:
        return self.model.anchors

    # one step ------------------------------------------------------------------------------------------------------

    def train_step(self) -> StepResult:
        """Predict, rasterize, compare, pull; then grow and prune."""
        (index,) = self.views.next()
        camera, photograph = self.scene.train_views[index].camera, self.views.photograph(index)
        values = self.values()
        rows = self.visible_anchors(values, camera)
        if len(rows) == 0:
            self.finish_step()
            return nothing_shown(photograph, self.scene.background, self.device)
        prediction = self.predict(values.rows(rows), camera)
        posed = self.views.posed(index, prediction.gaussians, camera)
        rendered = self.pictures.rasterize(posed, camera, watched=self.watched)
        photograph = self.views.trusted(index, rendered.image, photograph)
        loss = self.pictures.compare(rendered, photograph) + self.regularize(prediction, camera)
        added = self.added()
        loss = loss if added is None else loss + added
        self.pictures.backward(loss, rendered, prediction.gaussians)
        self.update([index], loss.detach())
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

    def regularize(self, prediction: Prediction, camera: Camera) -> Tensor:
        """Penalties on large primitives and on a vanishing scene."""
        volumes = volume_loss(prediction, prediction.gaussians, camera, self.scene.extent)
        return self.config.training.scale_weight * volumes + self.vanishing(prediction)

    def vanishing(self, prediction: Prediction) -> Tensor | float:
        """Keeps a scene of which hardly anything is drawn from vanishing."""
        return vanishing_loss(prediction)

    def observe(self, rows: Tensor, prediction: Prediction, rendered: RasterResult, camera: Camera) -> None:
        """The statistics that growth and pruning go by."""
        if self.watched and rendered.means2d.grad is not None:
            self.control.observe(rows, prediction, rendered.means2d.grad, camera)

    def finish_step(self) -> None:
        """Whatever is due after this step."""
        if self.schedule.due(self.step):
            with torch.no_grad():
                means = self.model.values().means(self.model.voxel_size)
            self.control.act(self.model, self.optimizer, means, self.chance, 0.0)
        self.step += 1

    # what others ask -----------------------------------------------------------------------------------------------

    def snapshot(self) -> Renderable:
        return self.model.as_hybrid_model()

    def estimated_bytes(self) -> int:
        """Count the bytes of all numbers in single precision."""
        return 4 * sum(p.numel() for p in self.model.parameters())

    def described(self) -> dict[str, Any]:
        return {"frame": dict(vars(self.model.frame))}

    @classmethod
    def resumed(
        cls, scene: Scene, path: Path, config: Config, device: torch.device, method: str
    ) -> "AnchorTrainer":
        """Raises CheckpointError if there is no checkpoint, or the run was another scene's or had other settings."""
        saved = checkpoint_of(path, method, config, scene, device)
        with restoring(path):
            model = cls._model(config, saved.described["frame"], saved.model)
        trainer = cls(scene, config, device, method, model)
        trainer.go_on(path, saved)
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
    trainer.carry_out(run)
    return trainer.model
