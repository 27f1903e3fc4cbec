"""Which anchors a training view may show: by the bound that culls a decoded scene, measured now and then.

An anchor's sphere holds all that is drawn of its coupled primitives (`tensors.prediction.drawn_reach`). To know it
exactly the geometry of all anchors must be predicted, also of those out of view: too much for every step. So it is
measured at times, in units of the anchor's own size, which follows every step, and what changes until the next time is
left for by a margin. In a short run (plush, 240 steps) nothing that a view showed was missed, and 3 % more anchors were
looked at than there were to see; with a margin of 1.25 it is 2 %, and one anchor in 16 000 is missed. A fixed number
of the anchor's sizes in place of a measurement let 5 % more through, and missed one in 7 500.
"""

from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor

from compgs.tensors.prediction import drawn_reach
from compgs.trained_model import TrainedModel
from compgs.training.run.restoring import check_tensor

MARGIN = 1.5  # for what changes between two measurements
EVERY = 32  # steps between two; geometry alone, without gradients, is about a twentieth of a step
MEASURED_AT_ONCE = 20_000  # anchors: memory stays near the size of the result

Geometry = Callable[[Tensor], tuple[Tensor, Tensor]]  # rows [V] -> means, scales [V * K, 3], world units


class AnchorBounds:
    """Radii of the anchors' spheres, from the last measurement."""

    def __init__(self, model: TrainedModel, geometry: Geometry) -> None:
        self.model = model
        self.geometry = geometry
        self.measured: Tensor | None = (
            None  # [N] in sizes of the anchors; None: to be measured when it is needed
        )

    def forget(self) -> None:
        """The anchors are others, or have changed much."""
        self.measured = None

    def after_step(self, step: int) -> None:
        """Forget what is too old: early in a run, when the heads learn fast, after fewer steps."""
        if step % EVERY == 0 or step & (step - 1) == 0:
            self.forget()

    @torch.no_grad()
    def radii(self) -> Tensor:
        """[N] world units."""
        if self.measured is None or len(self.measured) != self.model.anchors:
            self.measured = self._measure() / self._sizes()
        return MARGIN * self.measured * self._sizes()

    def tensors(self) -> dict[str, Tensor]:
        """The last measurement, for a checkpoint, if there is one."""
        return {} if self.measured is None else {"bounds": self.measured}

    def state(self) -> dict[str, Any]:
        """Nothing beside the tensors."""
        return {}

    def restore(self, tensors: Mapping[str, Tensor], state: Mapping[str, Any]) -> None:
        """Inverse of `tensors`. Raises ValueError."""
        if "bounds" in tensors:
            check_tensor(tensors["bounds"], (self.model.anchors,), torch.float32, "bounds")
            self.measured = tensors["bounds"].to(self.model.device)

    def _measure(self) -> Tensor:
        """[N] world units: as they are now."""
        model, parts = self.model, []
        for rows in torch.arange(model.anchors, device=model.device).split(MEASURED_AT_ONCE):
            means, scales = self.geometry(rows)
            shape = len(rows), -1, 3
            offsets = means.view(shape) - model.positions(rows)[:, None]
            parts.append(drawn_reach(offsets, scales.view(shape)).amax(1))
        return torch.cat(parts)

    def _sizes(self) -> Tensor:
        """[N] world units: the largest number of each anchor's covariance."""
        return self.model.log_scales.detach().amax(1).exp() * self.model.voxel_size
