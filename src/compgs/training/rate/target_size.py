"""A file of the size that was asked for: lambda follows what the file would take (`rate_control`)."""

import math
from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from compgs.errors import ConfigError
from compgs.trained_model import TrainedModel
from compgs.training.rate.file_size import FileSize, anchor_bits, fixed_bytes
from compgs.training.rate.rate_control import LOOKS, RateState, due, follow
from compgs.training.run.divergence import diverged
from compgs.training.structure.control import ControlSchedule
from compgs.training.structure.importance import needed_primitives
from compgs.training.structure.pruning import anchors_worth_their_bits


class TargetSize:
    """Follows the size of a model in training. Raises ConfigError if its networks alone take more than the target."""

    def __init__(
        self,
        model: TrainedModel,
        schedule: ControlSchedule,
        pruned_at: frozenset[int],
        contributions: Callable[[], Tensor],  # [N, K] of the coupled primitives, to a sample of the views
        changes: Callable[[], Tensor],  # [N] of a sample of the views without an anchor (`Survey.changes`)
        discount: float,  # share by which a bit is cheaper to pruning
    ) -> None:
        self.model = model
        self.config = model.config
        self.schedule = schedule
        self.pruned_at = pruned_at
        self.contributions = contributions
        self.changes = changes
        self.discount = discount
        self.file = FileSize(model)
        target, least = self.config.training.target_bytes, fixed_bytes(model)
        if target is not None and target <= least:
            raise ConfigError(
                f"training.target_bytes = {target}: the networks alone take about {least} bytes; "
                "ask for more, or make them smaller (model.width, model.coupled_primitives)"
            )

    def follow(self, state: RateState, step: int) -> RateState:
        """The state after a step, with its new lambda; unchanged where no size is asked for.

        Raises TrainingError if the latents are not finite any more.
        """
        t = self.config.training
        if t.target_bytes is None or not due(step, t.steps, t.borders.rate):
            return state
        grown = self.schedule.ended(step)
        size, fixed = self.size(), fixed_bytes(self.model)
        if not math.isfinite(size):
            raise diverged(step, "rate", size)
        pruned = any(step - t.steps // LOOKS <= at < step for at in self.pruned_at)
        # What later prunings will leave is predicted after each of them, and ten times in a run.
        if pruned or step % max(1, t.steps // 10) == 0 or (grown and state.error is None):
            share = self.lasting_share(state.lmbda_of_pruning, step)
            state = replace(state, share=share, written=self.file.written_share())
        target = max(1, t.target_bytes - fixed)
        return follow(state, size * state.written * state.share, target, progress=step / t.steps, grown=grown)

    def bits_to_keep(self, step: int, bits: Tensor, written: float) -> tuple[float, float]:
        """Fewest and most bits that a pruning at this step may leave of the anchors' `bits` [N]. With fewer, no lambda
        would bring the file to its size; with more after the last pruning, none would in time.

        `written`: of the bytes that training pays for, what a file takes as yet. What is saved becomes less as the run
        settles; reckoned is with half of it (110 kB of plush, 1 500 steps: with all of it +4.4 %, with none -3.9 %).
        """
        target = self.config.training.target_bytes
        if target is None:
            return 0.0, math.inf
        drawn = needed_primitives(self.contributions(), self.config.control.idle_share)
        share = (target - fixed_bytes(self.model)) / max(1.0, 0.5 * (1.0 + written) * self.size(drawn))
        wanted = share * float(bits.sum(dtype=torch.float64))
        # What is left of a run after the last pruning brings a file down by 3 %.
        return wanted, 1.03 * wanted if step == max(self.pruned_at) else math.inf

    def size(self, mask: Tensor | None = None) -> float:
        """Bytes of the file that depend on lambda, without the networks. `mask`: [N, K] bool, of the coupled primitives
        that are to exist; default: those that do.
        """
        found = self.file.latents(mask)
        return math.floor(found) if math.isfinite(found) else found

    def estimated_bytes(self, written: float, step: int) -> int:
        """Bytes of the whole file if it were written now, at a step; `written`: as in `bits_to_keep`. Raises
        TrainingError if the latents are not finite any more.
        """
        size = written * self.file.latents()
        if not math.isfinite(size):
            raise diverged(step, "rate", size)
        return int(size) + fixed_bytes(self.model)

    def lasting_share(self, lmbda: float, step: int) -> float:
        """Predicted share of the bytes of `size` that is left at the end of the run, after the last pruning."""
        lasting = needed_primitives(self.contributions(), self.config.control.idle_share)
        still = sum(at >= step for at in self.pruned_at)
        if still:
            lasting &= self.lasting_anchors(lmbda, still)[:, None]
        return self.size(lasting) / self.size() if lasting.any() else 1.0

    def lasting_anchors(self, lmbda: float, still: int) -> Tensor:
        """[N] bool: those that outlast so many prunings."""
        bits = anchor_bits(self.model)
        return anchors_worth_their_bits(
            self.changes(), bits, lmbda, self.config.control, self.discount, prunings=still
        )
