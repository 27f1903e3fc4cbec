"""Adaptive control of the anchors: growth where the image's gradient is large, pruning of what nobody sees.

The paper leaves it to Scaffold-GS (Lu et al. 2023): coupled primitives whose 2D means keep a large gradient ask for new
anchors on three grids of 16, 4 and 1 voxels; anchors whose primitives are transparent are removed.

The schedule is fractions of the run, so that short and long runs go through the same phases. The authors' release
counts passes over the V training views instead: statistics from 3 V steps on, control from 5 V, every 2 V, until half
of 30 000 steps. So a variant may count passes, too (`variants.py`), and what comes first
holds. With the `paper` preset 30 000 steps over 103 views or more go as published. A run too short for that keeps the
fractions: seven controls, or as many as there is a whole pass for before each.

In few steps a primitive cannot be seen often. The published minimum of more than 40 sightings between two controls,
2 V steps apart, would never judge what fewer than 21 views show. So a share of the steps between two controls is
enough (`minimum_share`). From 103 views on, a fifth of 2 V steps is no less than the published minimum.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from compgs.cameras import Camera
from compgs.config import Config, ControlConfig
from compgs.scene.points import COORDINATE_BITS
from compgs.tensors.prediction import Prediction
from compgs.training.optimizers import AnchorRows, replace_rows
from compgs.training.plan import growth_factor
from compgs.training.structure.variants import VARIANTS

# (gradient threshold factor, grid size in voxels), coarse first
GROWTH_LEVELS = ((1.0, 16), (2.0, 4), (4.0, 1))
COORDINATE_LIMIT = 1 << (COORDINATE_BITS - 1)  # voxels


@dataclass(frozen=True)
class ControlSchedule:
    """Steps, counted from 0, after which control acts: `start`, then every `every` before `stop`.

    Statistics are gathered from step `observe` on, `stop` excluded.
    """

    start: int
    stop: int
    every: int
    observe: int = 0
    views: int = 1  # of a step

    @property
    def between(self) -> int:
        """Views that are looked at between two controls."""
        return self.every * self.views

    def active(self, step: int) -> bool:
        """Statistics are gathered in this step."""
        return self.observe <= step < self.stop

    def due(self, step: int) -> bool:
        return self.start <= step < self.stop and (step - self.start) % self.every == 0

    def ended(self, step: int) -> bool:
        """There is no control from this step on."""
        return step >= self.stop


def make_schedule(config: ControlConfig, steps: int, views: int, views_per_step: int = 1) -> ControlSchedule:
    """Fractions of the run in steps, or passes over the views where these end earlier; see the module's docstring.

    Between two controls every view is seen about once, at least. Statistics begin early enough for the first control
    to judge as many steps as the others.
    """

    def pass_steps(passes: float) -> int:
        # As if there were a hundred views at least, or control would come every few steps. The published scenes have
        # 109 training views and more.
        return round(passes * max(views, 100) / views_per_step)

    start, every = round(config.start * steps), round(config.every * steps)
    variant = VARIANTS[config.variant]
    if variant.start_passes is not None:  # Steps count from 0: the last of n passes is step n V - 1.
        start = min(start, pass_steps(variant.start_passes) - 1)
    if variant.every_passes is not None:
        every = min(every, pass_steps(variant.every_passes))
    start, every = max(1, start), max(1, every, math.ceil(views / views_per_step))
    observe = min(pass_steps(variant.observe_passes), start + 1 - every)
    return ControlSchedule(start, round(config.stop * steps), every, max(0, observe), views_per_step)


class Grows(AnchorRows, Protocol):
    """A model to which control adds anchors."""

    @property
    def voxel_size(self) -> float: ...

    @property
    def references(self) -> Tensor:
        """[N, C] what a new anchor has from those that asked for it: the largest of them, channel by channel."""
        ...

    def grown(self, coordinates: Tensor, references: Tensor, log_scale: Tensor) -> dict[str, Tensor]:
        """Rows of new anchors by name, as `replace_rows` takes them, at coordinates [A, 3] int32 with references [A, C]
        and the logarithm [A] of their cells' sizes in voxels.
        """
        ...


class AdaptiveControl:
    """Statistics of the coupled primitives since they were last judged, and what follows from them."""

    def __init__(
        self,
        config: Config,
        schedule: ControlSchedule,
        shape: tuple[int, int],  # N, K
        device: torch.device,
        followers: Sequence[Callable[[Tensor, int], None]] = (),
    ) -> None:
        """`followers`: told of every change which anchors are left, [N] bool, and how many new ones follow them."""
        self.config = config
        self.variant = VARIANTS[config.control.variant]
        self.schedule = schedule
        self.followers = followers
        anchors, k = shape
        self.gradient = torch.zeros(anchors, k, device=device)  # sum of 2D gradient norms, in half images
        self.drawn = torch.zeros(anchors, k, device=device)  # views in which the primitive was drawn
        self.opacity = torch.zeros(anchors, device=device)  # sum over views and slots
        self.seen = torch.zeros(anchors, device=device)  # views in which the anchor was visible

    STATISTICS = ("gradient", "drawn", "opacity", "seen")

    @torch.no_grad()
    def observe(self, rows: Tensor, prediction: Prediction, mean_gradient: Tensor, camera: Camera) -> None:
        """One training view: visible anchors [V], their prediction, gradient of the loss by the 2D means [M, 2]."""
        k = self.gradient.shape[1]
        norms = torch.hypot(
            mean_gradient[:, 0] * (camera.width / 2), mean_gradient[:, 1] * (camera.height / 2)
        )
        slots = rows[prediction.index // k] * k + prediction.index % k
        drawn = norms > 0
        # Each slot comes once, so that nothing is summed by atomics, and nothing sorted, on a GPU.
        self.gradient.view(-1).index_add_(0, slots, norms)
        self.drawn.view(-1).index_add_(0, slots, drawn.to(norms.dtype))
        self.seen[rows] += 1
        self.opacity[rows] += prediction.opacities.clamp_min(0).view(-1, k).sum(1)

    @torch.no_grad()
    def act(
        self,
        model: Grows,
        optimizer: torch.optim.Adam,
        means: Tensor,
        noise: torch.Generator,
        lmbda: float,
    ) -> None:
        """Grow and prune. means: [N, K, 3] of all coupled primitives, world units; lmbda: the rate's present weight."""
        c, n, views = self.config.control, model.anchors, self.schedule.between
        judged = self.drawn >= min(c.minimum_views, int(self.variant.minimum_share * views))
        gradient = torch.where(judged, self.gradient / self.drawn.clamp_min(1), 0.0)
        added = self._grow(model, means, gradient, noise, lmbda)

        ripe = self.seen >= max(self.variant.opacity_views, int(self.variant.opacity_share * views))
        transparent = self.opacity / self.seen.clamp_min(1) < c.opacity_threshold
        kept = ~(ripe & transparent)
        if not kept.any():
            kept[:] = True
        self._start_anew(judged, ripe)

        new = len(added["coordinates"])
        if new or not kept.all():
            self._replace(model, optimizer, kept, added)
        assert model.anchors == int(kept.sum()) + new and len(kept) == n

    def _start_anew(self, judged: Tensor, ripe: Tensor) -> None:
        """Zero statistics of the `judged` primitives [N, K] and the `ripe` anchors [N], bool, or of all."""
        if self.variant.reset_all:
            judged, ripe = torch.ones_like(judged), torch.ones_like(ripe)
        self.gradient[judged] = 0
        self.drawn[judged] = 0
        self.opacity[ripe] = 0
        self.seen[ripe] = 0

    @torch.no_grad()
    def keep(self, model: Grows, optimizer: torch.optim.Adam, kept: Tensor) -> None:
        """Remove all anchors but those that are `kept`, [N] bool."""
        none = {
            name: getattr(model, name).detach()[:0]
            for name in (*model.anchor_parameters, "coordinates", "mask")
        }
        self._replace(model, optimizer, kept, none)

    def _replace(
        self, model: Grows, optimizer: torch.optim.Adam, kept: Tensor, added: dict[str, Tensor]
    ) -> None:
        replace_rows(model, optimizer, kept, added)
        new = len(added["coordinates"])
        for name in self.STATISTICS:
            old = getattr(self, name)
            setattr(self, name, torch.cat([old[kept], old.new_zeros(new, *old.shape[1:])]))
        for follow in self.followers:
            follow(kept, new)

    def _grow(
        self, model: Grows, means: Tensor, gradient: Tensor, noise: torch.Generator, lmbda: float
    ) -> dict[str, Tensor]:
        """New anchors by name of their parameter. gradient: [N, K] mean norms, 0 where not judged."""
        c, k = self.config.control, means.shape[1]
        flat = gradient.view(-1)
        target = torch.round(means.view(-1, 3) / model.voxel_size)
        inside = (target.abs() < COORDINATE_LIMIT - 16).all(1)
        taken = model.coordinates.to(torch.int64)
        room = max(0, self.config.model.max_anchors - model.anchors)
        threshold = c.gradient_threshold * growth_factor(self.config, lmbda)
        coordinates, references = [taken[:0]], [model.references.detach()[:0]]
        log_scales = [means.new_zeros(0)]
        for level, ((factor, size), probability) in enumerate(
            zip(GROWTH_LEVELS, c.growth_probabilities, strict=True)
        ):
            if self.variant.finer_needs_coarser and level > 0 and len(taken) == model.anchors:
                break
            chance = torch.rand(len(flat), generator=noise, device=flat.device)
            slots = torch.nonzero((flat >= threshold * factor) & (chance < probability) & inside).view(-1)
            if len(slots) == 0 or room == 0:
                continue
            cells, asked = new_cells(target[slots].to(torch.int64), flat[slots], taken, size, room)
            parents = model.references.detach()[slots[asked >= 0] // k]
            coordinates.append(cells)
            references.append(largest(parents, asked[asked >= 0], len(cells)))
            log_scales.append(means.new_full((len(cells),), float(size)).log())
            taken = torch.cat([taken, cells])
            room -= len(cells)
        return model.grown(
            torch.cat(coordinates).to(torch.int32), torch.cat(references), torch.cat(log_scales)
        )


def new_cells(
    target: Tensor,  # [C, 3] int64 voxels, where candidates are
    gradient: Tensor,  # [C] mean gradient of their primitives
    taken: Tensor,  # [N, 3] int64 voxels, anchors that there are
    size: int,  # voxels to a cell of the grid
    room: int,  # new anchors that are allowed
) -> tuple[Tensor, Tensor]:
    """Cells of the grid that candidates ask for and no anchor is in, as [A, 3] int64 voxels of their centres, and for
    each candidate which of them it asked for, [C] int64, -1: none.

    If all would be too many, those with the largest gradient of a candidate, wherever they are.
    """
    key = _key(_cell(target, size))
    free = ~torch.isin(key, _key(_cell(taken, size)))
    unique, inverse = torch.unique(key[free], return_inverse=True)
    strongest = gradient.new_zeros(len(unique)).scatter_reduce_(0, inverse, gradient[free], "amax")
    chosen = torch.sort(strongest, descending=True, stable=True).indices[:room].sort().values
    place = torch.full_like(unique, -1)
    place[chosen] = torch.arange(len(chosen), device=place.device)
    asked = torch.full_like(key, -1)
    asked[free] = place[inverse]
    return _cell_of(unique[chosen]) * size, asked


def largest(rows: Tensor, group: Tensor, groups: int) -> Tensor:
    """[groups, C]: element-wise maximum of the rows [R, C] of each group [R] int64; none is empty."""
    result = rows.new_full((groups, rows.shape[1]), -torch.inf)
    return result.scatter_reduce_(0, group[:, None].expand_as(rows), rows, "amax")


def _cell(coordinates: Tensor, size: int) -> Tensor:
    """[N, 3] cell of a grid of `size` voxels whose centre is nearest."""
    return torch.div(coordinates + size // 2, size, rounding_mode="floor")


def _key(cells: Tensor) -> Tensor:
    """One int64 a cell, COORDINATE_BITS an axis."""
    x, y, z = (cells + COORDINATE_LIMIT).unbind(1)
    return (x << 2 * COORDINATE_BITS) | (y << COORDINATE_BITS) | z


def _cell_of(key: Tensor) -> Tensor:
    """Inverse of `_key`: [N, 3] int64."""
    mask = (1 << COORDINATE_BITS) - 1
    x, y, z = key >> 2 * COORDINATE_BITS, (key >> COORDINATE_BITS) & mask, key & mask
    return torch.stack([x, y, z], 1) - COORDINATE_LIMIT
