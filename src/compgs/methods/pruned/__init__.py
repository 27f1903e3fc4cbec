"""Plain 3DGS, most of its splats removed, in the files that people keep it in: what one does without a codec.

    plain 3DGS ──► the splats that the training views show least go ──► the others settle ──► .spz or .sog
    the run        four of five                                         1/3 more steps

It is no method of one paper: removing splats by their blending weights and settling is common to most of them.
"""

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Annotated

from compgs.config import Config, Range
from compgs.methods.method import SPLAT_SETTINGS, Method
from compgs.methods.splats import SOG, SPZ, check_near

if TYPE_CHECKING:
    from compgs.model.splats import SplatModel
    from compgs.scene.views import Scene
    from compgs.training.run.run import Run

SECTION = "pruned"


@dataclass(frozen=True)
class PrunedSection:
    """What goes, and how long the rest settles."""

    # of the splats: those of least blending weight over the training views go
    prune: Annotated[float, Range(0, 1, below=True)] = 0.8
    # steps after pruning, of the run's, which they follow
    settled: Annotated[float, Range(0, 10)] = 1 / 3


@dataclass(frozen=True)
class PrunedConfig(Config):
    """Settings of plain 3DGS, and of the pruning."""

    pruned: PrunedSection = field(default_factory=PrunedSection)


def train(
    scene: "Scene", config: PrunedConfig, run: "Run", start: "SplatModel | None" = None
) -> "SplatModel":
    """The splats that stay. With `start`, these are pruned. Raises as `compgs.train` does."""
    from compgs.methods.pruned.hooks import Pruned
    from compgs.training.splats.phases import Phase, fine_tuning, train_phases

    check_near(scene, run.method)
    settled = fine_tuning(config, max(1, round(config.pruned.settled * config.training.steps)))
    phases = (Phase(config), Phase(settled, lambda: Pruned(config.pruned.prune)))
    return train_phases(scene, phases, run, start).model()


def _pruned(method: Method, name: str) -> Method:
    """The same file as a method of plain splats has, of fewer splats."""
    return Method(
        name=name,
        description=f"plain 3DGS, four of five splats pruned, in the file of {method.name}",
        reference=method.reference,
        suffix=method.suffix,
        uses=(*SPLAT_SETTINGS, SECTION),
        train=train,
        write=method.write,
        settings=PrunedConfig,
        from_splats=True,
    )


PRUNED_SPZ = _pruned(SPZ, "pruned-spz")
PRUNED_SOG = _pruned(SOG, "pruned-sog")
