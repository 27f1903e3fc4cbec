"""Scaffold-GS (Lu et al., CVPR 2024): anchors that spawn ten Gaussians each by view-dependent networks, uncompressed.

The ancestor of the anchor methods: all that is trained is in `compgs.methods.anchors`, which COSA-GS builds on, too.
What is as published, what is not and why: docs/methods/scaffold-gs.md.
"""

from pathlib import Path
from typing import TYPE_CHECKING

from compgs.methods.anchors.settings import ANCHOR_SETTINGS
from compgs.methods.method import PACKED_SUFFIX, Method
from compgs.methods.scaffold_gs.settings import PUBLISHED, SCALED, ScaffoldConfig

if TYPE_CHECKING:
    from compgs.methods.anchors.model import AnchorModel
    from compgs.model.splats import SplatModel
    from compgs.scene.views import Scene
    from compgs.training.run.run import Run


def train(
    scene: "Scene", config: ScaffoldConfig, run: "Run", start: "SplatModel | None" = None
) -> "AnchorModel":
    """Raises as `compgs.train` does."""
    from compgs.methods.anchors.trainer import AnchorTrainer, train_anchors

    model: AnchorModel = train_anchors(AnchorTrainer, scene, config, run)
    return model


def write(model: "AnchorModel", path: Path, config: ScaffoldConfig) -> int:
    from compgs.published.scaffold_gs import write_anchors

    return write_anchors(model.as_hybrid_model(), path)


SCAFFOLD_GS = Method(
    name="scaffold-gs",
    description="anchors that spawn Gaussians by view-dependent networks, uncompressed",
    reference="Lu et al., Scaffold-GS, CVPR 2024",
    suffix=PACKED_SUFFIX,
    uses=ANCHOR_SETTINGS,
    train=train,
    write=write,
    settings=ScaffoldConfig,
    presets={
        "paper": PUBLISHED,
        "quick": {**PUBLISHED, "training": {**PUBLISHED["training"], "steps": 4_000}},
        "scaled": SCALED,
    },
)
