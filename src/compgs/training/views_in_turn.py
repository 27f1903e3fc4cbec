"""The training views of a run: each once in random order, then again; and their photographs on the device."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from compgs.errors import ConfigError
from compgs.losses import Target
from compgs.scene.views import Scene, View
from compgs.training.exposures import Exposures

KEPT_BYTES = 8 << 30  # of photographs on a GPU, 3 bytes a pixel


class ViewsInTurn:
    """Which view comes next. The order is random and belongs to the state of a run."""

    def __init__(self, scene: Scene, device: torch.device, seed: int, *, exposure: bool = False) -> None:
        """`exposure`: learn one for each view. Raises ConfigError for a scene without training views."""
        if not scene.train_views:
            raise ConfigError(f"{scene.name}: no training views are left after holding out the test views")
        self.views: Sequence[View] = scene.train_views
        self.device = device
        self.chance = np.random.default_rng(seed)
        self.order: list[int] = []  # the views still to come in this round, taken from its end
        self.photographs: dict[int, Target] = {}  # on a GPU
        self.exposures = Exposures(len(self.views), device) if exposure else None

    def __len__(self) -> int:
        return len(self.views)

    def next(self) -> int:
        """Index of the next view."""
        if not self.order:
            self.order.extend(int(i) for i in self.chance.permutation(len(self.views)))
        return self.order.pop()

    def photograph(self, index: int) -> Target:
        """What to compare a rendering of a view with, at the exposure of the view where exposures are learned."""
        target = self.stored(index)
        return target if self.exposures is None else replace(target, exposure=self.exposures.of(index))

    def learn(self, progress: float) -> None:
        """After the gradients of a step were computed: the exposure of its view; `progress` of the run, 0 to 1."""
        if self.exposures is not None:
            self.exposures.learn(progress)

    def stored(self, index: int) -> Target:
        """On the CPU it shares the memory of the view's image, which the scene keeps or reads again; it is copied to a
        GPU once and kept there while there is room.
        """
        if self.device.type == "cpu":
            return Target.from_image(self.views[index].image, mask=self.views[index].mask)
        kept = self.photographs
        if index not in kept:
            target = Target.from_image(self.views[index].image, self.device, self.views[index].mask)
            while kept and sum(t.image.numel() for t in kept.values()) + target.image.numel() > KEPT_BYTES:
                del kept[next(iter(kept))]
            kept[index] = target
        return kept[index]

    def state(self) -> dict[str, Any]:
        """For a checkpoint, as JSON takes it; `views` are the names by which a scene is known again."""
        return {
            "order": self.order,
            "shuffle": self.chance.bit_generator.state,
            "views": [view.name for view in self.views],
        }

    def tensors(self) -> dict[str, Tensor]:
        """For a checkpoint."""
        return {} if self.exposures is None else self.exposures.tensors()

    def restore(self, state: dict[str, Any], tensors: dict[str, Tensor]) -> None:
        """Go on from a `state` and `tensors`. Raises ValueError and the like for what is none."""
        if self.exposures is not None:
            self.exposures.restore(tensors)
        self.chance.bit_generator.state = state["shuffle"]
        order = state["order"]
        if len(set(order)) != len(order) or not set(order) <= set(range(len(self.views))):
            raise ValueError(f"an order of views that cannot be: {order!r:.60}")
        self.order = [int(view) for view in order]
