"""EAGLES (Girish et al., ECCV 2024): integer latents with linear decoders, coarse images first, pruning by influence.

    latents (integers) ──linear decoders──► harmonics, rotation, opacity ─┐
    position, color, scale ────────────────────────────────────────────────┴──► splats ──► rasterize

What is as published, what is not and why: docs/methods/eagles.md.
"""

from typing import TYPE_CHECKING

from compgs.methods.eagles.settings import SCALED, EaglesConfig
from compgs.methods.method import PACKED_SUFFIX, SPLAT_SETTINGS, Method, write_itself

if TYPE_CHECKING:
    from compgs.model.splats import SplatModel
    from compgs.published.parts.content import Content
    from compgs.scene.views import Scene
    from compgs.training.run.run import Run


def train(scene: "Scene", config: EaglesConfig, run: "Run", start: "SplatModel | None" = None) -> "Content":
    """Raises as `compgs.train` does."""
    from compgs.methods.eagles.hooks import train_latents

    return train_latents(scene, config, run)


EAGLES = Method(
    name="eagles",
    description="3DGS with integer latents and linear decoders, trained from coarse images, pruned by influence",
    reference="Girish et al., EAGLES, ECCV 2024",
    suffix=PACKED_SUFFIX,
    uses=(*SPLAT_SETTINGS, "eagles"),
    train=train,
    write=write_itself,
    settings=EaglesConfig,
    presets={"scaled": {"eagles": SCALED}},
)
