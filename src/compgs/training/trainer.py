"""Rate-distortion optimization of one scene (CompGS Sec. 3.4): a loop that one reads aloud."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from compgs.cameras import Camera
from compgs.config import Config
from compgs.entropy.quantization import UniformNoise
from compgs.losses import rate_distortion_loss
from compgs.model.hybrid_model import HybridModel
from compgs.render import RasterSettings
from compgs.scene.views import Scene
from compgs.scene.world import local_scene
from compgs.trained_model import TrainedModel
from compgs.training.optimizers import make_optimizer
from compgs.training.plan import Plan
from compgs.training.rate.rate_control import RateState
from compgs.training.run.checkpoint import checkpoint_of
from compgs.training.run.distributed import share_of_rank
from compgs.training.run.model_checkpoint import METHOD, described, model_of
from compgs.training.run.parts import Part
from compgs.training.run.scene_trainer import SceneTrainer
from compgs.training.run.status import StepResult, nothing_shown
from compgs.training.shortcuts.coarse import CoarseViews
from compgs.training.shortcuts.hidden import HiddenAnchors
from compgs.training.start import initial_model, plan_of
from compgs.training.step.latents import StepLatents
from compgs.training.step.moment import Moment, moment
from compgs.training.step.pictures import Pictures
from compgs.training.step.profiled import PARTS, stations
from compgs.training.step.step_views import StepViews, step_views
from compgs.training.step.view_gradients import ViewGradients
from compgs.training.structure.control import AdaptiveControl, make_schedule
from compgs.training.structure.events import Structure
from compgs.training.survey import Survey


class Trainer(SceneTrainer):
    """State of a run: model, optimizer, adaptive control, and the order in which views come."""

    kind = "anchors"
    PROFILED = PARTS
    stations = staticmethod(stations)

    def __init__(
        self,
        scene: Scene,
        config: Config,
        device: torch.device,
        model: TrainedModel | None = None,
        planned: Plan | None = None,  # of the capture, of which the scene is a tile
    ) -> None:
        super().__init__(scene, config, device, METHOD)
        t, views = config.training, len(scene.train_views)
        model = (model or initial_model(scene, config, device, planned)).to(device)
        self.model = self.trained = model
        scene = self.scene = local_scene(scene, model.world_offset)
        plan = self.plan = plan_of(model, scene, device)
        if plan.poses:
            self.views.learn_poses()
        self.settings = RasterSettings(background=scene.background, angular_dilation=model.angular_dilation)
        self.survey = Survey(model, scene, self.settings, lambda: self.step)
        self.optimizer = make_optimizer(model, t)
        self.schedule = make_schedule(config.control, t.steps, views, t.views_per_step)
        self.hidden = HiddenAnchors(plan.passed_over, views, self.survey.shape, device)
        follow = (self.hidden.replaced,)
        self.control = AdaptiveControl(config, self.schedule, self.survey.shape, device, follow)
        self.noise = UniformNoise(t.seed + 3, self.views.chance, device)
        self.rate = RateState(t.lmbda)
        self.coarse = CoarseViews(self.views, plan.coarse_until)
        self.pictures = Pictures(self.settings, t.ssim_weight)
        self.latents = StepLatents(model, t.rate)
        seen = self.pictures, self.coarse, self.hidden, self.control
        self.gradients = ViewGradients(model, scene, t, plan, *seen)
        tools = self.optimizer, self.survey, self.control, self.chance
        self.structure = Structure(config, plan, model, *tools)

    # one step ------------------------------------------------------------------------------------------------------

    def train_step(self) -> StepResult:
        """Quantize, predict, rasterize, compare (the paper's Fig. 2 from left to right), go back; then move."""
        now = self.now
        views = self.views_of_step(now)
        if len(views.seen.rows) == 0:  # nothing can be learned from views that no anchor is in
            self.finish_step()
            return self.nothing_shown(views)
        result = self.learn(views, now)
        loss = result.loss.clone()
        self.update(views.views, loss)
        self.finish_step()
        return replace(result, loss=loss / len(views.views))

    @property
    def now(self) -> Moment:
        """What the phases of the run ask of the step that comes next."""
        return moment(self.step, self.rate.lmbda, self.config.training, self.plan, watched=self.watched)

    def views_of_step(self, now: Moment) -> StepViews:
        """Choose the views of this step, and the anchors that they may show. The rate is of all of these; steps without
        it pass over those that were hidden.
        """
        views = self.views.next()
        rows = [self.survey.visible_anchors(self.scene.train_views[view].camera) for view in views]
        if now.passes_over:
            rows = [self.hidden.others(view, of_view) for view, of_view in zip(views, rows, strict=True)]
        return step_views(views, rows, self.model.anchors, self.noise)

    def learn(self, views: StepViews, now: Moment) -> StepResult:
        """Gradients of this rank's views; the loss is the sum over them, the image that of the last."""
        if len(views.own.rows) == 0:
            return self.nothing_shown(views)
        latents = self.latents.quantize(views, now)
        shown = latents.cut()
        results = self.gradients.learn(shown, views, now)
        rate = self.latents.rate_of(latents, views, now)
        self.latents.backward_latents(latents, shown, rate, now.lmbda)
        self.latents.learn_neighbours(latents, views)
        loss = torch.stack([result.loss for result in results]).sum()
        if rate is not None and now.lmbda > 0:
            loss = rate_distortion_loss(loss, rate.detach(), now.lmbda)
        return replace(results[-1], loss=loss)

    def nothing_shown(self, views: StepViews) -> StepResult:
        """The result of a step of which this rank sees nothing but background."""
        last = share_of_rank(views.views)[-1]
        return nothing_shown(self.views.photograph(last), self.scene.background, self.device)

    def move(self) -> None:
        """Adam's step; each channel of the references by its own rate."""
        with self.structure.channel_rates.applied():
            self.optimizer.step()

    def finish_step(self) -> None:
        """Do whatever is due after this step."""
        if self.structure.act(self.step, self.rate):
            self.check_ranks()
        self.step += 1
        self.rate = self.structure.follow(self.step, self.rate, stored=self.now.stored)

    def skip_steps(self, steps: int) -> None:
        """Go on by so many steps without learning in them; what is due after each is done."""
        for _ in range(steps):
            self.finish_step()

    def finish(self) -> None:
        """End the run with the mean of its last steps, without what no training view shows."""
        self.structure.finish()

    # what others ask, checkpoints above all ------------------------------------------------------------------------

    @property
    def primitives(self) -> int:
        return self.model.anchors

    @property
    def lmbda(self) -> float:
        return self.rate.lmbda

    def camera_at(self, step: int, divisor: int = 1) -> Camera:
        """Return the camera of a usual training view, as large as a step looks at it, with sides divided by so much."""
        return self.coarse.sized(super().camera_at(step, divisor), step / self.config.training.steps)

    def snapshot(self) -> HybridModel:
        """What the file would hold of the scene now; the end of the run takes means, and removes primitives."""
        return self.model.as_hybrid_model(stored_weights=self.now.stored)

    def estimated_bytes(self) -> int:
        """Size of the file if it were written now. Raises TrainingError if the latents are not finite any more."""
        return self.structure.target_size.estimated_bytes(self.rate.written, self.step)

    def held_in_common(self) -> dict[str, Tensor]:
        return {**self.model.state_dict(), "lambda": torch.tensor(self.rate.lmbda, dtype=torch.float64)}

    def described(self) -> dict[str, Any]:
        return described(self.model, self.plan)

    def state(self) -> dict[str, Any]:
        return {"rate": asdict(self.rate)}

    def restore_state(self, state: Mapping[str, Any]) -> None:
        self.rate = RateState.restored(state["rate"])

    def parts(self) -> Sequence[Part]:
        return (*self.structure.parts(), self.survey.bounds, self.hidden)

    @classmethod
    def resumed(cls, scene: Scene, path: Path, config: Config, device: torch.device) -> "Trainer":
        """Raises CheckpointError if there is no checkpoint, or the run was another scene's, or had other settings or
        another device.
        """
        saved = checkpoint_of(path, METHOD, config, scene, device)
        trainer = cls(scene, config, device, model_of(path, saved))
        trainer.go_on(path, saved)
        return trainer
