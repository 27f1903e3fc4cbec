"""The file holds the mean of a run's last steps, not where the last one went (not in the paper).

Each step follows one view, and photographs do not quite agree: of light, of focus, of where they were taken from. Rates
that fall keep the steps small; what is left of the last views' pull is in all parameters at once, and the mean is
without it (Polyak and Juditsky 1992).
"""

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor, nn

from compgs.training.run.restoring import check_tensor, whole_number


class Averaging:
    """The mean of a model's parameters over the steps since it began.

    Whoever changes the model otherwise than by a step of the optimizer calls `forget`.
    """

    def __init__(self, model: nn.Module) -> None:
        self.model = model
        self.steps = 0  # that the mean is of
        self.mean: dict[str, Tensor] = {}  # by the parameters' names; empty: of no step

    def forget(self) -> None:
        """Begin anew."""
        self.steps, self.mean = 0, {}

    @torch.no_grad()
    def after_step(self) -> None:
        """Take in the parameters as they are now."""
        self.steps += 1
        for name, parameter in self.model.named_parameters():
            if self.steps == 1:
                self.mean[name] = parameter.detach().clone()
            else:
                self.mean[name].lerp_(parameter.detach(), 1 / self.steps)

    @torch.no_grad()
    def settle(self) -> None:
        """Make the mean, if there is one, what the model has; it is forgotten."""
        for name, parameter in self.model.named_parameters():
            if name in self.mean:
                parameter.copy_(self.mean[name])
        self.forget()

    def tensors(self) -> dict[str, Tensor]:
        """The mean, for a checkpoint."""
        return {f"average/{name}": mean for name, mean in self.mean.items()}

    def state(self) -> dict[str, Any]:
        """The number of steps, for a checkpoint."""
        return {"averaged": self.steps}

    def restore(self, tensors: Mapping[str, Tensor], state: Mapping[str, Any]) -> None:
        """Inverse of `tensors` and `state`. Raises ValueError, KeyError."""
        self.steps = whole_number(state["averaged"], 0, 1 << 62, "averaged steps")
        if self.steps == 0:
            return
        for name, parameter in self.model.named_parameters():
            value = tensors[f"average/{name}"]
            check_tensor(value, parameter.shape, parameter.dtype, f"average {name}")
            self.mean[name] = value.to(parameter.device)
