"""Adaptive control of the anchors: growth where the image still pulls, pruning where nothing is seen.

The paper leaves it to Scaffold-GS (Lu et al. 2023): coupled primitives whose 2D means keep a large gradient ask for new
anchors on three grids of 16, 4 and 1 voxels; anchors whose primitives are transparent are removed. Schedules are
fractions of the run, so that short and long runs go through the same phases.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from compgs.cameras import Camera
from compgs.config import Config, ControlConfig
from compgs.entropy.models import starting_residuals
from compgs.model.prediction import Prediction
from compgs.trained_model import TrainedModel
from compgs.training.optimizers import replace_rows

# (gradient threshold factor, grid size in voxels), coarse first
GROWTH_LEVELS = ((1.0, 16), (2.0, 4), (4.0, 1))
# lambda at which settings of growth and pruning are meant as they are given, and the range in which they follow it:
# below 1e-6 more anchors took half as many bytes again and brought nothing (docs/results/experiments.md, fifth series)
USUAL_LAMBDA, LAMBDA_RANGE = 0.002, (1e-6, 0.1)
COORDINATE_LIMIT = 1 << 20  # voxels: what the octree coder can hold


@dataclass(frozen=True)
class ControlSchedule:
    """Steps at which control acts: `start`, then every `every` until `stop`."""

    start: int
    stop: int
    every: int

    def active(self, step: int) -> bool:
        """Statistics are gathered in this step."""
        return step < self.stop

    def due(self, step: int) -> bool:
        return self.start <= step < self.stop and (step - self.start) % self.every == 0


def make_schedule(config: ControlConfig, steps: int, views: int) -> ControlSchedule:
    """Fractions of the run in steps; every view is seen about once between two controls."""
    every = max(1, round(config.every * steps), views)
    return ControlSchedule(max(1, round(config.start * steps)), round(config.stop * steps), every)


def rate_weight(config: ControlConfig, lmbda: float) -> float:
    """How much more an anchor has to add to the image than at the usual lambda, since it costs bits."""
    least, most = LAMBDA_RANGE
    return (min(max(lmbda, least), most) / USUAL_LAMBDA) ** config.rate_exponent


class AdaptiveControl:
    """Statistics of the coupled primitives since they were last judged, and what follows from them."""

    def __init__(self, config: Config, schedule: ControlSchedule, anchors: int, device: torch.device) -> None:
        self.config = config
        self.schedule = schedule
        k = config.model.coupled_primitives
        self.gradient = torch.zeros(anchors, k, device=device)  # sum of 2D gradient norms, in half images
        self.drawn = torch.zeros(anchors, k, device=device)  # views in which the primitive was drawn
        self.opacity = torch.zeros(anchors, device=device)  # sum over views and slots
        self.seen = torch.zeros(anchors, device=device)  # views in which the anchor was visible

    STATISTICS = ("gradient", "drawn", "opacity", "seen")

    @torch.no_grad()
    def observe(self, rows: Tensor, prediction: Prediction, mean_gradient: Tensor, camera: Camera) -> None:
        """One training view: visible anchors [V], their prediction, gradient of the loss by the 2D means [M, 2]."""
        k = self.config.model.coupled_primitives
        norms = torch.hypot(
            mean_gradient[:, 0] * (camera.width / 2), mean_gradient[:, 1] * (camera.height / 2)
        )
        slots = rows[prediction.index // k] * k + prediction.index % k
        drawn = norms > 0
        self.gradient.view(-1).index_put_((slots,), norms, accumulate=True)
        self.drawn.view(-1).index_put_((slots,), drawn.to(norms.dtype), accumulate=True)
        self.seen[rows] += 1
        self.opacity[rows] += prediction.opacities.clamp_min(0).view(-1, k).sum(1)

    @torch.no_grad()
    def act(
        self,
        model: TrainedModel,
        optimizer: torch.optim.Adam,
        means: Tensor,
        noise: torch.Generator,
        lmbda: float,
    ) -> None:
        """Grow and prune. means: [N, K, 3] of all coupled primitives, world units; lmbda: the rate's present weight."""
        c, n = self.config.control, model.anchors
        judged = self.drawn >= min(c.minimum_views, 2 * self.schedule.every)
        mean_gradient = self.gradient / self.drawn.clamp_min(1)
        added = self._grow(model, means, torch.where(judged, mean_gradient, 0.0), noise, lmbda)
        self.gradient[judged] = 0
        self.drawn[judged] = 0

        ripe = self.seen >= max(5, self.schedule.every // 10)
        transparent = self.opacity / self.seen.clamp_min(1) < c.opacity_threshold
        kept = ~(ripe & transparent)
        if not kept.any():
            kept[:] = True
        self.opacity[ripe] = 0
        self.seen[ripe] = 0

        new = len(added["coordinates"])
        if new or not kept.all():
            self._replace(model, optimizer, kept, added)
        assert model.anchors == int(kept.sum()) + new and len(kept) == n

    @torch.no_grad()
    def keep(self, model: TrainedModel, optimizer: torch.optim.Adam, kept: Tensor) -> None:
        """Remove all anchors but those that are `kept`, [N] bool."""
        none = {
            name: getattr(model, name).detach()[:0]
            for name in (*model.anchor_parameters, "coordinates", "mask")
        }
        self._replace(model, optimizer, kept, none)

    def _replace(
        self, model: TrainedModel, optimizer: torch.optim.Adam, kept: Tensor, added: dict[str, Tensor]
    ) -> None:
        replace_rows(model, optimizer, kept, added)
        new = len(added["coordinates"])
        for name in self.STATISTICS:
            old = getattr(self, name)
            setattr(self, name, torch.cat([old[kept], old.new_zeros(new, *old.shape[1:])]))

    def _grow(
        self, model: TrainedModel, means: Tensor, gradient: Tensor, noise: torch.Generator, lmbda: float
    ) -> dict[str, Tensor]:
        """New anchors by name of their parameter. gradient: [N, K], 0 where not judged."""
        c, m = self.config.control, self.config.model
        flat = gradient.view(-1)
        target = torch.round(means.view(-1, 3) / model.voxel_size)
        taken = model.coordinates.to(torch.int64)
        room = m.max_anchors - model.anchors
        threshold = c.gradient_threshold * rate_weight(c, lmbda)
        grown: dict[str, list[Tensor]] = {name: [] for name in ("coordinates", "references", "log_scales")}
        for level, (factor, size) in enumerate(GROWTH_LEVELS):
            asks = flat >= threshold * factor
            asks &= torch.rand(len(flat), generator=noise, device=flat.device) < c.growth_probability ** (
                level + 1
            )
            asks &= (target.abs() < COORDINATE_LIMIT - 16).all(1)
            slots = torch.nonzero(asks).view(-1)
            if len(slots) == 0 or room <= 0:
                continue
            cells = _cell(target[slots].to(torch.int64), size)
            occupied = torch.unique(_key(_cell(taken, size)))
            key = _key(cells)
            free = ~torch.isin(key, occupied)
            slots, cells, key = slots[free], cells[free], key[free]
            unique, inverse = torch.unique(key, return_inverse=True)
            if len(unique) == 0:
                continue
            first = torch.full_like(unique, len(key))
            first.scatter_reduce_(0, inverse, torch.arange(len(key), device=key.device), "amin")
            chosen = cells[first] * size
            parents = model.references.detach()[slots // m.coupled_primitives]
            references = parents.new_full((len(unique), model.reference_dim), -torch.inf)
            references.scatter_reduce_(0, inverse[:, None].expand_as(parents), parents, "amax")
            grown["coordinates"].append(chosen[:room])
            grown["references"].append(references[:room])
            grown["log_scales"].append(references.new_full((len(unique), 6), float(size)).log()[:room])
            taken = torch.cat([taken, chosen[:room]])
            room -= len(chosen[:room])
        new = sum(len(x) for x in grown["coordinates"])
        empty = {
            "coordinates": (0, 3),
            "references": (0, model.reference_dim),
            "log_scales": (0, 6),
        }
        rows = {name: torch.cat([*parts, means.new_zeros(empty[name])]) for name, parts in grown.items()}
        return {
            "coordinates": rows["coordinates"].to(torch.int32),
            "references": rows["references"],
            "log_scales": rows["log_scales"],
            "residuals": starting_residuals(model.entropy, m).repeat(new, 1),
            "mask": model.mask.new_ones(new, m.coupled_primitives),
        }


def _cell(coordinates: Tensor, size: int) -> Tensor:
    """[N, 3] cell of a grid of `size` voxels whose centre is nearest."""
    return torch.div(coordinates + size // 2, size, rounding_mode="floor")


def _key(cells: Tensor) -> Tensor:
    """One int64 a cell, 21 bits an axis."""
    shifted = cells + COORDINATE_LIMIT
    return (shifted[:, 0] << 42) | (shifted[:, 1] << 21) | shifted[:, 2]
