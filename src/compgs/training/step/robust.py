"""Which parts of photographs a training leaves out: what the scene keeps failing to show, as it was there only once.

Somebody who walks through a capture is in one photograph and not in its neighbours. No scene fits both, and one that is
made to tries with mist. What differs there stays large, look after look, while the difference of what stands still
falls. So each photograph has a grid of cells with the mean difference of the last looks. A cell that differs far more
than most cells of all photographs do not count, nor do their pixels. A cell that was left out wrongly comes back: other
photographs go on to teach the scene what is there, and the difference falls.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import torch
from torch import Tensor, nn

from compgs.losses import Target, as_taken
from compgs.tensors import where
from compgs.training.run.distributed import on_any_rank
from compgs.training.run.restoring import check_tensor

GRID = 48  # cells along each side of a photograph


class Robust:
    """The difference of each training view's cells, and what it says about the next look at them."""

    GRADIENTS = 1  # tensors of `gradients`

    def __init__(self, views: int, device: torch.device) -> None:
        self.differences = torch.zeros(views, GRID, GRID, device=device)
        self.looks = torch.zeros(views, dtype=torch.int64)
        self._looked_at = torch.zeros(views, 1, 1, dtype=torch.bool, device=device)  # beside the differences
        self.progress = 0.0
        self._seen: dict[int, Tensor] = {}
        self._there: tuple[bool, ...] = ()  # which of the last `gradients` there are

    @torch.no_grad()
    def trusted(self, view: int, image: Tensor, target: Target) -> Target:
        """The target without what has differed too much so far; remembers how much it does now."""
        photograph = target.image.to(image.dtype)
        if target.image.dtype == torch.uint8:
            photograph = photograph / 255.0
        difference = (as_taken(image.detach(), target) - photograph).abs().mean(2)
        self._seen[view] = cells(difference, target.counted)
        if self.progress < 0.1 or self.looks[view] == 0:  # at first everything differs
            return target
        left_out = pixels(smooth(self.differences[view]) > self.limit(), *difference.shape)
        counted = ~left_out if target.counted is None else target.counted & ~left_out
        if where.choosing_pays(counted.device):
            return replace(target, counted=counted) if left_out.any() and counted.any() else target
        # Where nothing would be left, all counts as before; not asked, as the answer would have to come from the GPU.
        before = torch.ones_like(counted) if target.counted is None else target.counted
        return replace(target, counted=torch.where(counted.any(), counted, before))

    def limit(self) -> Tensor:
        """[] difference from which on a cell is left out, once any view was looked at: six times the median of all
        cells, and a tenth of what lies between black and white.
        """
        known = torch.where(self._looked_at, self.differences, torch.inf).view(-1).sort().values
        median = known[(int((self.looks > 0).sum()) * GRID * GRID - 1) // 2]
        return (6.0 * median).clamp_min(0.1)

    @torch.no_grad()
    def gradients(self, views: Sequence[int]) -> tuple[Tensor, ...]:
        """[V, GRID, GRID]: differences of this rank's looks in this step, to be summed over the ranks."""
        found = self.differences.new_zeros(len(views), GRID, GRID)
        for row, view in zip(found, views, strict=True):
            if view in self._seen:
                row.copy_(self._seen[view])
        self._there = on_any_rank(*(view in self._seen for view in views))
        self._seen.clear()
        return (found,)

    @torch.no_grad()
    def learn(self, progress: float, views: Sequence[int], gradients: Sequence[Tensor]) -> None:
        """Remember the looks of a step; `progress` of the run, 0 to 1."""
        self.progress = progress
        for view, now, there in zip(views, gradients[0], self._there, strict=True):
            if there:
                first = self.looks[view] == 0
                # From one look to the next a cell keeps six tenths of its mean.
                self.differences[view] = now if first else self.differences[view].lerp(now, 1 - 0.6)
                self.looks[view] += 1
                self._looked_at[view] = True

    def tensors(self) -> dict[str, Tensor]:
        """Return the tensors that a checkpoint holds."""
        progress = torch.tensor(self.progress, dtype=torch.float64)
        return {
            "robust/differences": self.differences,
            "robust/looks": self.looks,
            "robust/progress": progress,
        }

    def restore(self, tensors: Mapping[str, Tensor]) -> None:
        """Inverse of `tensors`. Raises ValueError, KeyError for what is none."""
        for name, value in self.tensors().items():
            check_tensor(tensors[name], value.shape, value.dtype, name)
        self.differences.copy_(tensors["robust/differences"])
        self.looks.copy_(tensors["robust/looks"])
        self._looked_at = (self.looks > 0)[:, None, None].to(self.differences.device)
        self.progress = float(tensors["robust/progress"])


def cells(difference: Tensor, counted: Tensor | None) -> Tensor:
    """[H, W] of pixels -> [GRID, GRID] means over those that count; 0 where none does."""
    if counted is None:
        return pooled(difference)
    share = pooled(counted.to(difference.dtype))
    return pooled(difference * counted) / share.clamp_min(1e-6)


def pooled(values: Tensor) -> Tensor:
    """[H, W] -> [GRID, GRID] means."""
    return nn.functional.adaptive_avg_pool2d(values[None, None], GRID)[0, 0]


def smooth(values: Tensor) -> Tensor:
    """[GRID, GRID] means over each cell and those around it: what moves is seldom as small as a cell."""
    return nn.functional.avg_pool2d(values[None, None], 3, stride=1, padding=1, count_include_pad=False)[0, 0]


def pixels(chosen: Tensor, height: int, width: int) -> Tensor:
    """[GRID, GRID] bool -> [height, width] bool: the pixels of the chosen cells."""
    rows = torch.arange(height, device=chosen.device) * GRID // height
    columns = torch.arange(width, device=chosen.device) * GRID // width
    return chosen[rows][:, columns]
