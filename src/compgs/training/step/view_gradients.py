"""Gradients of a step's views by the latents that they are predicted from, the heads and what is learned of the views.

latents ──predict──► Gaussians ──rasterize──► image ──compare, + volume──► loss ──► gradients
"""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import torch
from torch import Tensor

from compgs.cameras import Camera
from compgs.config import TrainingConfig
from compgs.entropy import Quantized
from compgs.gaussians import Gaussians
from compgs.render import RasterResult
from compgs.scene.views import Scene
from compgs.tensors.prediction import Geometry, Prediction, geometry_of_all
from compgs.trained_model import TrainedModel
from compgs.training.plan import Plan
from compgs.training.run.status import StepResult
from compgs.training.shortcuts.coarse import CoarseViews
from compgs.training.shortcuts.hidden import HiddenAnchors
from compgs.training.step.dropout import thinned
from compgs.training.step.latents import pass_gradients_back
from compgs.training.step.moment import Moment
from compgs.training.step.pictures import Pictures, vanishing_loss, volume_loss
from compgs.training.step.step_views import Noise, StepViews
from compgs.training.structure.control import AdaptiveControl
from compgs.training.survey import predict_view


@dataclass(eq=False)
class ViewGradients:
    """What a step learns from its views."""

    model: TrainedModel
    scene: Scene  # in the model's local frame
    training: TrainingConfig
    plan: Plan
    pictures: Pictures
    coarse: CoarseViews
    hidden: HiddenAnchors
    control: AdaptiveControl

    def learn(self, shown: Quantized, views: StepViews, now: Moment) -> list[StepResult]:
        """Compute the gradients of this rank's views, by latents that were cut from their graph."""
        with self.model.weights_at_rest(), self.shared_geometry(shown, views, now) as geometry:
            return [self.learn_from(shown, geometry, views, number, now) for number in views.own.numbers]

    @contextmanager
    def shared_geometry(self, shown: Quantized, views: StepViews, now: Moment) -> Iterator[Geometry | None]:
        """Where several views are looked at: the geometry of their primitives, predicted once. After them its gradients
        go on to the latents and the heads. A single view predicts that of what it shows.
        """
        if len(views.own.numbers) == 1:
            yield None
            return
        geometry = self.predict_shared(shown, views.own.rows, now)
        cut = geometry.cut()
        yield cut
        pass_gradients_back(geometry.tensors(), cut.tensors())

    def predict_shared(self, shown: Quantized, rows: Tensor, now: Moment) -> Geometry:
        """Predict the geometry of all primitives of the anchors in `rows` [U] int64."""
        heads, primitives = self.model.heads, self.model.primitives(shown, rows)
        if not now.stored:
            return geometry_of_all(heads, primitives)
        weights = self.model.stored_head_weights()
        found: Geometry = torch.func.functional_call(heads, weights, (geometry_of_all, primitives))
        return found

    def learn_from(
        self, shown: Quantized, geometry: Geometry | None, views: StepViews, number: int, now: Moment
    ) -> StepResult:
        """Compute the gradients of one of the views by the latents, the heads and what is learned of it."""
        view, part = views.views[number], views.own.part_of(number)
        camera, photograph = self.coarse.look(view, self.scene.train_views[view].camera, now.progress)
        rows = views.own.rows_of(number)
        if geometry is not None:
            geometry = geometry.of(None if part is None else self.model.slots(part))
        noise = views.noise_of_view(number)
        prediction, gaussians = self.predict(shown.of(part), rows, camera, now, noise, geometry)
        gaussians, sizes = self.hidden.measured(gaussians)
        learned = self.coarse.views
        rendered = self.pictures.rasterize(
            learned.posed(view, gaussians, camera), camera, watched=now.watched
        )
        photograph = learned.trusted(view, rendered.image, photograph)
        loss = self.pictures.compare(rendered, photograph) + self.regularize(prediction, gaussians, camera)
        self.pictures.backward(loss, rendered, gaussians)
        self.observe(rows, prediction, rendered, camera, now)
        self.hidden.observe(view, rows, prediction, gaussians, sizes)
        return StepResult(loss.detach(), rendered.image.detach(), photograph)

    def predict(
        self,
        latents: Quantized,
        rows: Tensor,
        camera: Camera,
        now: Moment,
        noise: Noise,
        geometry: Geometry | None,
    ) -> tuple[Prediction, Gaussians]:
        """What the view may show (Sec. 3.2), and its Gaussians without those that chance leaves out of this step."""
        prediction = predict_view(self.model, latents, rows, camera, stored=now.stored, geometry=geometry)
        return prediction, thinned(prediction, self.plan.dropout, noise)

    def regularize(self, prediction: Prediction, gaussians: Gaussians, camera: Camera) -> Tensor:
        """[] the part of the distortion beside the image's: penalties on large primitives and on a vanishing scene."""
        volumes = volume_loss(prediction, gaussians, camera, self.scene.extent)
        return self.training.scale_weight * volumes + vanishing_loss(prediction)

    def observe(
        self, rows: Tensor, prediction: Prediction, rendered: RasterResult, camera: Camera, now: Moment
    ) -> None:
        """Gather the statistics that growth goes by, where it watches the step."""
        if now.watched and rendered.means2d.grad is not None:
            self.control.observe(rows, prediction, rendered.means2d.grad, camera)
