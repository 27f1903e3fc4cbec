"""What a run remembers between two steps, written once for all trainers.

A trainer lists its parts. Each says what a checkpoint holds of it, and takes it back. No two parts have tensors, or
entries of their states, of the same name.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import torch
from torch import Tensor, nn

from compgs.training.run.checkpoint import optimizer_tensors, restore_optimizer
from compgs.training.run.distributed import keep_on_rank_zero
from compgs.training.run.restoring import check_moments, check_tensor


class Part(Protocol):
    """Something that a run remembers beside the model and the optimizer's moments."""

    def tensors(self) -> dict[str, Tensor]:
        """Tensors by name, for a checkpoint."""
        ...

    def state(self) -> dict[str, Any]:
        """Entries by name, for a checkpoint, as JSON takes them."""
        ...

    def restore(self, tensors: Mapping[str, Tensor], state: Mapping[str, Any]) -> None:
        """Take back what a checkpoint holds, among what other parts have there. Raises ValueError and the like for what
        does not fit.
        """
        ...


@dataclass(frozen=True)
class Memory:
    """All that a trainer remembers."""

    parameters: Callable[[], Mapping[str, nn.Parameter]]  # by name, as they are now: growth replaces them
    optimizer: torch.optim.Optimizer
    parts: Sequence[Part]

    def moments(self) -> dict[str, Tensor]:
        """Adam's moments, by `parameter/moment`."""
        return optimizer_tensors(self.parameters(), self.optimizer)

    def tensors(self) -> dict[str, Tensor]:
        """The tensors of all parts."""
        return {name: value for part in self.parts for name, value in part.tensors().items()}

    def state(self) -> dict[str, Any]:
        """The states of all parts."""
        return {name: value for part in self.parts for name, value in part.state().items()}

    def restore(
        self, moments: dict[str, Tensor], tensors: Mapping[str, Tensor], state: Mapping[str, Any]
    ) -> None:
        """Inverse of the other three. Raises ValueError and the like for what does not fit."""
        for part in self.parts:
            part.restore(tensors, state)
        # Some parts have parameters of their own.
        check_moments(moments, self.parameters())
        restore_optimizer(self.parameters(), self.optimizer, moments)


@dataclass(frozen=True)
class Chance:
    """A random generator."""

    generator: torch.Generator
    name: str = "chance"

    def tensors(self) -> dict[str, Tensor]:
        return {self.name: self.generator.get_state()}

    def state(self) -> dict[str, Any]:
        return {}

    def restore(self, tensors: Mapping[str, Tensor], state: Mapping[str, Any]) -> None:
        now = self.generator.get_state()
        check_tensor(tensors[self.name], now.shape, now.dtype, self.name)
        self.generator.set_state(tensors[self.name])


@dataclass(frozen=True)
class Statistics:
    """The attributes of a control of growth, summed over the ranks of a torchrun."""

    control: Any
    names: Sequence[str]

    def tensors(self) -> dict[str, Tensor]:
        return {f"control/{name}": getattr(self.control, name) for name in self.names}

    def state(self) -> dict[str, Any]:
        return {}

    def restore(self, tensors: Mapping[str, Tensor], state: Mapping[str, Any]) -> None:
        for name in self.names:
            value, now = tensors[f"control/{name}"], getattr(self.control, name)
            check_tensor(value, now.shape, now.dtype, f"control/{name}")
            setattr(self.control, name, value.to(now.device))
        keep_on_rank_zero(self.control, self.names)
