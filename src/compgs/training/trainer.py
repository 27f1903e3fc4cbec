"""Rate-distortion optimization of one scene (CompGS Sec. 3.4): a loop short enough to read aloud."""

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, replace
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
    FEW_DRAWN,
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
from compgs.tensors.gradient_sampling import GradientSizes, with_sampled_gradients
from compgs.tensors.prediction import (
    Geometry,
    Prediction,
    camera_center,
    geometry_of_all,
)
from compgs.trained_model import TrainedModel
from compgs.training.optimizers import DECAYS, make_optimizer, parameters_of, set_learning_rates
from compgs.training.plan import Plan, head_bits, plan
from compgs.training.rate.file_size import anchor_bits, fixed_bytes
from compgs.training.rate.rate_control import RateState
from compgs.training.rate.target_size import TargetSize
from compgs.training.run.checkpoint import (
    Checkpoint,
    Writer,
    check_same_run,
    load_checkpoint,
    save_checkpoint,
)
from compgs.training.run.distributed import (
    check_identical,
    mine,
    sum_gradients,
    whole,
)
from compgs.training.run.loop import (
    Run,
    StepResult,
    TrainingStatus,
    Watch,
    chosen_config,
    diverged,
    rasterize_step,
    run_to_end,
)
from compgs.training.run.parts import Chance, Memory, Statistics
from compgs.training.run.profile import StepProfile
from compgs.training.run.restoring import restoring
from compgs.training.run.seen_points import check_points_seen
from compgs.training.shortcuts.coarse import CoarseViews
from compgs.training.shortcuts.hidden import HiddenAnchors
from compgs.training.start import initial_model, start_of
from compgs.training.step.dropout import thinned
from compgs.training.step.step_views import Noise, StepViews, step_views
from compgs.training.step.views_in_turn import ViewsInTurn
from compgs.training.structure.averaging import Averaging
from compgs.training.structure.control import AdaptiveControl, make_schedule
from compgs.training.structure.decorrelation import ChannelRates, decorrelate, drop_silent_channels
from compgs.training.structure.events import Event, at_shares
from compgs.training.structure.importance import missed
from compgs.training.structure.pruning import paying
from compgs.training.survey import Survey, predict_view

METHOD = "compgs"


def train(
    scene: Scene | str | Path,
    config: Config | None = None,
    *,
    preset: str | None = None,
    output: str | Path | None = None,
    resume: bool = False,
    progress: Callable[[TrainingStatus], None] | None = None,
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
    run = Run(METHOD, output=output, resume=resume, on_progress=progress, device=device, profile=profile)
    return train_hybrid(as_scene(scene), config, run)


def train_hybrid(scene: Scene, config: Config, run: Run) -> TrainedModel:
    """Train a scene, as `train` does. Raises as it does."""
    if run.earlier:
        trainer = Trainer.resumed(scene, run.earlier, config, run.device)
    else:
        trainer = Trainer(scene, config, run.device, planned=run.plan)
    if run.profile is not None:
        run.profile.watch(trainer, PARTS, stations)
    trainer.run(run.checkpoint, run.on_progress, run.watch)
    return trainer.model


class Trainer:
    """State of a run: model, optimizer, adaptive control, and the order in which views come."""

    kind = "anchors"  # what a progress display counts

    def __init__(
        self,
        scene: Scene,
        config: Config,
        device: torch.device,
        model: TrainedModel | None = None,
        planned: Plan | None = None,  # of the capture, of which the scene is a tile
    ) -> None:
        t, views = config.training, len(scene.train_views)
        per_step = t.views_per_step
        self.views = ViewsInTurn(scene, device, t.seed + 2, exposure=t.exposure, per_step=per_step)
        self.config = config
        self.device = device
        self.model = (model or initial_model(scene, config, device, planned)).to(device)
        self.plan = plan_of(self.model, scene, device)
        self.coarse = CoarseViews(self.views, self.plan.coarse_until)
        self.scene = local_scene(scene, self.model.world_offset)
        self.optimizer = make_optimizer(self.model, t)
        self.average = Averaging(self.model)
        self.schedule = make_schedule(config.control, t.steps, views, per_step)
        self.hidden = HiddenAnchors(self.plan.passed_over, views, self.shape, device)
        self.control = AdaptiveControl(config, self.schedule, self.shape, device, (self.hidden.replaced,))
        self.chance = torch.Generator(device).manual_seed(t.seed + 1)  # of growth
        self.noise = UniformNoise(t.seed + 3, self.views.chance, device)
        self.settings = RasterSettings(
            background=scene.background, angular_dilation=self.model.angular_dilation
        )
        self.step = 0
        self.survey = Survey(self.model, self.scene, self.settings, lambda: self.step)
        self.bounds = self.survey.bounds
        self.rate = RateState(t.lmbda)
        self.decorrelated_at = at_shares(config.entropy.decorrelate_at, t.steps)
        self.channel_rates = ChannelRates(self.model, self.decorrelated_at)
        pruned_at = at_shares(config.control.prune_at, t.steps)
        self.target_size = TargetSize(
            self.model,
            self.schedule,
            pruned_at,
            self.survey.contributions,
            self.survey.changes,
            self.plan.bit_discount,
        )
        self.events = (
            Event(self.schedule.due, self.grow),
            Event(pruned_at.__contains__, self.prune),
            Event(self.decorrelated_at.__contains__, self.turn_references),
        )

    # one step ------------------------------------------------------------------------------------------------------

    def train_step(self) -> StepResult:
        """Quantize, predict, rasterize, compare, pull (the paper's Fig. 2 from left to right); then move."""
        looks = self.look()
        if len(looks.seen.rows) == 0:
            return self.skip(looks)
        result = self.learn(looks)
        loss = result.loss.clone()
        self.update(looks, loss)
        self.finish_step()
        return replace(result, loss=loss / len(looks.views))

    def look(self) -> StepViews:
        """The views of this step, and the anchors that they may show. The rate is of all of these; steps without it
        pass over those that were hidden.
        """
        views = self.views.next()
        rows = [self.visible_anchors(self.scene.train_views[view].camera) for view in views]
        if self.progress >= self.config.training.rate_start and self.step % self.plan.rate_every:
            rows = [self.hidden.others(view, of_view) for view, of_view in zip(views, rows, strict=True)]
        return step_views(views, rows, self.model.anchors, self.noise)

    def learn(self, looks: StepViews) -> StepResult:
        """Gradients of this rank's views; the loss is the sum over them, the image that of the last."""
        if len(looks.own.rows) == 0:
            return self.nothing_shown(looks)
        latents = self.quantize(looks)
        shown = latents.cut()
        with self.shared_geometry(shown, looks) as geometry:
            results = [self.learn_from(shown, geometry, looks, number) for number in looks.own.numbers]
        rate = self.rate_of(latents, looks)
        self.pull(latents, shown, rate)
        self.learn_neighbours(latents, looks)
        loss = torch.stack([result.loss for result in results]).sum()
        if rate is not None and self.rate.lmbda > 0:
            loss = rate_distortion_loss(loss, rate.detach(), self.rate.lmbda)
        return replace(results[-1], loss=loss)

    @contextmanager
    def shared_geometry(self, shown: Quantized, looks: StepViews) -> Iterator[Geometry | None]:
        """Where several views are looked at: the geometry of their primitives, predicted once. After them its gradients
        go on to the latents and the heads. A single view predicts that of what it shows.
        """
        if len(looks.own.numbers) == 1:
            yield None
            return
        geometry = self.predict_shared(shown, looks.own.rows)
        cut = geometry.cut()
        yield cut
        pull_back(geometry.tensors(), cut.tensors())

    def predict_shared(self, shown: Quantized, rows: Tensor) -> Geometry:
        heads, primitives = self.model.heads, self.model.primitives(shown, rows)
        if not self.stored:
            return geometry_of_all(heads, primitives)
        weights = self.model.stored_head_weights()
        found: Geometry = torch.func.functional_call(heads, weights, (geometry_of_all, primitives))
        return found

    def learn_from(
        self, shown: Quantized, geometry: Geometry | None, looks: StepViews, number: int
    ) -> StepResult:
        """One of the step's views: its gradients by the latents, the heads and its exposure."""
        view, part = looks.views[number], looks.own.part_of(number)
        camera, photograph = self.coarse.look(view, self.scene.train_views[view].camera, self.progress)
        rows = looks.own.rows_of(number)
        if geometry is not None:
            geometry = geometry.of(None if part is None else self.model.slots(part))
        sizes = GradientSizes()
        prediction, gaussians = self.predict_some(
            shown.of(part), rows, camera, looks.noise_of_view(number), geometry, sizes
        )
        rendered = self.rasterize(gaussians, camera)
        loss = self.compare(rendered, photograph) + self.regularize(prediction, gaussians, camera)
        self.backward(loss, rendered, gaussians)
        self.observe(rows, prediction, rendered, camera)
        self.hidden.observe(view, rows, prediction, gaussians, sizes)
        return StepResult(loss.detach(), rendered.image.detach(), photograph)

    @property
    def progress(self) -> float:
        """Return the fraction of the run that is done, 0 to 1."""
        return self.step / self.config.training.steps

    def visible_anchors(self, camera: Camera) -> Tensor:
        """[V] int64: anchors whose primitives may be in the image."""
        return self.survey.visible_anchors(camera)

    def quantize(self, looks: StepViews) -> Quantized:
        """Latents of the anchors in view as the decoder will have them, and their bits (Sec. 3.3)."""
        t = self.config.training
        return self.model.quantized(
            looks.own.rows,
            rate=self.rate_weight > 0,
            noise=looks.noise_of_latents() if self.progress < t.hard_rate else None,
            stored_weights=self.stored,
        )

    @property
    def rate_weight(self) -> int:
        """How many steps the rate of this one stands for: it is in the loss of every few, as many times."""
        every = self.plan.rate_every
        counted = self.progress >= self.config.training.rate_start and self.step % every == 0
        return every if counted else 0

    @property
    def stored(self) -> bool:
        """Whether this late in the run the networks compute with weights rounded as the file will hold them."""
        return self.progress >= self.config.training.quantized_weights

    def predict_some(
        self,
        latents: Quantized,
        rows: Tensor,
        camera: Camera,
        noise: Noise,
        geometry: Geometry | None,
        sizes: GradientSizes,
    ) -> tuple[Prediction, Gaussians]:
        """What the view may show (Sec. 3.2), and its Gaussians without those that chance leaves out of this step.
        `sizes` will be those of their gradients.
        """
        prediction = self.predict(latents, rows, camera, self.stored, geometry)
        gaussians = thinned(prediction, self.plan.dropout, noise)
        return prediction, with_sampled_gradients(gaussians, self.plan.sampled_gradients, noise, sizes)

    def predict(
        self,
        latents: Quantized,
        rows: Tensor,
        camera: Camera,
        stored: bool,
        geometry: Geometry | None = None,
    ) -> Prediction:
        """Predict the primitives of anchors in view; on the GPU all of them, as choosing would make the CPU wait."""
        return predict_view(self.model, latents, rows, camera, stored=stored, geometry=geometry)

    def rasterize(self, gaussians: Gaussians, camera: Camera) -> RasterResult:
        return rasterize_step(gaussians, camera, self.settings, watched=self.schedule.active(self.step))

    def compare(self, rendered: RasterResult, target: Target) -> Tensor:
        return photometric_loss(rendered.image, target, self.config.training.ssim_weight)

    def regularize(self, prediction: Prediction, gaussians: Gaussians, camera: Camera) -> Tensor:
        """The part of the distortion beside the image's: penalties on large primitives and on a vanishing scene."""
        unit = scale_unit(gaussians.means, camera_center(camera, self.device), self.scene.extent)
        volumes = scale_regularizer(gaussians.scales / unit, prediction.drawn)
        return self.config.training.scale_weight * volumes + vanishing_loss(prediction)

    def rate_of(self, latents: Quantized, looks: StepViews) -> Tensor | None:
        """R of Eq. 1, summed over this rank's views, and over the steps that it stands for; None where it is not in the
        loss.
        """
        if not latents.bits:
            return None
        channels, normalization = self.model.entropy.channels, self.config.training.rate
        parts = [latents.of(looks.own.part_of(number)) for number in looks.own.numbers]
        rates = [rate(part.bits, channels, normalization) for part in parts]
        return self.rate_weight * torch.stack(rates).sum()

    def backward(self, loss: Tensor, rendered: RasterResult, gaussians: Gaussians) -> None:
        """Compute a view's gradients. The arguments are the tensors at which a profile takes the time (`stations`)."""
        loss.backward()

    def pull(self, latents: Quantized, shown: Quantized, rate: Tensor | None) -> None:
        """D + lambda R (Eq. 1): what the views ask of the latents, and what the rate does, through the entropy model to
        the anchors. With lambda 0 only the entropy model learns R.
        """
        if rate is not None and self.rate.lmbda > 0:
            rate = self.rate.lmbda * rate
        elif rate is not None:
            rate.backward(inputs=self.model.entropy.statistics(), retain_graph=True)
            rate = None
        pull_back(latents.latents(), shown.latents(), rate)

    def learn_neighbours(self, latents: Quantized, looks: StepViews) -> None:
        """What the references cost given their neighbours, as in the file; only their network learns of it."""
        if latents.neighbour_bits is None:
            return
        parts = [latents.of(looks.own.part_of(number)).neighbour_bits for number in looks.own.numbers]
        torch.stack([bits.mean() for bits in parts if bits is not None]).sum().backward()

    def update(self, looks: StepViews, loss: Tensor) -> None:
        """Adam's step, after views of the anchors in `looks`; each channel of the references by its own rate.

        Over the ranks gradients are summed, and the `loss` [], which becomes that of all views.
        """
        t = self.config.training
        exposures = self.views.exposure_gradients(looks.views)
        sum_gradients(parameters_of(self.optimizer), loss, *exposures)
        set_learning_rates(self.optimizer, self.progress, DECAYS[t.schedule], t.head_warm_up)
        with self.channel_rates.applied():
            self.optimizer.step()
        self.optimizer.zero_grad(set_to_none=True)
        self.views.learn(self.progress, looks.views, exposures)

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
                self.average.forget()
                self.check_ranks()
        self.step += 1
        if self.progress > 1.0 - self.config.training.averaged:
            self.average.after_step()
        self.bounds.after_step(self.step)
        self.rate = self.target_size.follow(self.rate, self.step)
        self.choose_head_bits()

    def pass_over(self, steps: int) -> None:
        """Go on by so many steps without learning in them; what is due after each is done."""
        for _ in range(steps):
            self.finish_step()

    def choose_head_bits(self) -> None:
        """Choose the bits of the heads' weights, as long as the networks do not compute with weights so rounded."""
        if not self.stored:
            start, anchors = self.plan.start, self.model.anchors
            self.model.head_bits = head_bits(self.config, start, self.rate.lmbda, anchors)

    def skip(self, looks: StepViews) -> StepResult:
        """A step on views that no anchor is in: nothing can be learned from it."""
        self.finish_step()
        return self.nothing_shown(looks)

    def nothing_shown(self, looks: StepViews) -> StepResult:
        photograph = self.views.photograph(mine(looks.views)[-1])
        background = torch.tensor(self.scene.background, device=self.device)
        loss = torch.zeros((), device=self.device)
        return StepResult(loss, background.expand(*photograph.image.shape), photograph)

    def check_ranks(self) -> None:
        """Raises TrainingError if the ranks of a torchrun have come to hold different models."""
        lmbda = torch.tensor(self.rate.lmbda, dtype=torch.float64)
        check_identical(self.step, {**self.model.state_dict(), "lambda": lmbda})

    # events --------------------------------------------------------------------------------------------------------

    def grow(self) -> None:
        """Add anchors where the image's gradient is large, and remove those that nobody sees."""
        with whole(self.control, AdaptiveControl.STATISTICS):
            self.control.act(
                self.model, self.optimizer, self.survey.coupled_means(), self.chance, self.rate.lmbda
            )

    def prune(self) -> None:
        """Remove the anchors that are not worth their bits: what is left of the run makes up for them."""
        changes = self.survey.changes(self.plan.pruning_views)
        bits = anchor_bits(self.model)
        lmbda, written = self.rate.lmbda_of_pruning, self.rate.written
        least, most = self.target_size.bits_that_stay(self.step, bits, written)
        c, discount = self.config.control, self.plan.bit_discount
        kept = paying(changes, bits, lmbda, c, discount, least_bits=least, most_bits=most)
        if kept.any():
            self.control.keep(self.model, self.optimizer, kept)

    def turn_references(self) -> None:
        """Turn the references into their principal axes; the last time, also drop channels that hardly say anything."""
        if not torch.isfinite(self.model.references).all():
            return  # the run has diverged, and the next step will say so
        decorrelate(self.model, self.optimizer)
        if self.step == max(self.decorrelated_at):
            drop_silent_channels(self.model, self.optimizer)
        self.channel_rates.follow()

    @property
    def shape(self) -> tuple[int, int]:
        """N, K."""
        return self.model.anchors, self.model.dimensions.coupled_primitives

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

    def camera_at(self, step: int, divisor: int = 1) -> Camera:
        """Return the camera of a usual training view, as large as a step looks at it."""
        cameras = [view.camera for view in self.scene.train_views]
        return self.coarse.usual(cameras, step / self.config.training.steps, divisor)

    def snapshot(self) -> HybridModel:
        """What the file would hold of the scene now; the end of the run takes means, and removes primitives."""
        return self.model.as_hybrid_model(stored_weights=self.stored)

    @property
    def primitives(self) -> int:
        return self.model.anchors

    @property
    def lmbda(self) -> float:
        return self.rate.lmbda

    def estimated_bytes(self) -> int:
        """Size of the file if it were written now. Raises TrainingError if the latents are not finite any more."""
        size = self.rate.written * self.target_size.file.latents()
        if not math.isfinite(size):
            raise diverged(self.step, "rate", size)
        return int(size) + fixed_bytes(self.model)

    def finish(self) -> None:
        """The mean of the last steps is the scene; without coupled primitives that training views hardly see, or not at
        all, and anchors that have none left.
        """
        self.average.settle()
        self.bounds.forget()
        everything = self.survey.contributions(most=len(self.scene.train_views))
        self.model.mask = missed(everything, self.config.control.idle_share)
        if not self.model.mask.any():
            raise TrainingError("no primitive is visible in any training view; the run has failed")

    # checkpoints ---------------------------------------------------------------------------------------------------

    def save(self, path: Path | None, writer: Writer | None = None) -> None:
        with whole(self.control, AdaptiveControl.STATISTICS):
            if path is not None:
                self.write(path, writer)

    def write(self, path: Path, writer: Writer | None) -> None:
        memory = self.memory
        state = {"step": self.step, "rate": asdict(self.rate), **memory.state()}
        saved = Checkpoint(self.model, self.plan, memory.moments(), memory.tensors(), state)
        save_checkpoint(path, saved, writer)

    @classmethod
    def resumed(cls, scene: Scene, path: Path, config: Config, device: torch.device) -> "Trainer":
        """Raises CheckpointError if there is no checkpoint, or the run was another scene's, or had other settings or
        another device.
        """
        checkpoint = load_checkpoint(path, device)
        with restoring(path):
            check_same_run(checkpoint.model.config, config, checkpoint.state["views"], scene)
        trainer = cls(scene, config, device, checkpoint.model)
        with restoring(path):
            trainer.memory.restore(checkpoint.optimizer, checkpoint.extra, checkpoint.state)
            trainer.step = checkpoint.state["step"]
            trainer.rate = RateState.restored(checkpoint.state["rate"])
        return trainer

    @property
    def memory(self) -> Memory:
        """What the run remembers between two steps, but for the model, the step and lambda."""
        statistics = Statistics(self.control, AdaptiveControl.STATISTICS)
        parts = (statistics, self.channel_rates, self.bounds, self.hidden, Chance(self.chance), self.views)
        return Memory(lambda: dict(self.model.named_parameters()), self.optimizer, (*parts, self.average))


def plan_of(model: TrainedModel, scene: Scene, device: torch.device) -> Plan:
    """The plan that a model was made by; one that was made without goes by the rules for its scene."""
    if isinstance(model.plan, Plan):
        return model.plan
    return plan(model.config, start_of(scene, model.config, device, model.anchors))


def pull_back(tensors: Sequence[Tensor], leaves: Sequence[Tensor], loss: Tensor | None = None) -> None:
    """Lead the gradients of `leaves`, which were cut from the `tensors`, and those of a `loss` [] on through the graph
    of these.
    """
    asked: list[tuple[Tensor, Tensor | None]]
    asked = [
        (tensor, leaf.grad) for tensor, leaf in zip(tensors, leaves, strict=True) if leaf.grad is not None
    ]
    if loss is not None:
        asked.append((loss, None))
    torch.autograd.backward([tensor for tensor, _ in asked], [gradient for _, gradient in asked])


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
    "predict_shared": "prediction",
    "predict_some": "prediction",
    "rasterize": "projection and rasterization",
    "regularize": "loss",
    "backward": "prediction, backward",
    "rate_of": "entropy",
    "pull": "entropy, backward",
    "learn_neighbours": "entropy, backward",
    "update": "optimizer",
    "observe": "control",
    "finish_step": "control",
}


def stations(
    loss: Tensor, rendered: RasterResult, gaussians: Gaussians
) -> Iterator[tuple[str, tuple[Tensor, ...]]]:
    """Where the gradients of a view arrive, part by part; the rest is the prediction's."""
    yield "loss, backward", (rendered.image,)
    yield "rasterization, backward", (rendered.means2d,)
    yield "projection, backward", (gaussians.means, gaussians.quaternions, gaussians.scales)
