"""Where a training step's time goes (`compgs train --profile`).

A trainer's step is a sequence of its methods; a profile wraps them, so that the step itself knows nothing of it. The
step is one autograd graph: its forward half is timed from method to method, its backward half between the moments at
which gradients reach the tensors that connect the parts. Autograd walks back from the loss through rasterization,
projection and prediction to the entropy model, one after the other.
"""

import functools
import time
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping
from operator import attrgetter
from typing import Any

import torch
from torch import Tensor

# What a step's tensors are, when the backward pass begins: each part's name, and where its gradients arrive.
Stations = Callable[..., Iterable[tuple[str, tuple[Tensor, ...]]]]


class StepProfile:
    """Seconds by part, summed over steps."""

    def __init__(self, *, warm_up: int = 20, clock: Callable[[], float] = time.perf_counter) -> None:
        """`warm_up`: steps that are not counted, as kernels are compiled or loaded."""
        self.warm_up = warm_up
        self.clock = clock
        self.seconds: dict[str, float] = defaultdict(float)
        self.steps = 0
        self._seen = 0
        self._last = 0.0
        # One of the watched methods, whose part is all that it calls: pruning looks at views, too.
        self._inside = False

    def watch(self, trainer: Any, parts: Mapping[str, str], stations: Stations) -> None:
        """Wrap methods of a trainer, or of what it has (`pictures.compare`): `parts` names what each of them is;
        `train_step` is the whole, the one called `backward` the backward pass, whose arguments `stations` takes.
        """
        owner = trainer  # of the backward pass
        for path, part in parts.items():
            place, _, method = path.rpartition(".")
            whose = attrgetter(place)(trainer) if place else trainer
            setattr(whose, method, self._timed(getattr(whose, method), part))
            owner = whose if method == "backward" else owner
        backward, step = owner.backward, trainer.train_step

        @functools.wraps(backward)
        def watched_backward(*arguments: Any) -> Any:
            for part, tensors in stations(*arguments):
                self._lap_on_gradient(part, tensors)
            return backward(*arguments)

        @functools.wraps(step)
        def watched_step() -> Any:
            self._last = self._now()
            result = step()
            self._seen += 1
            self.steps += self._seen > self.warm_up
            return result

        owner.backward, trainer.train_step = watched_backward, watched_step

    def milliseconds(self) -> dict[str, float]:
        """Return the milliseconds of a step by part, in the order in which the parts come."""
        return {part: 1e3 * seconds / max(1, self.steps) for part, seconds in self.seconds.items()}

    def _timed(self, method: Callable[..., Any], part: str) -> Callable[..., Any]:
        @functools.wraps(method)
        def timed(*arguments: Any, **named: Any) -> Any:
            if self._inside:
                return method(*arguments, **named)
            self._inside = True
            try:
                result = method(*arguments, **named)
            finally:
                self._inside = False
            self._lap(part)
            return result

        return timed

    def _lap(self, part: str) -> None:
        """What happened since the last lap was `part`."""
        now = self._now()
        if self._seen >= self.warm_up:
            self.seconds[part] += now - self._last
        self._last = now

    def _lap_on_gradient(self, part: str, tensors: Iterable[Tensor]) -> None:
        """When the gradients of all the tensors are there, what happened since the last lap was `part`."""
        waiting = [t for t in tensors if t.requires_grad]
        missing = len(waiting)

        def arrived(_: Tensor) -> None:
            nonlocal missing
            missing -= 1
            if missing == 0:
                self._lap(part)

        for tensor in waiting:
            tensor.register_hook(arrived)

    def _now(self) -> float:
        if torch.cuda.is_available():
            torch.cuda.synchronize()
        return self.clock()
