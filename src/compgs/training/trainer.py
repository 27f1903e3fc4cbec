"""Rate-distortion optimization of one scene (CompGS Sec. 3.4): a loop short enough to read aloud."""

import math
from collections.abc import Callable, Iterator
from dataclasses import asdict
from pathlib import Path

import torch
from torch import Tensor

from compgs.cameras import Camera
from compgs.config import Config
from compgs.entropy import Quantized
from compgs.entropy.quantization import UniformNoise
from compgs.errors import TrainingError
from compgs.gaussians import Gaussians
from compgs.losses import (
    Target,
    photometric_loss,
    rate,
    rate_distortion_loss,
    revival_loss,
    scale_regularizer,
    scale_unit,
)
from compgs.model.hybrid_model import HybridModel
from compgs.render import RasterResult, RasterSettings
from compgs.scene import as_scene
from compgs.scene.views import Scene
from compgs.scene.world import local_scene
from compgs.tensors.prediction import (
    Prediction,
    camera_center,
    choosing_pays,
    predict,
    predict_geometry,
)
from compgs.tensors.visibility import visible_mask
from compgs.trained_model import TrainedModel
from compgs.training.checkpoint import (
    Checkpoint,
    check_same_run,
    load_checkpoint,
    optimizer_tensors,
    restore_optimizer,
    save_checkpoint,
)
from compgs.training.control import AdaptiveControl, make_schedule
from compgs.training.culling import MEASURED_AT_ONCE, AnchorBounds
from compgs.training.decorrelation import channel_rates, decorrelate, drop_silent_channels
from compgs.training.dropout import share_left_out, thinned
from compgs.training.events import Event, at_shares
from compgs.training.file_size import fixed_bytes, latent_bytes
from compgs.training.importance import LOOKED_AT, PRUNED_BY, missed, spread, view_contributions, worth_keeping
from compgs.training.initial import initial_model
from compgs.training.loop import (
    Run,
    StepResult,
    TrainingStatus,
    Watch,
    chosen_config,
    diverged,
    rasterize_step,
    run_to_end,
)
from compgs.training.optimizers import DECAYS, make_optimizer, set_learning_rates, step_rows
from compgs.training.profile import StepProfile
from compgs.training.rate_control import RateState
from compgs.training.restoring import check_tensor, restore_chance, restore_statistics, restoring
from compgs.training.seen_points import check_points_seen
from compgs.training.target_size import TargetSize, pruned_share
from compgs.training.views_in_turn import ViewsInTurn

METHOD = "compgs"
# With a smaller share of a view's primitives drawn, the scene is about to vanish: what is not drawn has no gradient.
FEW_DRAWN = 0.1


def train(
    scene: Scene | str | Path,
    config: Config | None = None,
    *,
    preset: str | None = None,
    output: str | Path | None = None,
    resume: bool = False,
    on_progress: Callable[[TrainingStatus], None] | None = None,
    device: str | torch.device | None = None,
    profile: StepProfile | None = None,
) -> TrainedModel:
    """Train a scene, or the one in a folder; the result is ready for `compgs.encode`.

    Settings are those of `config`, or of a preset, `default` if there is neither. With `output`, a folder, checkpoints
    are written there, also when the run is interrupted; `resume` continues from the last one exactly as if the run had
    not stopped (`compgs train --resume` cannot: it does not know how the scene was read). `profile` gathers where the
    time goes. Default device: CUDA where there is one.

    Raises ConfigError, CheckpointError, OutputError, and TrainingError when the optimization cannot go on.
    """
    config = chosen_config(config, preset)
    run = Run(METHOD, output=output, resume=resume, on_progress=on_progress, device=device, profile=profile)
    return train_hybrid(as_scene(scene), config, run)


def train_hybrid(scene: Scene, config: Config, run: Run) -> TrainedModel:
    """Train a scene, as `train` does. Raises as it does."""
    if run.earlier:
        trainer = Trainer.resumed(scene, run.earlier, config, run.device)
    else:
        trainer = Trainer(scene, config, run.device)
    if run.profile is not None:
        run.profile.watch(trainer, PARTS, stations)
    trainer.run(run.checkpoint, run.on_progress, run.watch)
    return trainer.model


class Trainer:
    """State of a run: model, optimizer, adaptive control, and the order in which views come."""

    kind = "anchors"  # what a progress display counts

    def __init__(
        self, scene: Scene, config: Config, device: torch.device, model: TrainedModel | None = None
    ) -> None:
        t, views = config.training, len(scene.train_views)
        self.views = ViewsInTurn(scene, device, t.seed + 2, exposure=t.exposure)
        self.config = config
        self.device = device
        self.model = (model or initial_model(scene, config)).to(device)
        self.scene = local_scene(scene, self.model.world_offset)
        self.optimizer = make_optimizer(self.model, t)
        self.schedule = make_schedule(config.control, t.steps, views)
        self.bounds = AnchorBounds(self.model, self.geometry)
        self.control = AdaptiveControl(config, self.schedule, self.model.anchors, device)
        self.chance = torch.Generator(device).manual_seed(t.seed + 1)  # of growth
        self.noise = UniformNoise(t.seed + 3, self.views.chance, device)
        self.reference_rates: Tensor | None = None  # [reference_dim], once the channels differ in it
        self.settings = RasterSettings(background=scene.background)
        self.left_out = share_left_out(views, t.left_out)
        self.step = 0
        self.rate = RateState(t.lmbda)
        self.decorrelated_at = at_shares(config.entropy.decorrelate_at, t.steps)
        pruned_at = at_shares(config.control.prune_at, t.steps)
        self.target_size = TargetSize(self.model, self.schedule, pruned_at, self.contributions)
        self.events = (
            Event(self.schedule.due, self.grow),
            Event(pruned_at.__contains__, self.prune),
            Event(self.decorrelated_at.__contains__, self.turn_references),
        )

    # one step ------------------------------------------------------------------------------------------------------

    def train_step(self) -> StepResult:
        """Quantize, predict, rasterize, compare, pull (the paper's Fig. 2 from left to right)."""
        index = self.views.next()
        camera, photograph = self.scene.train_views[index].camera, self.views.photograph(index)
        rows = self.visible_anchors(camera)
        if len(rows) == 0:
            return self.skip(photograph)
        latents = self.quantize(rows)
        prediction, gaussians = self.predict_some(latents, rows, camera)
        rendered = self.rasterize(gaussians, camera)
        distortion = self.compare(rendered, photograph) + self.regularize(prediction, gaussians, camera)
        loss = self.add_rate(distortion, latents)
        self.backward(loss, rendered, gaussians, latents)
        self.update(rows)
        self.observe(rows, prediction, rendered, camera)
        self.finish_step()
        return StepResult(loss.detach(), rendered.image.detach(), photograph)

    @property
    def progress(self) -> float:
        """Of the run, 0 to 1."""
        return self.step / self.config.training.steps

    @torch.no_grad()
    def visible_anchors(self, camera: Camera) -> Tensor:
        """[V] int64: anchors whose primitives may be in the image."""
        positions, radii = self.model.positions(), self.bounds.radii()
        return torch.nonzero(visible_mask(positions, radii, camera, self.settings)).view(-1)

    def quantize(self, rows: Tensor) -> Quantized:
        """Latents of the anchors in view as the decoder will have them, and their bits (Sec. 3.3)."""
        t = self.config.training
        return self.model.quantized(
            rows,
            rate=self.progress >= t.rate_start,
            noise=self.noise if self.progress < t.hard_rate else None,
            stored_weights=self.stored,
        )

    @property
    def stored(self) -> bool:
        """Whether this late in the run the networks compute with weights rounded as the file will hold them."""
        return self.progress >= self.config.training.quantized_weights

    def predict_some(self, latents: Quantized, rows: Tensor, camera: Camera) -> tuple[Prediction, Gaussians]:
        """What the view may show (Sec. 3.2), and its Gaussians without those that chance leaves out of this step."""
        prediction = self.predict(latents, rows, camera, self.stored)
        return prediction, thinned(prediction, self.left_out, self.noise)

    def predict(self, latents: Quantized, rows: Tensor, camera: Camera, stored: bool) -> Prediction:
        """On the GPU all primitives of the anchors in view: to choose among them the CPU would have to wait for it."""
        model = self.model
        return predict(
            model.heads,
            model.primitives(latents, rows),
            camera_center(camera, self.device),
            model.distance_unit,
            model.stored_head_weights() if stored else None,
            compact=choosing_pays(self.device),
            appearance_dtype=getattr(torch, self.config.training.appearance_dtype),
        )

    def rasterize(self, gaussians: Gaussians, camera: Camera) -> RasterResult:
        return rasterize_step(gaussians, camera, self.settings, watched=self.schedule.active(self.step))

    def compare(self, rendered: RasterResult, target: Target) -> Tensor:
        return photometric_loss(rendered.image, target, self.config.training.ssim_weight)

    def regularize(self, prediction: Prediction, gaussians: Gaussians, camera: Camera) -> Tensor:
        """The part of the distortion beside the image's: penalties on large primitives and on a vanishing scene."""
        unit = scale_unit(gaussians.means, camera_center(camera, self.device), self.scene.extent)
        volumes = scale_regularizer(gaussians.scales / unit, prediction.drawn)
        return self.config.training.scale_weight * volumes + vanishing_loss(prediction)

    def add_rate(self, distortion: Tensor, latents: Quantized) -> Tensor:
        """D + lambda R (Eq. 1), once the rate has joined the loss; with lambda 0 only the entropy model learns R."""
        if not latents.bits:
            return distortion
        r = rate(latents.bits, self.model.entropy.channels, self.config.training.rate)
        if self.rate.lmbda > 0:
            return rate_distortion_loss(distortion, r, self.rate.lmbda)
        r.backward(inputs=self.model.entropy.statistics(), retain_graph=True)
        return distortion

    def backward(
        self, loss: Tensor, rendered: RasterResult, gaussians: Gaussians, latents: Quantized
    ) -> None:
        """Compute the gradients. The arguments are the tensors at which a profile takes the time (`stations`)."""
        loss.backward()

    def update(self, rows: Tensor) -> None:
        """Adam's step, after a view of the anchors in `rows`; each channel of the references by its own rate."""
        t = self.config.training
        set_learning_rates(self.optimizer, self.progress, DECAYS[t.schedule], t.head_warm_up)
        references, rates = self.model.references.detach(), self.reference_rates
        before = references.clone() if rates is not None else references
        if t.sparse_adam:
            step_rows(self.model, self.optimizer, rows)
        self.optimizer.step()
        if rates is not None:
            references.copy_(before.lerp_(references, rates))
        self.optimizer.zero_grad(set_to_none=True)
        self.views.learn(self.progress)

    def observe(self, rows: Tensor, prediction: Prediction, rendered: RasterResult, camera: Camera) -> None:
        """The statistics that growth and pruning go by."""
        if self.schedule.active(self.step) and rendered.means2d.grad is not None:
            self.control.observe(rows, prediction, rendered.means2d.grad, camera)

    def finish_step(self) -> None:
        """Whatever is due after this step."""
        for event in self.events:
            if event.due(self.step):
                event.act()
                self.bounds.forget()
        self.step += 1
        self.bounds.after_step(self.step)
        self.rate = self.target_size.follow(self.rate, self.step)

    def skip(self, photograph: Target) -> StepResult:
        """A step on a view that no anchor is in: nothing can be learned from it."""
        self.finish_step()
        background = torch.tensor(self.scene.background, device=self.device)
        return StepResult(torch.zeros(()), background.expand(*photograph.image.shape), photograph)

    # events --------------------------------------------------------------------------------------------------------

    def grow(self) -> None:
        """Add anchors where the image's gradient is large, and remove those that nobody sees."""
        self.control.act(self.model, self.optimizer, self.coupled_means(), self.chance, self.rate.lmbda)

    @torch.no_grad()
    def coupled_means(self) -> Tensor:
        """[N, K, 3] world units: where the coupled primitives are now."""
        k = self.model.dimensions.coupled_primitives
        every = torch.arange(self.model.anchors, device=self.device).split(MEASURED_AT_ONCE)
        return torch.cat([self.geometry(rows)[0].view(-1, k, 3) for rows in every])

    @torch.no_grad()
    def geometry(self, rows: Tensor) -> tuple[Tensor, Tensor]:
        """Means and scales [V * K, 3] of all coupled primitives of the anchors in `rows` [V] int64, world units."""
        p = self.model.primitives(self.model.quantized(rows, stored_weights=False), rows)
        means, scales, _ = predict_geometry(self.model.heads, p, p.residuals, p.anchor_index)
        return means, scales

    def prune(self) -> None:
        """Remove the anchors that add least to the training views: what is left of the run makes up for them."""
        kept = worth_keeping(self.contributions(PRUNED_BY).sum(1), pruned_share(self.config, self.rate.lmbda))
        if kept.any():
            self.control.keep(self.model, self.optimizer, kept)

    def turn_references(self) -> None:
        """Turn the references into their principal axes; the last time, also drop channels that hardly say anything."""
        if not torch.isfinite(self.model.references).all():
            return  # the run has diverged, and the next step will say so
        decorrelate(self.model, self.optimizer)
        if self.step == max(self.decorrelated_at):
            drop_silent_channels(self.model, self.optimizer)
        self.reference_rates = channel_rates(self.model.references)

    def contributions(self, most: int = LOOKED_AT) -> Tensor:
        """[N, K] float64: what the coupled primitives add to the training views, or to at most `most` of them."""

        def predicted(camera: Camera) -> tuple[Tensor, Prediction] | None:
            rows = self.visible_anchors(camera)
            if len(rows) == 0:
                return None
            return rows, self.predict(self.model.quantized(rows), rows, camera, stored=True)

        shape = self.model.anchors, self.model.dimensions.coupled_primitives
        views = spread(self.scene.train_views, most)
        return view_contributions(views, predicted, shape, self.settings, self.device)

    # the run -------------------------------------------------------------------------------------------------------

    def run(
        self,
        path: Path | None,
        on_progress: Callable[[TrainingStatus], None] | None,
        watch: Watch | None = None,
    ) -> None:
        """All remaining steps; a checkpoint at `path` every few minutes, at the end, and when interrupted."""
        check_points_seen(self.scene, self.settings.near_plane)
        run_to_end(self, self.config.training, path, on_progress, watch)

    def snapshot(self) -> HybridModel:
        """What the file would hold of the scene now, but for primitives that the end of the run removes."""
        return self.model.as_hybrid_model(stored_weights=self.stored)

    @property
    def primitives(self) -> int:
        return self.model.anchors

    @property
    def lmbda(self) -> float:
        return self.rate.lmbda

    def estimated_bytes(self) -> int:
        """Size of the file if it were written now. Raises TrainingError if the latents are not finite any more."""
        size = latent_bytes(self.model)
        if not math.isfinite(size):
            raise diverged(self.step, "rate", size)
        return int(size) + fixed_bytes(self.model)

    def finish(self) -> None:
        """Drop coupled primitives that training views hardly see, or not at all, and anchors that have none left."""
        self.bounds.forget()
        everything = self.contributions(most=len(self.scene.train_views))
        self.model.mask = missed(everything, self.config.control.idle_share)
        if not self.model.mask.any():
            raise TrainingError("no primitive is visible in any training view; the run has failed")

    # checkpoints ---------------------------------------------------------------------------------------------------

    def save(self, path: Path) -> None:
        extra = {f"control/{name}": getattr(self.control, name) for name in AdaptiveControl.STATISTICS}
        extra["chance"] = self.chance.get_state()
        extra |= self.views.tensors()
        if self.reference_rates is not None:
            extra["reference_rates"] = self.reference_rates
        if self.bounds.measured is not None:
            extra["bounds"] = self.bounds.measured
        state = {
            "step": self.step,
            **self.views.state(),
            "rate": asdict(self.rate),
        }
        moments = optimizer_tensors(dict(self.model.named_parameters()), self.optimizer)
        save_checkpoint(path, Checkpoint(self.model, moments, extra, state))

    @classmethod
    def resumed(cls, scene: Scene, path: Path, config: Config, device: torch.device) -> "Trainer":
        """Raises CheckpointError if there is no checkpoint, or the run was another scene's or had other settings."""
        checkpoint = load_checkpoint(path)
        with restoring(path):
            check_same_run(checkpoint.model.config, config, checkpoint.state["views"], scene)
        trainer = cls(scene, config, device, checkpoint.model)
        with restoring(path):
            restore_optimizer(dict(trainer.model.named_parameters()), trainer.optimizer, checkpoint.optimizer)
            restore_statistics(trainer.control, AdaptiveControl.STATISTICS, checkpoint.extra)
            if any(at < checkpoint.state["step"] for at in trainer.decorrelated_at):
                rates = checkpoint.extra["reference_rates"]
                check_tensor(rates, (trainer.model.reference_dim,), torch.float32, "reference_rates")
                trainer.reference_rates = rates.to(device)
            if "bounds" in checkpoint.extra:
                bounds = checkpoint.extra["bounds"]
                check_tensor(bounds, (trainer.model.anchors,), torch.float32, "bounds")
                trainer.bounds.measured = bounds.to(device)
            restore_chance(trainer.chance, checkpoint.extra)
            trainer.views.restore(checkpoint.state, checkpoint.extra)
            trainer.step = checkpoint.state["step"]
            trainer.rate = RateState.restored(checkpoint.state["rate"])
        return trainer


def vanishing_loss(prediction: Prediction) -> Tensor | float:
    """Keeps a scene of which hardly anything is drawn from vanishing; 0 otherwise."""
    if prediction.drawn is not None:
        few = prediction.drawn.float().mean() < FEW_DRAWN
        return torch.where(few, revival_loss(prediction.opacities), 0.0)
    if len(prediction.index) < FEW_DRAWN * len(prediction.opacities):
        return revival_loss(prediction.opacities)
    return 0.0


# What a profile calls the parts of a step.
PARTS = {
    "visible_anchors": "culling",
    "quantize": "entropy",
    "predict_some": "prediction",
    "rasterize": "projection and rasterization",
    "regularize": "loss",
    "add_rate": "entropy",
    "backward": "entropy, backward",
    "update": "optimizer",
    "observe": "control",
    "finish_step": "control",
}


def stations(
    loss: Tensor, rendered: RasterResult, gaussians: Gaussians, latents: Quantized
) -> Iterator[tuple[str, tuple[Tensor, ...]]]:
    """Where the gradients of a step arrive, part by part."""
    yield "loss, backward", (rendered.image,)
    yield "rasterization, backward", (rendered.means2d,)
    yield "projection, backward", (gaussians.means, gaussians.quaternions, gaussians.scales)
    yield "prediction, backward", (latents.references, latents.residuals, latents.covariances)
