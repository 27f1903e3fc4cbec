"""COSA-GS (arXiv 2609.30245): anchors in a causal chain, the bits of the whole scene in the loss.

docs/methods/cosa-gs.md says what is as published. `shape` names the chain's parts; `entropy` has it with gradients,
`chain` in integers; `writer` and `reader` are each other's mirror image.
"""

from pathlib import Path
from typing import TYPE_CHECKING

from compgs.methods.cosa.settings import PRESETS, SETTINGS, CosaConfig
from compgs.methods.method import PACKED_SUFFIX, Method

if TYPE_CHECKING:
    from compgs.methods.cosa.model import CosaModel
    from compgs.model.splats import SplatModel
    from compgs.scene.views import Scene
    from compgs.training.run.run import Run


def _train(scene: "Scene", config: CosaConfig, run: "Run", start: "SplatModel | None" = None) -> "CosaModel":
    from compgs.methods.anchors.trainer import train_anchors
    from compgs.methods.cosa.trainer import CosaTrainer

    return train_anchors(CosaTrainer, scene, config, run)


def _write(model: "CosaModel", path: Path, config: CosaConfig) -> int:
    from compgs.methods.cosa.writer import write

    return write(model, path)


COSA = Method(
    name="cosa-gs",
    description="anchors in a causal chain, bits of the whole scene in the loss",
    reference="COSA-GS, arXiv 2609.30245, 2026",
    suffix=PACKED_SUFFIX,
    uses=SETTINGS,
    train=_train,
    write=_write,
    settings=CosaConfig,
    presets=PRESETS,
)
