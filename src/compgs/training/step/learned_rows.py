"""Numbers that are learned beside the scene: a row for each photograph, or for each lens.

A row changes when its photograph is looked at, by Adam with moments of its own. Nothing of it is written to the file.
"""

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from compgs.training.run.distributed import on_any_rank
from compgs.training.run.restoring import check_tensor


class LearnedRows:
    """[R, P] numbers in units of their own, zero at the beginning."""

    def __init__(
        self,
        name: str,  # in checkpoints
        rows: int,
        units: Sequence[float],  # [P]: what a number of one stands for
        device: torch.device,
        learning_rates: tuple[float, float],  # units per step, first and last of a run; exponential between
        penalty: float = 0.0,  # of half the squared numbers, added to the loss: where nothing is seen, they stay 0
    ) -> None:
        self.name = name
        self.units = torch.tensor(units, dtype=torch.float32, device=device)
        self.learning_rates = learning_rates
        self.penalty = penalty
        self.numbers = torch.zeros(rows, len(units), device=device)
        self.moments = torch.zeros(2, rows, len(units), device=device)
        self.steps = torch.zeros(rows, dtype=torch.int64)
        self._looked_at: dict[int, Tensor] = {}
        self._there: tuple[bool, ...] = ()  # which of the last `gradients` there are

    def values(self) -> Tensor:
        """[R, P] of all rows."""
        return self.numbers * self.units

    def of(self, row: int) -> Tensor:
        """[P] of a row, whose gradient `gradients` gives next."""
        if row not in self._looked_at:
            self._looked_at[row] = self.numbers[row].clone().requires_grad_()
        return self._looked_at[row] * self.units

    @torch.no_grad()
    def gradients(self, rows: Sequence[int]) -> Tensor:
        """[len(rows), P]: gradients of this rank, to be summed over the ranks; 0 where there is none, as `of` was not
        asked since. Whether any rank has one is known without reading a value.
        """
        found = self.numbers.new_zeros(len(rows), len(self.units))
        leaves = [self._looked_at.get(row) for row in rows]
        for gradient, leaf in zip(found, leaves, strict=True):
            if leaf is not None and leaf.grad is not None:
                gradient.copy_(leaf.grad)
        self._there = on_any_rank(*(leaf is not None and leaf.grad is not None for leaf in leaves))
        self._looked_at.clear()
        return found

    @torch.no_grad()
    def learn(self, progress: float, rows: Sequence[int], gradients: Tensor) -> None:
        """One step of each row that has a gradient: `gradients` [len(rows), P], of the same rows as last asked for and
        summed over the ranks; `progress` of the run, 0 to 1.
        """
        first, last = self.learning_rates
        rate = first * (last / first) ** progress
        for row, there, gradient in zip(rows, self._there, gradients, strict=True):
            if there:
                self._step(rate, row, gradient + self.penalty * self.numbers[row])

    def _step(self, rate: float, row: int, gradient: Tensor) -> None:
        self.steps[row] += 1
        means = []
        # Adam's; the second moment is shorter than usual, as a row is looked at a few dozen times.
        for moment, power, keep in zip(self.moments, (1, 2), (0.9, 0.99), strict=True):
            moment[row].lerp_(gradient**power, 1 - keep)
            means.append(moment[row] / (1 - keep ** int(self.steps[row])))
        self.numbers[row] -= rate * means[0] / (means[1].sqrt() + 1e-8)

    def tensors(self) -> dict[str, Tensor]:
        """Return the tensors that a checkpoint holds."""
        named = {"numbers": self.numbers, "moments": self.moments, "steps": self.steps}
        return {f"{self.name}/{name}": value for name, value in named.items()}

    def restore(self, tensors: Mapping[str, Tensor]) -> None:
        """Inverse of `tensors`. Raises ValueError, KeyError for what is none."""
        for name, value in self.tensors().items():
            check_tensor(tensors[name], value.shape, value.dtype, name)
            value.copy_(tensors[name])
