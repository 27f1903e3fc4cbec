"""The views of one training step, and which anchors they may show.

With several views a step (`training.views_per_step`) the latents of all anchors in any of them are quantized, and their
bits counted, once. With several ranks each does so for its own views, and the noise of an anchor must be the same
wherever it is looked at: so every rank looks which anchors all views of the step may show.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from compgs.entropy.quantization import UniformNoise
from compgs.training.run.distributed import share_of_rank

Noise = Callable[[Tensor], Tensor]  # of the shape of what it is given


@dataclass(frozen=True)
class SeenAnchors:
    """Anchors that any of some views may show; views are numbered as they are in their step."""

    rows: Tensor  # [U] int64, ascending
    parts: dict[
        int, Tensor | None
    ]  # of each view, [V] int64: the entries of `rows` that it may show; None: all

    @property
    def numbers(self) -> list[int]:
        """List the numbers of the views that may show any anchor."""
        return [n for n, part in self.parts.items() if len(self.rows if part is None else part)]

    def part_of(self, number: int) -> Tensor | None:
        """[V] int64: the entries of `rows` that a view may show; None: all."""
        return self.parts[number]

    def rows_of(self, number: int) -> Tensor:
        """[V] int64: the anchors that it may show."""
        part = self.parts[number]
        return self.rows if part is None else self.rows[part]


@dataclass(frozen=True)
class StepViews:
    """Views of a step, of all ranks, and their noise."""

    views: tuple[int, ...]
    seen: SeenAnchors  # of all of them
    own: SeenAnchors  # of this rank's views
    noise: UniformNoise
    seed: int | None  # of the places of the step's noise; None, with one view: where `noise` is just now

    def noise_of_latents(self) -> Noise:
        """Return noise for the anchors of `own`, as if noise for all that are seen had been asked for."""
        noise = self._noise(0)
        if self.own is self.seen:
            return noise
        return noise_of_some(noise, torch.searchsorted(self.seen.rows, self.own.rows), len(self.seen.rows))

    def noise_of_view(self, number: int) -> Noise:
        """Return noise for what one of the views alone needs."""
        return self._noise(1 + number)

    def _noise(self, kind: int) -> Noise:
        if self.seed is None:
            return self.noise
        return self.noise.of_places(np.random.default_rng((self.seed, kind)))


def step_views(
    views: Sequence[int],
    rows: Sequence[Tensor],  # for each view the anchors that it may show, [V] int64, ascending
    anchors: int,  # how many there are
    noise: UniformNoise,
) -> StepViews:
    """Gather the anchors and the noise of the views that come next."""
    several = len(views) > 1
    seed = int(noise.places.integers(1 << 62)) if several else None
    seen = seen_anchors(dict(enumerate(rows)), anchors)
    numbers = share_of_rank(range(len(views)))
    all_mine = len(numbers) == len(views)
    own = seen if all_mine else seen_anchors({number: rows[number] for number in numbers}, anchors)
    return StepViews(tuple(views), seen, own, noise, seed)


def seen_anchors(of_views: dict[int, Tensor], anchors: int) -> SeenAnchors:
    """Unite the anchors that each view may show, [V] int64, ascending; `anchors`: how many there are."""
    if len(of_views) == 1:
        ((number, rows),) = of_views.items()
        return SeenAnchors(rows, {number: None})
    device = next(iter(of_views.values())).device
    seen = torch.zeros(anchors, dtype=torch.bool, device=device)
    for rows in of_views.values():
        seen[rows] = True
    place = torch.cumsum(seen, 0) - 1
    parts: dict[int, Tensor | None] = {number: place[rows] for number, rows in of_views.items()}
    return SeenAnchors(torch.nonzero(seen).view(-1), parts)


def noise_of_some(noise: Noise, places: Tensor, count: int) -> Noise:
    """Noise for the rows at `places` [U] int64 of `count`, as if noise for all of them had been asked for."""

    def of_some(like: Tensor) -> Tensor:
        everywhere = like.new_empty(1).expand(
            count, *like.shape[1:]
        )  # only its shape counts: it takes no memory
        return noise(everywhere).index_select(0, places)

    return of_some
