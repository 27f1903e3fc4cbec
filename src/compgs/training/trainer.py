"""Rate-distortion optimization of one scene (CompGS Sec. 3.4): a loop short enough to read aloud."""

import math
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from compgs.cameras import Camera
from compgs.config import Config
from compgs.entropy import Quantized
from compgs.entropy.network import FRACTION_BITS
from compgs.entropy.quantization import UniformNoise, weight_exponent
from compgs.errors import ConfigError, TrainingError
from compgs.losses import (
    Target,
    photometric_loss,
    rate,
    rate_distortion_loss,
    revival_loss,
    scale_regularizer,
    scale_unit,
)
from compgs.model.prediction import Prediction, camera_center, choosing_pays, predict
from compgs.render import RasterSettings, contributions, rasterize, visible_mask
from compgs.scene import as_scene
from compgs.scene.views import Scene, View
from compgs.scene.world import local_scene
from compgs.trained_model import BIAS_BITS, TrainedModel
from compgs.training.checkpoint import (
    Checkpoint,
    check_same_run,
    load_checkpoint,
    optimizer_tensors,
    restore_optimizer,
    save_checkpoint,
)
from compgs.training.control import AdaptiveControl, make_schedule, rate_weight
from compgs.training.decorrelation import channel_rates, decorrelate, drop_silent_channels
from compgs.training.dropout import share_left_out, thinned
from compgs.training.initial import initial_model
from compgs.training.loop import (
    StepResult,
    TrainingStatus,
    checkpoint_path,
    chosen_config,
    chosen_device,
    diverged,
    kept_target,
    next_view,
    run_to_end,
)
from compgs.training.optimizers import DECAYS, make_optimizer, set_learning_rates, step_rows
from compgs.training.profile import NoProfile, StepProfile
from compgs.training.rate_control import LOOKS, RateState, due, follow
from compgs.training.seen_points import check_points_seen

# With a smaller share of a view's primitives drawn, the scene is about to vanish: what is not drawn has no gradient.
FEW_DRAWN = 0.1
POSITION_BITS = 10.0  # bits per anchor position, for the estimate only
OTHER_BYTES = 750  # names of tensors, scene, tables, metadata, container, for the estimate only
SHARES = 10  # looks in a run at how much the last step drops, where the size is controlled


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
    scene = as_scene(scene)
    chosen = chosen_device(device)
    path = checkpoint_path(output, resume=resume)
    if resume and path:
        trainer = Trainer.resumed(scene, load_checkpoint(path), config, chosen)
    else:
        trainer = Trainer(scene, config, chosen)
    trainer.profile = profile or trainer.profile
    trainer.run(path, on_progress)
    return trainer.model


class Trainer:
    """State of a run: model, optimizer, adaptive control, and the order in which views come."""

    def __init__(
        self, scene: Scene, config: Config, device: torch.device, model: TrainedModel | None = None
    ) -> None:
        if not scene.train_views:
            raise ConfigError(f"{scene.name}: no training views are left after holding out the test views")
        self.config = config
        self.device = device
        self.model = (model or initial_model(scene, config)).to(device)
        self.scene = local_scene(scene, self.model.world_offset)
        self.optimizer = make_optimizer(self.model, config.training)
        self.schedule = make_schedule(config.control, config.training.steps, len(scene.train_views))
        self.pruned_at = {round(share * config.training.steps) for share in config.control.prune_at}
        self.decorrelated_at = {
            round(share * config.training.steps) for share in config.entropy.decorrelate_at
        }
        self.control = AdaptiveControl(config, self.schedule, self.model.anchors, device)
        self.chance = torch.Generator(device).manual_seed(config.training.seed + 1)  # of growth
        self.shuffle = np.random.default_rng(config.training.seed + 2)
        self.noise = UniformNoise(config.training.seed + 3, self.shuffle, device)
        self.reference_rates: Tensor | None = None  # [reference_dim], once the channels differ in it
        self.order: list[int] = []
        self.targets: dict[int, Target] = {}
        self.settings = RasterSettings(background=scene.background)
        self.left_out = share_left_out(len(scene.train_views), config.training.left_out)
        self.step = 0
        self.rate = RateState(config.training.lmbda)
        self.profile: StepProfile = NoProfile()
        target, least = config.training.target_bytes, self.fixed_bytes()
        if target is not None and target <= least:
            raise ConfigError(
                f"training.target_bytes = {target}: the networks alone take about {least} bytes; "
                "ask for more, or make them smaller (model.width, model.coupled_primitives)"
            )

    # one step ------------------------------------------------------------------------------------------------------

    def train_step(self) -> StepResult:
        """Quantize, predict, rasterize, compare, pull (the paper's Fig. 2 from left to right)."""
        t, progress = self.config.training, self.step / self.config.training.steps
        view_index = next_view(self.order, len(self.scene.train_views), self.shuffle)
        view = self.scene.train_views[view_index]
        stored = progress >= t.quantized_weights
        profile = self.profile
        profile.begin()

        rows = self.visible_anchors(view.camera)
        if len(rows) == 0:
            return self.skip(view)
        profile.lap("culling")
        latents = self.model.quantized(
            rows,
            rate=progress >= t.rate_start,
            noise=self.noise if progress < t.hard_rate else None,
            stored_weights=stored,
        )
        profile.lap("entropy")
        prediction = self.predict(latents, rows, view.camera, stored)
        gaussians = thinned(prediction, self.left_out, self.noise)
        profile.lap("prediction")
        rendered = rasterize(gaussians, view.camera, self.settings)
        profile.lap("projection and rasterization")
        if self.schedule.active(self.step):
            rendered.means2d.retain_grad()
        distortion = photometric_loss(rendered.image, self.target(view_index), t.ssim_weight)
        unit = scale_unit(gaussians.means, camera_center(view.camera, self.device), self.scene.extent)
        loss = distortion + t.scale_weight * scale_regularizer(gaussians.scales / unit, prediction.drawn)
        loss = loss + self.revival(prediction)
        profile.lap("loss")
        if latents.bits:
            r = rate(latents.bits, self.channels(), t.rate)
            if self.rate.lmbda > 0:
                loss = rate_distortion_loss(loss, r, self.rate.lmbda)
            else:
                r.backward(inputs=self.model.entropy.statistics(), retain_graph=True)
        profile.lap("entropy")
        profile.lap_on_gradient("loss, backward", rendered.image)
        profile.lap_on_gradient("rasterization, backward", rendered.means2d)
        profile.lap_on_gradient(
            "projection, backward", gaussians.means, gaussians.quaternions, gaussians.scales
        )
        profile.lap_on_gradient(
            "prediction, backward", latents.references, latents.residuals, latents.covariances
        )
        loss.backward()
        profile.lap("entropy, backward")

        set_learning_rates(self.optimizer, progress, DECAYS[t.schedule], t.head_warm_up)
        self.optimizer_step(rows)
        self.optimizer.zero_grad(set_to_none=True)
        profile.lap("optimizer")
        if self.schedule.active(self.step):
            gradient = rendered.means2d.grad
            if gradient is not None:
                self.control.observe(rows, prediction, gradient, view.camera)
            profile.lap("control")
        self.finish_step()
        return StepResult(loss.detach(), rendered.image.detach(), view)

    def optimizer_step(self, rows: Tensor) -> None:
        """Adam's step, after a view of the anchors in `rows`; each channel of the references by its own rate."""
        references, rates = self.model.references.detach(), self.reference_rates
        before = references.clone() if rates is not None else references
        if self.config.training.sparse_adam:
            step_rows(self.model, self.optimizer, rows)
        self.optimizer.step()
        if rates is not None:
            references.copy_(before.lerp_(references, rates))

    def revival(self, prediction: Prediction) -> Tensor | float:
        """The loss that keeps a scene of which hardly anything is drawn from vanishing; 0 otherwise."""
        if prediction.drawn is not None:
            few = prediction.drawn.float().mean() < FEW_DRAWN
            return torch.where(few, revival_loss(prediction.opacities), 0.0)
        if len(prediction.index) < FEW_DRAWN * len(prediction.opacities):
            return revival_loss(prediction.opacities)
        return 0.0

    def finish_step(self) -> None:
        """Whatever the step showed: anchors come and go when it is time, references turn, lambda follows the size."""
        if self.schedule.due(self.step):
            self.control.act(self.model, self.optimizer, self.coupled_means(), self.chance, self.rate.lmbda)
            self.profile.lap("control")
        if self.step in self.pruned_at:
            self.prune()
            self.profile.lap("control")
        if self.step in self.decorrelated_at:
            self.turn_references()
            self.profile.lap("control")
        self.profile.end()
        self.step += 1
        self.control_rate()

    def turn_references(self) -> None:
        """Into their principal axes, for the last time without the channels that hardly say anything."""
        if not torch.isfinite(self.model.references).all():
            return  # the run has diverged, and the next step will say so
        decorrelate(self.model, self.optimizer)
        if self.step == max(self.decorrelated_at):
            drop_silent_channels(self.model, self.optimizer)
        self.reference_rates = channel_rates(self.model.references)

    def skip(self, view: View) -> StepResult:
        """A step on a view that no anchor is in: nothing can be learned from it."""
        self.finish_step()
        background = torch.tensor(self.scene.background, device=self.device)
        return StepResult(torch.zeros(()), background.expand(*view.image.shape), view)

    def target(self, view_index: int) -> Target:
        return kept_target(self.targets, view_index, self.scene.train_views, self.device)

    @torch.no_grad()
    def visible_anchors(self, camera: Camera) -> Tensor:
        """[V] int64: anchors whose primitives may be in the image."""
        model = self.model
        # The reach of an anchor: offsets of a few units, primitives of at most three of their sizes.
        sizes = model.log_scales.exp() * model.voxel_size
        radii = 2.0 * sizes[:, :3].amax(1) + 3.0 * sizes[:, 3:].amax(1)
        return torch.nonzero(visible_mask(model.positions(), radii, camera, self.settings)).view(-1)

    def predict(self, latents: Quantized, rows: Tensor, camera: Camera, stored: bool) -> Prediction:
        """On the GPU all primitives of the anchors in view: choosing among them would mean waiting for it."""
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

    def channels(self) -> dict[str, int]:
        """Coded symbols of each stream, of an anchor."""
        m, e = self.config.model, self.config.entropy
        own = {
            "residual_hyper": m.coupled_primitives,
            "residual": m.coupled_primitives * m.residual_dim,
        }
        return {
            "reference_hyper": e.reference_hyper_dim,
            "reference": self.model.reference_dim,
            "covariance": 6,
            **(own if m.residuals else {}),
        }

    @torch.no_grad()
    def coupled_means(self) -> Tensor:
        """[N, K, 3] world units: where the coupled primitives are now."""
        model, k = self.model, self.config.model.coupled_primitives
        parts = []
        for rows in torch.arange(model.anchors, device=self.device).split(20_000):
            p = model.primitives(model.quantized(rows, stored_weights=False), rows)
            raw = model.heads.raw_geometry(p.references, p.residuals, p.anchor_index)
            means = p.positions[p.anchor_index] + raw[:, :3] * p.reach[p.anchor_index]
            parts.append(means.view(-1, k, 3))
        return torch.cat(parts)

    # the run -------------------------------------------------------------------------------------------------------

    def run(self, path: Path | None, on_progress: Callable[[TrainingStatus], None] | None) -> None:
        """All remaining steps; a checkpoint at `path` every few minutes, at the end, and when interrupted."""
        check_points_seen(self.scene, self.settings.near_plane)
        run_to_end(self, self.config.training, path, on_progress)

    @property
    def primitives(self) -> int:
        return self.model.anchors

    @property
    def kind(self) -> str:
        return "anchors"

    @property
    def lmbda(self) -> float:
        return self.rate.lmbda

    def estimated_bytes(self) -> int:
        """Of the file, were it written now. Raises TrainingError if the latents are not finite any more."""
        model = self.model
        anchors = int(model.mask.any(1).sum())
        bits = sum(model.estimated_bits().values()) + POSITION_BITS * anchors
        if not math.isfinite(bits):
            raise diverged(self.step, "rate", bits)
        return int(bits / 8) + self.fixed_bytes()

    @torch.no_grad()
    def fixed_bytes(self) -> int:
        """Of the networks and all that does not grow with the scene, about: no lambda makes it smaller."""
        e, model = self.config.entropy, self.model
        bits = 0.0
        for p in model.heads.parameters():
            exponent = weight_exponent(p, e.head_bits if p.dim() > 1 else BIAS_BITS)
            bits += gaussian_entropy(p * 2.0**exponent)
        for network in model.entropy.coded_networks:
            for weight, bias in network.layers():
                scaled = weight * 2.0 ** weight_exponent(weight, e.network_bits)
                # In halves, as the file has them: means and scales differ in spread.
                bits += sum(gaussian_entropy(half) for half in scaled.tensor_split(2))
                bits += sum(gaussian_entropy(half * 2.0**FRACTION_BITS) for half in bias.tensor_split(2))
        return int(bits / 8) + OTHER_BYTES

    def control_rate(self) -> None:
        """Where a size is asked for, look now and then at what the file would take, and follow it with lambda."""
        t = self.config.training
        if t.target_bytes is None or not due(self.step, t.steps, t.rate_start):
            return
        grown = self.schedule.ended(self.step)
        fixed = self.fixed_bytes()
        size = self.estimated_bytes() - fixed
        pruned = any(self.step - t.steps // LOOKS <= at < self.step for at in self.pruned_at)
        if pruned or self.step % max(1, t.steps // SHARES) == 0 or (grown and self.rate.error is None):
            self.rate = replace(self.rate, share=self.lasting_share())
        target = max(1, t.target_bytes - fixed)
        progress = self.step / t.steps
        self.rate = follow(self.rate, size * self.rate.share, target, progress=progress, grown=grown)

    def lasting_share(self) -> float:
        """Of the bytes that are not fixed: those that stay when all is removed that will be, by the end of the run."""
        mask, fixed, size = self.model.mask, self.fixed_bytes(), self.estimated_bytes()
        total = self.contributions()
        still = sum(at >= self.step for at in self.pruned_at)
        kept = worth_keeping(total.sum(1), 1.0 - (1.0 - self.pruned_share()) ** still)
        self.model.mask = self.seen(total) & kept[:, None]
        share = (self.estimated_bytes() - fixed) / (size - fixed) if self.model.mask.any() else 1.0
        self.model.mask = mask
        return share

    def finish(self) -> None:
        """Drop coupled primitives that training views hardly see, or not at all, and anchors that have none left."""
        self.model.mask = self.seen(self.contributions())
        if not self.model.mask.any():
            raise TrainingError("no primitive is visible in any training view; the run has failed")

    def seen(self, contributions: Tensor) -> Tensor:
        """[N, K] bool: coupled primitives that the training views would miss; [N, K] of their `contributions`."""
        idle_share = self.config.control.idle_share
        return worth_keeping(contributions.view(-1), idle_share).view_as(contributions)

    def prune(self) -> None:
        """Remove the anchors that add least to the training views: what is left of the run makes up for them."""
        kept = worth_keeping(self.contributions().sum(1), self.pruned_share())
        if kept.any():
            self.control.keep(self.model, self.optimizer, kept)

    def pruned_share(self) -> float:
        """Of all blending weights: what the anchors that are removed together may make up, once."""
        control = self.config.control
        return min(0.5, control.prune_share * rate_weight(control, self.rate.lmbda))

    @torch.no_grad()
    def contributions(self) -> Tensor:
        """[N, K] float64: blending weights of the coupled primitives, summed over the pixels of all training views."""
        model, k = self.model, self.config.model.coupled_primitives
        total = torch.zeros(model.anchors * k, dtype=torch.float64, device=self.device)
        for view in self.scene.train_views:
            rows = self.visible_anchors(view.camera)
            if len(rows) == 0:
                continue
            prediction = self.predict(model.quantized(rows), rows, view.camera, stored=True)
            slots = rows[prediction.index // k] * k + prediction.index % k
            # Each slot comes once: no sum depends on an order.
            total[slots] += contributions(prediction.gaussians, view.camera, self.settings).double()
        return total.view(-1, k)

    # checkpoints ---------------------------------------------------------------------------------------------------

    def save(self, path: Path) -> None:
        extra = {f"control/{name}": getattr(self.control, name) for name in AdaptiveControl.STATISTICS}
        extra["chance"] = self.chance.get_state()
        if self.reference_rates is not None:
            extra["reference_rates"] = self.reference_rates
        state = {
            "step": self.step,
            "order": self.order,
            "shuffle": self.shuffle.bit_generator.state,
            "views": [view.name for view in self.scene.train_views],
            "rate": asdict(self.rate),
        }
        save_checkpoint(
            path, Checkpoint(self.model, optimizer_tensors(self.model, self.optimizer), extra, state)
        )

    @classmethod
    def resumed(cls, scene: Scene, checkpoint: Checkpoint, config: Config, device: torch.device) -> "Trainer":
        """Raises CheckpointError if the run was another scene's or had other settings."""
        check_same_run(checkpoint.model.config, config, checkpoint.state["views"], scene)
        trainer = cls(scene, config, device, checkpoint.model)
        restore_optimizer(trainer.model, trainer.optimizer, checkpoint.optimizer)
        for name in AdaptiveControl.STATISTICS:
            setattr(trainer.control, name, checkpoint.extra[f"control/{name}"].to(device))
        if "reference_rates" in checkpoint.extra:
            trainer.reference_rates = checkpoint.extra["reference_rates"].to(device)
        trainer.chance.set_state(checkpoint.extra["chance"])
        trainer.shuffle.bit_generator.state = checkpoint.state["shuffle"]
        trainer.order = checkpoint.state["order"]
        trainer.step = checkpoint.state["step"]
        trainer.rate = RateState(**checkpoint.state["rate"])
        return trainer


def gaussian_entropy(values: Tensor) -> float:
    """Bits of values that are rounded to integers and coded as if from one Gaussian of their spread."""
    variance = float(values.detach().double().var(correction=0)) + 1 / 12  # of the rounding
    return values.numel() * max(0.0, 0.5 * math.log2(2 * math.pi * math.e * variance))


def worth_keeping(contributions: Tensor, share: float) -> Tensor:
    """[P] bool: all but the smallest contributions [P], which together make up at most `share` of the sum."""
    ascending = contributions.sort(stable=True)
    idle = ascending.values.cumsum(0) <= share * contributions.sum()
    kept = contributions > 0
    kept[ascending.indices[idle]] = False
    return kept
