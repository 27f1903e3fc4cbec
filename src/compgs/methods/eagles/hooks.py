"""What EAGLES adds to the training of plain 3DGS: rounded latents, coarse images first, pruning by influence.

Latents are trained as real numbers and drawn as the nearest integers, with the gradient of the real ones. What they
decode to is copied into the splats after each step, so that whoever looks at these (density control, a viewer) sees
what the file will hold.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor, nn

from compgs.cameras import Camera
from compgs.losses import Target
from compgs.methods.eagles.settings import EaglesConfig
from compgs.methods.parts.fake_quantization import straight_through
from compgs.methods.parts.significance import all_but_lowest, view_significance
from compgs.model.degrees import harmonics_above_dc
from compgs.published.eagles import Code, cosines, latent_content
from compgs.published.parts.content import Content
from compgs.scene.views import Scene
from compgs.tensors.splats import Splats
from compgs.training import Hooks, Phase, Run, SplatRun, train_phases
from compgs.training.optimizers import rates_for, replace_parameter
from compgs.training.plan import PRUNED_BY
from compgs.training.shortcuts.coarse import smaller
from compgs.training.splats.trainer import HOOKS
from compgs.training.structure.importance import spread

RAW_BYTES = 36  # of a splat: position, color, scale


@dataclass(frozen=True)
class Coded:
    """An attribute of the splats that is decoded from latents."""

    name: str
    field: str  # of `Splats`
    learning_rate: float  # of what the latents decode to, in plain 3DGS
    shared: bool  # whether the latents' rate is divided by the size of the decoder


class Latents(Hooks):
    """Latents and decoders of harmonics, rotation and opacity."""

    def __init__(self, config: EaglesConfig) -> None:
        super().__init__()
        e, s = config.eagles, config.splats
        self.config = config
        self.attributes = [
            Coded("rotation", "quaternions", s.rotation_lr, shared=True),
            Coded("opacity", "opacity_logits", s.opacity_lr, shared=False),
        ]
        decoder_rates = {"rotation": e.rotation_decoder_lr, "opacity": e.opacity_decoder_lr}
        chance = torch.Generator().manual_seed(config.training.seed + 4)
        shape = (e.rotation_latents, 4)
        self.rotation_decoder = nn.Parameter(e.rotation_decoder * torch.randn(shape, generator=chance))
        self.opacity_decoder = nn.Parameter(torch.full((1, 1), e.opacity_decoder))  # one number: no chance
        numbers = 3 * harmonics_above_dc(s.harmonics)
        if numbers:
            self.attributes.append(Coded("harmonics", "rest", s.harmonics_lr, shared=True))
            decoder_rates["harmonics"] = e.harmonics_decoder_lr
            scales = e.harmonics_decoder * torch.randn(numbers, generator=chance)
            self.harmonics_decoder = nn.Parameter(scales)
            self.cosines = torch.from_numpy(cosines(e.harmonics_latents, numbers))
        names = [attribute.name for attribute in self.attributes]
        self.per_splat = tuple(f"{name}_latents" for name in names)
        self.rates = {f"{name}_decoder": (decoder_rates[name],) * 2 for name in names}
        self.rates |= {f"{a.name}_latents": (self.latent_rate(a),) * 2 for a in self.attributes}
        steps = config.training.steps
        last = math.floor(e.prune_until / e.prune_every + 1e-9)
        self.prune_at = frozenset(round((i + 1) * e.prune_every * steps) for i in range(last))

    # latents and what they decode to ----------------------------------------------------------------------------------

    def latents(self, name: str) -> nn.Parameter:
        """[M, L]"""
        found: nn.Parameter = getattr(self, f"{name}_latents")
        return found

    def decoder(self, name: str) -> Tensor:
        """[L, C]"""
        weights: Tensor = getattr(self, f"{name}_decoder")
        return self.cosines.to(weights.device) * weights if name == "harmonics" else weights

    def decode(self) -> dict[str, Tensor]:
        """Decode the values by the fields of `Splats`, differentiably."""
        latents = {a.name: self.latents(a.name) for a in self.attributes}
        rounded = {name: straight_through(values, values.round()) for name, values in latents.items()}
        found = {a.field: rounded[a.name] @ self.decoder(a.name) for a in self.attributes}
        found["opacity_logits"] = found["opacity_logits"][:, 0]
        quaternions = found["quaternions"]
        none = (quaternions == 0).all(1).to(quaternions.dtype)
        found["quaternions"] = quaternions + none[:, None] * quaternions.new_tensor([1.0, 0.0, 0.0, 0.0])
        if "rest" in found:
            found["rest"] = found["rest"].view(len(quaternions), -1, 3)
        return found

    @torch.no_grad()
    def codes(self) -> dict[str, Code]:
        """Return the codes as the file holds them."""
        return {
            a.name: Code(
                _array(self.latents(a.name).round().to(torch.int32)),
                _array(getattr(self, f"{a.name}_decoder")),
            )
            for a in self.attributes
        }

    @torch.no_grad()
    def encode(self, name: str, values: Tensor) -> Tensor:
        """[M, L] latents that decode to what is nearest to values [M, ...]."""
        return values.reshape(len(values), -1) @ torch.linalg.pinv(self.decoder(name))

    @torch.no_grad()
    def latent_rate(self, attribute: Coded) -> float:
        """A larger decoder makes more of a step of the latents."""
        size = float(torch.linalg.norm(self.decoder(attribute.name))) if attribute.shared else 1.0
        return min(self.config.eagles.latent_lr * attribute.learning_rate / max(size, 1e-12), 1.0)

    # a run ------------------------------------------------------------------------------------------------------------

    def begin(self, trainer: SplatRun) -> None:
        splats = trainer.parameters.splats()
        for a in self.attributes:
            latents = self.encode(a.name, getattr(splats, a.field).detach())
            setattr(self, f"{a.name}_latents", nn.Parameter(latents))

    def view(self, camera: Camera, photograph: Target, trainer: SplatRun) -> tuple[Camera, Target]:
        """A smaller image in the first part of the run."""
        self.follow_decoders(trainer)
        small = self.sized(camera, trainer.progress)
        if (small.width, small.height) == (camera.width, camera.height):
            return camera, photograph
        return small, smaller(photograph, small.width, small.height)

    def sized(self, camera: Camera, progress: float) -> Camera:
        e = self.config.eagles
        scale = image_scale(progress, e.smallest_image, e.coarse_until)
        return camera.resized(*(max(1, round(scale * side)) for side in (camera.width, camera.height)))

    def follow_decoders(self, trainer: SplatRun) -> None:
        """The latents' learning rates go with the decoders."""
        groups = {group["name"]: group for group in trainer.optimizer.param_groups}
        for attribute in self.attributes:
            rate = self.latent_rate(attribute)
            rates = rates_for(self.config.training.views_per_step, (rate, rate))
            groups[f"{HOOKS}{attribute.name}_latents"]["rates"] = rates

    def transform(self, splats: Splats, trainer: SplatRun) -> Splats:
        return replace(splats, **self.decode())

    @torch.no_grad()
    def after_step(self, trainer: SplatRun) -> None:
        if trainer.schedule.reset_due(trainer.step):
            self.take_opacities(trainer)
        if trainer.step in self.prune_at:
            trainer.keep(self.influential(trainer))
        for field, value in self.decode().items():
            getattr(trainer.parameters, field).copy_(value)

    def take_opacities(self, trainer: SplatRun) -> None:
        """The opacities of the splats were reset: their latents follow."""
        logits = trainer.parameters.opacity_logits.detach()
        replace_parameter(
            self,
            trainer.optimizer,
            self.latents("opacity"),
            lambda old: self.encode("opacity", logits),
            torch.zeros_like,
        )

    def influential(self, trainer: SplatRun) -> Tensor:
        """[M] bool: all but the share of the splats that add least to the training views."""
        cameras = [view.camera for view in spread(trainer.scene.train_views, PRUNED_BY)]
        added = view_significance(trainer.as_drawn(), cameras, trainer.settings)
        return all_but_lowest(added, self.config.eagles.prune_share)

    @torch.no_grad()
    def estimated_bytes(self, trainer: SplatRun) -> int:
        """Estimate the bytes by the entropy of each attribute's histogram."""
        symbols = (self.latents(a.name).round().view(-1) for a in self.attributes)
        bits = sum(_entropy_bits(values) for values in symbols)
        decoders = sum(getattr(self, f"{a.name}_decoder").numel() for a in self.attributes)
        return RAW_BYTES * len(trainer.parameters) + 4 * decoders + int(bits / 8)


def image_scale(progress: float, smallest: float, until: float) -> float:
    """Rise from `smallest` to 1 by half a cosine, over the share `until` of a run."""
    if progress >= until:
        return 1.0
    return smallest + (1 - smallest) * 0.5 * (1 - math.cos(math.pi * progress / until))


def train_latents(scene: Scene, config: EaglesConfig, run: Run) -> Content:
    """Raises as `compgs.train` does."""
    trainer = train_phases(scene, (Phase(config, lambda: Latents(config)),), run)
    hooks, splats = trainer.hooks, trainer.parameters.trained()
    assert isinstance(hooks, Latents)
    raw = {name: _array(getattr(splats, name)) for name in ("means", "log_scales", "dc")}
    return latent_content(
        raw, hooks.codes(), splats.degree, trainer.world_offset, trainer.scene.background, run.device
    )


def _array(tensor: Tensor) -> np.ndarray:
    return tensor.detach().cpu().numpy()


def _entropy_bits(symbols: Tensor) -> float:
    """Bits of all the symbols [M], by their own histogram."""
    counts = symbols.unique(return_counts=True)[1].double()
    return float((counts * (counts.sum() / counts).log2()).sum())
