"""What Compact-3DGS adds to the training of plain 3DGS: masks, color from a network, codebooks at the end."""

import math
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor, nn

from compgs.cameras import Camera
from compgs.losses import COMMON_EXTENT, Target
from compgs.methods.compact_3dgs.settings import CompactConfig
from compgs.methods.compact_3dgs.tensors import color_coefficients
from compgs.methods.parts.fake_quantization import straight_through
from compgs.methods.parts.vector_quantization import residual_codes, residual_labels, residual_sums
from compgs.published.compact_3dgs.color_network import ColorNetwork, network_shapes
from compgs.published.compact_3dgs.file import SMALLEST_SCALE, Shapes, compact_content
from compgs.published.compact_3dgs.hash_grid import GridLayout
from compgs.published.parts.content import Content
from compgs.scene.views import Scene
from compgs.tensors.splats import Splats
from compgs.training import Drawn, Hooks, Phase, Run, SplatRun, train_phases
from compgs.training.optimizers import rates_for
from compgs.training.splats.trainer import HOOKS

FIRST_MASK = 1.0  # logit
HIDDEN_LOGIT = -30.0  # opacity of a splat that its mask hides: far below what is drawn
FALL = 0.33  # of the color's learning rate
FIRST_ROUNDS = 10  # of k-means, by which codebooks begin


class Compact(Hooks):
    """Masks of the splats, the color network, and in the end codebooks of scales and rotations."""

    per_splat = ("masks",)
    masks: nn.Parameter  # [M] logits
    scale_codes: nn.Parameter  # [stages, codes, 3], once they begin
    rotation_codes: nn.Parameter  # [stages, codes, 4]

    def __init__(self, config: CompactConfig, extent: float, middle: np.ndarray) -> None:
        super().__init__()
        c = self.config = config.compact
        self.unit = extent
        self.middle = torch.from_numpy(middle.astype(np.float32))
        self.layout = GridLayout(c.grid_levels, c.grid_features, c.grid_base, c.grid_growth, c.grid_bits)
        chance = torch.Generator().manual_seed(config.training.seed + 4)
        self.grid = nn.Parameter(
            1e-4 * (2 * torch.rand(self.layout.total, c.grid_features, generator=chance) - 1)
        )
        for i, shape in enumerate(network_shapes(self.layout.width)):
            spread = math.sqrt(6 / shape[0])
            weights = spread * (2 * torch.rand(shape, generator=chance) - 1)
            setattr(self, f"weights_{i}", nn.Parameter(weights))
        self.layers = len(network_shapes(self.layout.width))
        self.chance = chance
        self.rates = {
            "masks": (c.mask_lr, c.mask_lr),
            **{name: (c.color_lr, c.color_lr) for name in ("grid", *self.weight_names)},
            # Standard deviations are in world units, which are not everywhere the same.
            "scale_codes": (c.codes_lr * extent / COMMON_EXTENT,) * 2,
            "rotation_codes": (c.codes_lr, c.codes_lr),
        }
        self.codes_at = max(1, round(c.codes_start * config.training.steps))
        self.prune_every = max(1, round(c.mask_every * config.training.steps))
        self.camera: Camera | None = None  # of this step
        self.error: Tensor | None = None  # of the codebooks, in this step

    @property
    def weight_names(self) -> list[str]:
        return [f"weights_{i}" for i in range(self.layers)]

    @property
    def weights(self) -> list[Tensor]:
        """Return the network's weights, layer by layer."""
        return [getattr(self, name) for name in self.weight_names]

    @property
    def coded(self) -> bool:
        """Whether scales and rotations are those of the codebooks already."""
        return hasattr(self, "scale_codes")

    # a step -----------------------------------------------------------------------------------------------------------

    def begin(self, trainer: SplatRun) -> None:
        self.masks = nn.Parameter(torch.full((len(trainer.parameters),), FIRST_MASK))

    def view(self, camera: Camera, photograph: Target, trainer: SplatRun) -> tuple[Camera, Target]:
        self.camera = camera
        fallen = sum(trainer.progress >= at for at in self.config.color_lr_falls)
        rate = self.config.color_lr * FALL**fallen
        rates = rates_for(trainer.config.training.views_per_step, (rate, rate))
        for group in trainer.optimizer.param_groups:
            if group["name"].removeprefix(HOOKS) in ("grid", *self.weight_names):
                group["rates"] = rates
        return camera, photograph

    def transform(self, splats: Splats, trainer: SplatRun) -> Splats:
        splats = self.with_codes(self.masked(splats))
        return replace(splats, dc=self.colors(splats, trainer))

    def masked(self, splats: Splats) -> Splats:
        """Scale and opacity times the mask, which is 0 or 1, with the gradient of the smooth one."""
        smooth = self.masks.sigmoid()
        shown = smooth.detach() > self.config.mask_threshold
        change = straight_through(smooth, torch.zeros_like(smooth))  # 0, with the gradient of the smooth mask
        opacity = splats.opacity_logits.detach().sigmoid()
        logits = splats.opacity_logits + change / (1 - opacity).clamp_min(1e-6)
        return replace(
            splats,
            opacity_logits=torch.where(shown, logits, HIDDEN_LOGIT),
            log_scales=splats.log_scales + change[:, None],
        )

    def colors(self, splats: Splats, trainer: SplatRun) -> Tensor:
        """[M, 3] coefficients of degree 0: of the network, for the splats that the camera may see."""
        found = torch.zeros_like(splats.dc)
        if self.camera is None:
            return found
        rows = torch.nonzero(trainer.inside(splats, self.camera)).view(-1)
        if not len(rows):
            return found
        center = torch.as_tensor(self.camera.center, dtype=torch.float32, device=found.device)
        middle = self.middle.to(found.device)
        means = splats.means.index_select(0, rows)
        dc = color_coefficients(means, center, self.grid, self.weights, self.layout, middle, self.unit)
        return found.index_copy(0, rows, dc)

    def with_codes(self, splats: Splats) -> Splats:
        """Scales and rotations of the nearest codes, once there are any, with the gradient of what they stand for."""
        self.error = None
        if not self.coded:
            return splats
        scales, turns = shape_vectors(splats)
        drawn, errors = [], []
        for vectors, books in ((scales, self.scale_codes), (turns, self.rotation_codes)):
            sums = residual_sums(books, residual_labels(vectors, books))
            drawn.append(sums.detach())
            errors.append(((sums - vectors) ** 2).mean())
        self.error = torch.stack(errors).sum()
        log_scales = drawn[0].clamp_min(SMALLEST_SCALE * self.unit).log()
        return replace(
            splats,
            log_scales=straight_through(splats.log_scales, log_scales),
            quaternions=straight_through(splats.quaternions, drawn[1]),
        )

    def loss(self, drawn: Drawn, trainer: SplatRun) -> Tensor:
        """What a splat costs, and what the codebooks miss."""
        penalty = self.config.mask_weight * self.masks.sigmoid().mean()
        return penalty if self.error is None else penalty + self.error

    # between steps ----------------------------------------------------------------------------------------------------

    def densified(self, trainer: SplatRun) -> None:
        self.remove_hidden(trainer)

    def after_step(self, trainer: SplatRun) -> None:
        if trainer.step >= trainer.schedule.stop and trainer.step % self.prune_every == 0:
            self.remove_hidden(trainer)
        if trainer.step == self.codes_at and not self.coded:
            self.begin_codes(trainer)

    def finish(self, trainer: SplatRun) -> None:
        self.remove_hidden(trainer)
        if not self.coded:
            self.begin_codes(trainer)

    @torch.no_grad()
    def remove_hidden(self, trainer: SplatRun) -> None:
        """Splats whose masks hide them are gone for good."""
        kept = self.masks.sigmoid() > self.config.mask_threshold
        if kept.any() and not kept.all():
            trainer.keep(kept)

    def begin_codes(self, trainer: SplatRun) -> None:
        """Codebooks of the scales and rotations there are."""
        c = self.config
        for name, vectors in zip(
            ("scale", "rotation"), shape_vectors(trainer.parameters.splats()), strict=True
        ):
            codes = min(c.codes, len(vectors))
            books, _ = residual_codes(vectors, c.code_stages, codes, FIRST_ROUNDS, self.chance)
            setattr(self, f"{name}_codes", nn.Parameter(books))
        trainer.train_hooks()

    def estimated_bytes(self, trainer: SplatRun) -> int:
        c = self.config
        bits = 2 * c.code_stages * (c.codes - 1).bit_length()
        weights = sum(weights.numel() for weights in self.weights)
        return int(len(trainer.parameters) * (8 + bits / 8)) + 2 * (self.grid.numel() + weights)


@torch.no_grad()
def shape_vectors(splats: Splats) -> tuple[Tensor, Tensor]:
    """Standard deviations [M, 3] and unit quaternions [M, 4]: what codebooks are of."""
    return splats.log_scales.exp(), nn.functional.normalize(splats.quaternions, dim=1)


def train_compact(scene: Scene, config: CompactConfig, run: Run) -> Content:
    """Raises as `compgs.train` does."""
    from compgs.scene.world import local_scene, world_offset

    near = local_scene(scene, world_offset(scene))
    centers = [view.camera.center for view in near.train_views]
    middle = np.mean(centers, axis=0) if centers else np.zeros(3)
    phase = Phase(config, lambda: Compact(config, scene.extent, middle))
    trainer = train_phases(scene, (phase,), run)
    hooks, splats = trainer.hooks, trainer.parameters.trained()
    assert isinstance(hooks, Compact)
    scales, turns = shape_vectors(splats)
    shapes = Shapes(
        _array(splats.means),
        _array(splats.opacity_logits),
        _array(residual_labels(scales, hooks.scale_codes)),
        _array(residual_labels(turns, hooks.rotation_codes)),
        _array(hooks.scale_codes),
        _array(hooks.rotation_codes),
    )
    network = ColorNetwork(
        hooks.layout,
        _array(hooks.grid),
        tuple(map(_array, hooks.weights)),
        middle.astype(np.float32),
        scene.extent,
    )
    return compact_content(shapes, network, trainer.world_offset, trainer.scene.background, run.device)


def _array(tensor: Tensor) -> np.ndarray:
    return tensor.detach().cpu().numpy()
