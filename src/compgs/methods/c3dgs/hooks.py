"""Fine-tuning of splats that share entries, all of it as the file will show it."""

from dataclasses import replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn

from compgs.formats.packed import Packed
from compgs.methods.c3dgs.sensitivity import sensitivities
from compgs.methods.c3dgs.settings import C3DGSConfig
from compgs.methods.c3dgs.shapes import covariances, scales_and_rotations
from compgs.methods.parts.books import entries_within
from compgs.methods.parts.fake_quantization import fake_half, fake_levels
from compgs.methods.parts.vector_quantization import averaged_codes, first_codes, nearest_codes
from compgs.published.c3dgs import (
    SPLAT_BYTES,
    THINNEST,
    Shared,
    entry_bytes,
    packed_splats,
)
from compgs.tensors.splats import Splats
from compgs.training.plan import PRUNED_BY
from compgs.training.splats.hooks import Hooks
from compgs.training.structure.importance import spread

if TYPE_CHECKING:
    from compgs.training.splats.hooks import SplatRun

SEED = 12  # of the first codes, beside the run's
OPACITY_MARGIN = 1e-6  # as where the file is read (`compgs.formats.arrays`)


class SharedEntries(Hooks):
    """Entries of colors [P] and shapes [Q], rows of them for each splat, and sizes [M]: these are trained in place of
    the splats' own colors, scales and rotations.
    """

    # [P, 3], [P, K, 3], [Q, 3], [Q, 4], [M]
    dc: nn.Parameter
    rest: nn.Parameter
    scales: nn.Parameter
    quaternions: nn.Parameter
    log_factors: nn.Parameter
    # [M] int64 rows of the entries, [3] world units
    colors: Tensor
    shapes: Tensor
    center: Tensor

    def __init__(self, config: C3DGSConfig) -> None:
        super().__init__()
        self.section = config.c3dgs
        self.seed = config.training.seed
        s = config.splats
        rates = {
            "dc": s.color_lr,
            "rest": s.harmonics_lr,
            "scales": s.log_scale_lr,
            "quaternions": s.rotation_lr,
            "log_factors": s.log_scale_lr,
        }
        self.rates = {name: (rate, rate) for name, rate in rates.items()}

    # codebooks -----------------------------------------------------------------------------------------------------

    @torch.no_grad()
    def begin(self, trainer: "SplatRun") -> None:
        cameras = [view.camera for view in spread(trainer.scene.train_views, PRUNED_BY)]
        of_colors, of_shapes = sensitivities(trainer.parameters.trained(), cameras, trainer.settings)
        seen = of_colors > 0
        if seen.any() and not seen.all():
            trainer.keep(seen)
            of_colors, of_shapes = of_colors[seen], of_shapes[seen]
        splats = trainer.parameters.trained()
        self.register_buffer("center", splats.means.median(0).values)
        self.share(splats, of_colors, of_shapes)

    def share(self, splats: Splats, of_colors: Tensor, of_shapes: Tensor) -> None:
        """Make the entries, by the sensitivities [M] of the splats' colors and shapes."""
        s, count = self.section, len(splats)
        chance = torch.Generator().manual_seed(self.seed + SEED)
        entries = entries_within(
            s.codebook,
            SPLAT_BYTES * count,
            lambda k: entry_bytes(splats.degree) * k,
            s.codebook_share,
        )
        vectors = torch.cat([splats.dc, splats.rest.flatten(1)], 1)
        threshold = s.threshold * s.color_threshold / count
        made, colors = shared(
            vectors, of_colors, threshold, entries, s.color_steps, s.color_batch, s.decay, chance
        )
        self.dc = nn.Parameter(made[:, :3].contiguous())
        self.rest = nn.Parameter(made[:, 3:].reshape(len(made), -1, 3).contiguous())
        scales = splats.log_scales.exp()
        sizes = scales.norm(dim=1, keepdim=True)
        vectors = covariances(scales / sizes, splats.quaternions)
        threshold = s.threshold * s.shape_threshold / count
        made, shapes = shared(
            vectors, of_shapes, threshold, entries, s.shape_steps, s.shape_batch, s.decay, chance
        )
        first, second = scales_and_rotations(made)
        self.scales, self.quaternions = nn.Parameter(first), nn.Parameter(second)
        self.log_factors = nn.Parameter(sizes[:, 0].log())
        self.register_buffer("colors", colors)
        self.register_buffer("shapes", shapes)

    # fine-tuning ---------------------------------------------------------------------------------------------------

    def transform(self, splats: Splats, trainer: "SplatRun") -> Splats:
        positive = torch.nn.functional.normalize(fake_levels(self.scales).relu(), dim=1, eps=1e-12)
        log_shapes = positive.clamp_min(THINNEST).log()
        rest = fake_levels(self.rest) if self.rest.numel() else self.rest
        return replace(
            splats,
            means=self.center + fake_half(splats.means - self.center),
            log_scales=fake_levels(self.log_factors)[:, None] + log_shapes[self.shapes],
            quaternions=fake_levels(self.quaternions)[self.shapes],
            opacity_logits=fake_levels(splats.opacity_logits.sigmoid()).logit(OPACITY_MARGIN),
            dc=fake_levels(self.dc)[self.colors],
            rest=rest[self.colors],
        )

    def estimated_bytes(self, trainer: "SplatRun") -> int:
        """Estimate the bytes before DEFLATE."""
        entries = (self.dc, self.rest, self.scales, self.quaternions)
        return SPLAT_BYTES * len(trainer.parameters) + sum(entry.numel() for entry in entries)

    @torch.no_grad()
    def content(self, trainer: "SplatRun") -> Packed:
        """Return the content of the file, after the last step."""
        splats = trainer.parameters.trained()
        tensors = {
            "means": splats.means - self.center,
            "opacities": splats.opacity_logits.sigmoid(),
            **{
                name: getattr(self, name)
                for name in ("log_factors", "colors", "shapes", "dc", "rest", "scales", "quaternions")
            },
        }
        arrays = {name: tensor.detach().cpu().numpy() for name, tensor in tensors.items()}
        x, y, z = self.center.tolist()
        return packed_splats(Shared(**arrays), splats.degree, (x, y, z), trainer.world_offset)


def shared(
    vectors: Tensor,  # [M, C]
    sensitivity: Tensor,  # [M]
    threshold: float,
    entries: int,  # for the vectors whose sensitivity is not above the threshold
    steps: int,
    batch: int,
    decay: float,
    chance: torch.Generator,
) -> tuple[Tensor, Tensor]:  # [P, C], [M] int64
    """Entries, first those that are shared, and each vector's row: vectors above the threshold have their own."""
    own = sensitivity > threshold
    others = vectors[~own]
    codes = first_codes(others, entries, chance)
    labels = torch.zeros(len(vectors), dtype=torch.int64, device=vectors.device)
    if len(others):
        if len(codes) < len(others):
            weights = sensitivity[~own]
            codes = averaged_codes(others, codes, steps, chance, weights=weights, decay=decay, batch=batch)
        labels[~own] = nearest_codes(others, codes)
    labels[own] = len(codes) + torch.arange(int(own.sum()), device=vectors.device)
    return torch.cat([codes, vectors[own]]), labels
