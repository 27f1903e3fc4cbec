"""Which anchors a training view may show: by the bound that culls a decoded scene, measured now and then.

An anchor's sphere holds all that is drawn of its coupled primitives (`tensors.prediction.drawn_reach`). To know it
exactly the geometry of all anchors must be predicted, also of those out of view: too much for every step. So it is
measured at times, in units of the anchor's own size, which follows every step, and what changes until the next time is
left for by a margin. In a short run (plush, 240 steps) nothing that a view showed was missed, and 3 % more anchors were
looked at than there were to see; with a margin of 1.25 it is 2 %, and one anchor in 16 000 is missed. A fixed number
of the anchor's sizes in place of a measurement let 5 % more through, and missed one in 7 500.
"""

import math
from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor

from compgs.cameras import Camera
from compgs.entropy import Quantized
from compgs.render import RasterSettings
from compgs.scene.views import Scene
from compgs.tensors import where
from compgs.tensors.prediction import (
    Geometry,
    Prediction,
    camera_center,
    drawn_reach,
    predict,
    predict_geometry,
)
from compgs.tensors.visibility import visible_mask
from compgs.trained_model import TrainedModel
from compgs.training.plan import LOOKED_AT
from compgs.training.run.distributed import share_of_rank, sum_over_ranks
from compgs.training.run.restoring import check_tensor
from compgs.training.structure.importance import spread, view_contributions
from compgs.training.structure.pruning import pruning_camera, squared_changes

MARGIN = 1.5  # for what changes between two measurements
EVERY = 32  # steps between two; geometry alone, without gradients, is about a twentieth of a step
MEASURED_AT_ONCE = 20_000  # anchors: memory stays near the size of the result

Measure = Callable[[Tensor], tuple[Tensor, Tensor]]  # rows [V] -> means, scales [V * K, 3], world units


class AnchorBounds:
    """Radii of the anchors' spheres, from the last measurement."""

    def __init__(self, model: TrainedModel, geometry: Measure) -> None:
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


class Survey:
    """What the training views see of the model as it is now."""

    def __init__(
        self, model: TrainedModel, scene: Scene, settings: RasterSettings, step: Callable[[], int]
    ) -> None:
        """`scene`: in the model's local frame; `step`: returns the step of the run, which random signs go by."""
        self.model = model
        self.scene = scene
        self.settings = settings
        self.step = step
        self.bounds = AnchorBounds(model, self.geometry)

    @property
    def shape(self) -> tuple[int, int]:
        """N, K."""
        return self.model.anchors, self.model.dimensions.coupled_primitives

    @torch.no_grad()
    def visible_anchors(self, camera: Camera) -> Tensor:
        """[V] int64: anchors whose primitives may be in the image."""
        positions, radii = self.model.positions(), self.bounds.radii()
        return torch.nonzero(visible_mask(positions, radii, camera, self.settings)).view(-1)

    @torch.no_grad()
    def coupled_means(self) -> Tensor:
        """[N, K, 3] world units: where the coupled primitives are now."""
        k = self.model.dimensions.coupled_primitives
        every = torch.arange(self.model.anchors, device=self.model.device).split(MEASURED_AT_ONCE)
        return torch.cat([self.geometry(rows)[0].view(-1, k, 3) for rows in every])

    @torch.no_grad()
    def geometry(self, rows: Tensor) -> tuple[Tensor, Tensor]:
        """Means and scales [V * K, 3] of all coupled primitives of the anchors in `rows` [V] int64, world units."""
        p = self.model.primitives(self.model.quantized(rows, stored_weights=False), rows)
        means, scales, _ = predict_geometry(self.model.heads, p, p.residuals, p.anchor_index)
        return means, scales

    def predicted(self, camera: Camera) -> tuple[Tensor, Prediction] | None:
        """The anchors [V] that a camera may show and their primitives as the file would have them; None if there are
        none.
        """
        rows = self.visible_anchors(camera)
        if len(rows) == 0:
            return None
        return rows, predict_view(self.model, self.model.quantized(rows), rows, camera, stored=True)

    def contributions(self, most: int = LOOKED_AT) -> Tensor:
        """[N, K] float64: what the coupled primitives add to the training views, or to at most `most` of them."""
        views = share_of_rank(spread(self.scene.train_views, most))
        with self.model.weights_at_rest():
            total = view_contributions(views, self.predicted, self.shape, self.settings, self.model.device)
        sum_over_ranks(total)
        return total

    def changes(self, most: int = LOOKED_AT) -> Tensor:
        """[N] float64: mean squared change of a value of the training views, or of at most `most` of them, without an
        anchor; of large ones with sides halved. Infinite: none of these may show the anchor, but another view might.
        """
        views = self.scene.train_views
        cameras = [pruning_camera(view.camera) for view in spread(views, most)]
        numbered = share_of_rank(
            [(self.step() * len(cameras) + number, camera) for number, camera in enumerate(cameras)]
        )
        with self.model.weights_at_rest():
            total, shown_by = squared_changes(
                numbered, self.predicted, self.shape, self.settings, self.model.device
            )
        sum_over_ranks(total)
        sum_over_ranks(shown_by)
        if len(cameras) < len(views):
            total[shown_by == 0] = math.inf
        return total / sum(3 * camera.width * camera.height for camera in cameras)


def predict_view(
    model: TrainedModel,
    latents: Quantized,
    rows: Tensor,  # [V] int64 anchors
    camera: Camera,
    *,
    stored: bool,  # with the heads' weights as the file will hold them
    geometry: Geometry | None = None,  # predicted already
) -> Prediction:
    """Predict the primitives of anchors in view; on the GPU all of them, as choosing would make the CPU wait."""
    return predict(
        model.heads,
        model.primitives(latents, rows),
        camera_center(camera, model.device),
        model.distance_unit,
        model.stored_head_weights() if stored else None,
        compact=where.choosing_pays(model.device),
        geometry=geometry,
    )
