"""Settings of EAGLES."""

from dataclasses import dataclass, field
from typing import Annotated

from compgs.config import Config, LearningRate, Positive, Range, Share, SplatConfig

Latents = Annotated[int, Range(1, 64)]


@dataclass(frozen=True)
class EaglesSection:
    """Settings of the authors' release; schedules as fractions of its 30 000 steps."""

    # integers of a splat that its harmonics above degree 0 are decoded from
    harmonics_latents: Latents = 16
    # integers of a splat that its rotation is decoded from
    rotation_latents: Latents = 8
    # size of the decoders' first weights
    harmonics_decoder: Positive = 5e-4
    rotation_decoder: Positive = 0.01
    opacity_decoder: Positive = 0.5
    # of the decoders' weights
    harmonics_decoder_lr: LearningRate = 5e-3
    rotation_decoder_lr: LearningRate = 0.01
    opacity_decoder_lr: LearningRate = 0.3
    # learning rate of latents, as a share of the one that what they decode to would have (`splats`)
    latent_lr: Positive = 0.1
    # of the photographs' size, in the first step
    smallest_image: Annotated[float, Range(0, 1, above=True)] = 0.3
    # of the steps until images have their full size
    coarse_until: Share = 0.7
    # of the steps between two prunings (5 100 of 30 000), and the last step at which one may come
    prune_every: Annotated[float, Range(0, 1, above=True)] = 0.17
    prune_until: Share = 0.9
    # of the splats that go each time: those with the least influence
    prune_share: Annotated[float, Range(0, 1, below=True)] = 0.15


def _splats() -> SplatConfig:
    """Growth lasts longer than in plain 3DGS, and is rarer."""
    return SplatConfig(densify_every=1 / 240, densify_stop=0.6, reset_every=1 / 12)


@dataclass(frozen=True)
class EaglesConfig(Config):
    """Holds the settings of EAGLES, with its own schedule of growth: each 125 steps until 18 000 of 30 000, resets each
    2 500.
    """

    splats: SplatConfig = field(default_factory=_splats)
    eagles: EaglesSection = field(default_factory=EaglesSection)


# For runs of hundreds or few thousands of steps: latents that move faster than 1 / 10 of what they decode to, and
# decoders that move less. At the published rates no harmonic has left zero by then.
SCALED = {
    "latent_lr": 10.0,
    "harmonics_decoder": 2e-3,
    "harmonics_decoder_lr": 1e-3,
    "opacity_decoder": 0.1,
    "opacity_decoder_lr": 1e-3,
}
