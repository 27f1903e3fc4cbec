"""The program's own method: hybrid primitives, trained for rate and distortion, in a .cgs file."""

from pathlib import Path
from typing import TYPE_CHECKING

from compgs.methods.method import Method

if TYPE_CHECKING:
    from compgs.config import Config
    from compgs.model.splats import SplatModel
    from compgs.scene.views import Scene
    from compgs.trained_model import TrainedModel
    from compgs.training.run.run import Run


def _train(scene: "Scene", config: "Config", run: "Run", start: "SplatModel | None" = None) -> "TrainedModel":
    from compgs.training.hybrid import train_hybrid

    return train_hybrid(scene, config, run)


def _write(model: "TrainedModel", path: Path, config: "Config") -> int:
    from compgs.codec import encode

    return encode(model, path, overwrite=True).bytes


COMPGS = Method(
    name="compgs",
    description="hybrid primitives, rate and distortion",
    reference="Liu et al., CompGS, ACM MM 2024",
    suffix=".cgs",
    uses=("model", "entropy", "control", "training"),
    train=_train,
    write=_write,
)
