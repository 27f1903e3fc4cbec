"""Where a training step's time goes (`compgs train --profile`).

The step is one autograd graph. Its forward half is timed between calls of `lap`; its backward half between the moments
at which gradients reach the tensors that connect the parts: autograd walks back from the loss through rasterization,
projection and prediction to the entropy model, one after the other.
"""

import time
from collections import defaultdict

import torch
from torch import Tensor

WARM_UP = 20  # steps that are not counted: kernels are compiled or loaded


class StepProfile:
    """Seconds by part, summed over steps. `begin` and `end` frame a step."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = defaultdict(float)
        self.steps = 0
        self._seen = 0
        self._last = 0.0

    def begin(self) -> None:
        self._last = self._now()

    def lap(self, part: str) -> None:
        """What happened since the last lap was `part`."""
        now = self._now()
        if self._seen >= WARM_UP:
            self.seconds[part] += now - self._last
        self._last = now

    def lap_on_gradient(self, part: str, *tensors: Tensor) -> None:
        """When the gradients of all the tensors are there, what happened since the last lap was `part`."""
        waiting = [t for t in tensors if t.requires_grad]
        missing = len(waiting)

        def arrived(_: Tensor) -> None:
            nonlocal missing
            missing -= 1
            if missing == 0:
                self.lap(part)

        for tensor in waiting:
            tensor.register_hook(arrived)

    def end(self) -> None:
        self._seen += 1
        self.steps += self._seen > WARM_UP

    def milliseconds(self) -> dict[str, float]:
        """Per step, by part, in the order in which the parts come."""
        return {part: 1e3 * seconds / max(1, self.steps) for part, seconds in self.seconds.items()}

    @staticmethod
    def _now() -> float:
        if torch.cuda.is_available():
            torch.cuda.synchronize()
        return time.perf_counter()


class NoProfile(StepProfile):
    """Measures nothing and waits for nothing."""

    def begin(self) -> None: ...

    def lap(self, part: str) -> None: ...

    def lap_on_gradient(self, part: str, *tensors: Tensor) -> None: ...

    def end(self) -> None: ...
