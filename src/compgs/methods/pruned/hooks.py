"""Pruning at the start of a phase."""

from typing import TYPE_CHECKING

from compgs.methods.parts.significance import all_but_lowest, view_significance
from compgs.training.plan import PRUNED_BY
from compgs.training.splats.hooks import Hooks
from compgs.training.structure.importance import spread

if TYPE_CHECKING:
    from compgs.training.splats.hooks import SplatRun


class Pruned(Hooks):
    """The splats of least blending weight over the training views go, before the first step."""

    def __init__(self, share: float) -> None:
        super().__init__()
        self.share = share

    def begin(self, trainer: "SplatRun") -> None:
        cameras = [view.camera for view in spread(trainer.scene.train_views, PRUNED_BY)]
        weights = view_significance(trainer.as_drawn(), cameras, trainer.settings)
        kept = all_but_lowest(weights, self.share)
        if not kept.all():
            trainer.keep(kept)
