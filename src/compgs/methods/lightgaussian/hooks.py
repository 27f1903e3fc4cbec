"""Pruning, what follows it, distillation, and the codebook at the end."""

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from compgs.cameras import Camera
from compgs.formats.packed import Packed
from compgs.losses import Target
from compgs.methods.lightgaussian.settings import LightGaussianConfig, LightGaussianSection
from compgs.methods.parts.books import entries_within
from compgs.methods.parts.significance import all_but_lowest, view_significance
from compgs.methods.parts.vector_quantization import averaged_codes, first_codes, nearest_codes
from compgs.model.degrees import degree_of, harmonics_above_dc
from compgs.published.lightgaussian import codebook_bytes, packed_splats, splat_bytes
from compgs.tensors.rasterize import rasterize
from compgs.tensors.splats import Splats, splat_gaussians, splat_radii
from compgs.tensors.visibility import visible_mask
from compgs.training.plan import PRUNED_BY
from compgs.training.splats.hooks import Hooks
from compgs.training.structure.importance import spread

if TYPE_CHECKING:
    from compgs.training.splats.hooks import SplatRun

SEED = 13  # of the first codes, beside the run's
LARGE = 0.9  # of the splats are not smaller than the one whose volume counts as 1
JITTERED = 3  # steps: in all but the first of so many the camera is moved


class Pruned(Hooks):
    """The splats of least significance go, and the others settle."""

    def __init__(self, section: LightGaussianSection) -> None:
        super().__init__()
        self.section = section
        self.slowing = section.settled_slowing

    def begin(self, trainer: "SplatRun") -> None:
        kept = all_but_lowest(significance(trainer, self.section.volume_power), self.section.prune)
        if not kept.all():
            trainer.keep(kept)

    def estimated_bytes(self, trainer: "SplatRun") -> int:
        return estimated_bytes(trainer, self.section)


class Distilled(Hooks):
    """The splats as they are when it begins teach themselves to do with fewer harmonics.

    The views they are rendered for are the training views, two of three a little aside. Opacities stay.
    """

    def __init__(self, section: LightGaussianSection, seed: int) -> None:
        super().__init__()
        self.section = section
        self.seed = seed
        self.slowing = section.distilled_slowing

    def begin(self, trainer: "SplatRun") -> None:
        for name, value in vars(trainer.parameters.trained()).items():
            self.register_buffer(f"teacher_{name}", value)

    def teacher(self) -> Splats:
        return Splats(**{name: getattr(self, f"teacher_{name}") for name in Splats.__dataclass_fields__})

    def view(self, camera: Camera, photograph: Target, trainer: "SplatRun") -> tuple[Camera, Target]:
        camera = self.aside(camera, trainer.step, trainer.scene.extent)
        with torch.no_grad():
            teacher = self.teacher()
            inside = visible_mask(teacher.means, splat_radii(teacher), camera, trainer.settings)
            gaussians = splat_gaussians(teacher, camera, visible=inside)
            image = rasterize(gaussians, camera, trainer.settings).image
            return camera, Target((255 * image.clamp(0, 1)).round().to(torch.uint8))

    def aside(self, camera: Camera, step: int, extent: float) -> Camera:
        """Where a step looks from; a step alone says it, so that nothing need be kept of the chance."""
        if step % JITTERED == 0:
            return camera
        chance = np.random.default_rng((self.seed, step))
        return camera.moved(self.section.jitter * extent * chance.normal(size=3))

    def transform(self, splats: Splats, trainer: "SplatRun") -> Splats:
        kept = harmonics_above_dc(self.section.degree)
        above = torch.zeros_like(splats.rest[:, kept:])
        return replace(
            splats,
            opacity_logits=splats.opacity_logits.detach(),
            rest=torch.cat([splats.rest[:, :kept], above], 1),
        )

    def estimated_bytes(self, trainer: "SplatRun") -> int:
        return estimated_bytes(trainer, self.section)


@torch.no_grad()
def significance(trainer: "SplatRun", volume_power: float) -> Tensor:
    """[M] float64: blending weights over the training views, times a power of the splats' volumes.

    A volume counts in those of the splat that LARGE of all splats are not smaller than.
    """
    splats = trainer.as_drawn()
    cameras = [view.camera for view in spread(trainer.scene.train_views, PRUNED_BY)]
    weights = view_significance(splats, cameras, trainer.settings)
    volumes = splats.log_scales.double().sum(1)
    descending = torch.sort(volumes, descending=True).values
    unit = descending[min(int(LARGE * len(volumes)), len(volumes) - 1)]
    return weights * (volume_power * (volumes - unit)).exp()


def entries(section: LightGaussianSection, splats: int, degree: int) -> int:
    """Return the entries of the codebook, for so many splats."""
    other = splats * splat_bytes(section.coded, section.codebook, degree)
    return entries_within(
        section.codebook, other, lambda codes: codebook_bytes(codes, degree), section.codebook_share
    )


def estimated_bytes(trainer: "SplatRun", section: LightGaussianSection) -> int:
    """Estimate the bytes before DEFLATE."""
    count = len(trainer.parameters)
    degree = min(section.degree, degree_of(trainer.parameters.rest.shape[1]))
    codes = max(1, min(entries(section, count, degree), int(section.coded * count)))
    return round(count * splat_bytes(section.coded, codes, degree)) + codebook_bytes(codes, degree)


@torch.no_grad()
def content(trainer: "SplatRun", config: LightGaussianConfig) -> Packed:
    """Return the content of the file, after the last step."""
    section, device = config.lightgaussian, trainer.device
    splats = trainer.parameters.trained()
    splats = replace(splats, rest=splats.rest[:, : harmonics_above_dc(section.degree)])
    important = significance(trainer, section.volume_power)
    coded = torch.ones(len(splats), dtype=torch.bool, device=device)
    if section.coded < 1:
        coded = ~all_but_lowest(important, section.coded)
    colors = torch.cat([splats.dc, splats.rest.flatten(1)], 1)[coded]
    chance = torch.Generator().manual_seed(config.training.seed + SEED)
    codes = first_codes(colors, entries(section, len(splats), splats.degree), chance)
    if len(codes) < len(colors):
        codes = averaged_codes(
            colors,
            codes,
            section.codebook_steps,
            chance,
            weights=important[coded],
            decay=section.decay,
            batch=section.codebook_batch,
            reseeded=section.reseeded,
        )
    labels = nearest_codes(colors, codes) if len(codes) else torch.zeros(0, dtype=torch.int64)
    return packed_splats(
        splats.arrays(trainer.world_offset),
        *(tensor.cpu().numpy() for tensor in (coded, labels, codes)),
    )
