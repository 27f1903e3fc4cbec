"""The training views of a run: each once in random order, then again; and their photographs on the device.

With V views a step there are V lanes: every V-th view is in the same lane, and each step takes one view of each lane,
in the lane's own random order. A lane belongs to one rank (`distributed`), so that no rank reads the photographs of
the others. Lanes do not depend on how many ranks there are. Where they are not equally long, the views of the shorter
ones come a little more often.
"""

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from compgs.cameras import Camera
from compgs.config import TrainingConfig
from compgs.errors import ConfigError
from compgs.gaussians import Gaussians
from compgs.losses import Target
from compgs.scene.views import Scene, View
from compgs.training.run.distributed import share_of_rank, world
from compgs.training.step.kept_photographs import KeptPhotographs
from compgs.training.step.photometry import Photometry
from compgs.training.step.poses import Poses
from compgs.training.step.robust import Robust


class ViewsInTurn:
    """Which view comes next. The order is random and belongs to the state of a run."""

    def __init__(
        self, scene: Scene, device: torch.device, seed: int, settings: TrainingConfig | None = None
    ) -> None:
        """`settings`: how many views a step has, and what is learned of each beside the scene; None: one, and nothing.

        Raises ConfigError for a scene without training views, or with fewer than a step needs, and for a step of fewer
        views than there are ranks.
        """
        settings = settings or TrainingConfig()
        per_step = settings.views_per_step
        if not scene.train_views:
            raise ConfigError(f"{scene.name}: no training views are left after holding out the test views")
        if per_step > len(scene.train_views):
            raise ConfigError(
                f"training.views_per_step = {per_step}: {scene.name} has {len(scene.train_views)} training views"
            )
        if per_step < world():
            raise ConfigError(
                f"training.views_per_step = {per_step}: {world()} processes need a view each; set it to {world()} or a "
                f"multiple, and divide training.steps by it"
            )
        self.views: Sequence[View] = scene.train_views
        self.per_step = per_step
        self.device = device
        self.chance = np.random.default_rng(seed)
        self.order: list[int] = []  # the views still to come in this round of their lane, taken from the end
        self.photographs = KeptPhotographs(8 << 30)  # on a GPU
        lanes = set(share_of_rank(range(per_step)))
        own = [view for view in range(len(self.views)) if view % per_step in lanes]
        self.photometry = Photometry(scene, device, own) if settings.exposure else None
        self.robust = Robust(len(self.views), device) if settings.robust else None
        self.poses: Poses | None = None
        self._scene = scene
        self._looks = settings.steps * per_step / len(self.views)

    def __len__(self) -> int:
        return len(self.views)

    def next(self) -> list[int]:
        """Indices of the next step's views, one of each lane."""
        return [self._next_of(lane) for lane in range(self.per_step)]

    def _next_of(self, lane: int) -> int:
        waiting = [place for place, view in enumerate(self.order) if view % self.per_step == lane]
        if waiting:
            return self.order.pop(waiting[-1])
        views = np.arange(lane, len(self.views), self.per_step)
        self.order.extend(int(i) for i in views[self.chance.permutation(len(views))])
        return self.order.pop()

    def photograph(self, index: int) -> Target:
        """What to compare a rendering of a view with; it knows its camera where photometry is learned."""
        return self.with_camera(index, self.stored(index))

    def with_camera(self, index: int, target: Target) -> Target:
        """What a view is compared with, and what its camera made of the scene where that is learned."""
        return target if self.photometry is None else replace(target, taken=self.photometry.taken(index))

    def learn_poses(self) -> None:
        """Learn from now on where each view was taken from."""
        self.poses = Poses(self._scene, self.device, self._looks)

    def posed(self, index: int, gaussians: Gaussians[Tensor], camera: Camera) -> Gaussians[Tensor]:
        """What the given camera of a view has to draw for the view to be seen from its learned pose."""
        return gaussians if self.poses is None else self.poses.moved(index, gaussians, camera)

    def trusted(self, index: int, image: Tensor, target: Target) -> Target:
        """What a rendering of a view is compared with, without what moves, where a training is robust."""
        return target if self.robust is None else self.robust.trusted(index, image, target)

    @property
    def learned(self) -> list[Photometry | Poses | Robust]:
        """What is learned of the views beside the scene."""
        return [part for part in (self.photometry, self.poses, self.robust) if part is not None]

    def gradients(self, views: Sequence[int]) -> tuple[Tensor, ...]:
        """Return gradients of what is learned of a step's views, as far as this rank rendered them, the others 0: to be
        summed over the ranks.
        """
        return tuple(gradient for part in self.learned for gradient in part.gradients(views))

    def learn(self, progress: float, views: Sequence[int], gradients: Sequence[Tensor]) -> None:
        """Learn what belongs to a step's views, from `gradients`; `progress` of the run, 0 to 1."""
        following = iter(gradients)
        for part in self.learned:
            part.learn(progress, views, tuple(itertools.islice(following, part.GRADIENTS)))

    def stored(self, index: int) -> Target:
        """Return a view's photograph. On the CPU it shares the memory of the view's image, which the scene keeps or
        reads again. It is copied to a GPU once and kept there while there is room.
        """
        if self.device.type == "cpu":
            return Target.from_image(self.views[index].image, mask=self.views[index].mask)
        view = self.views[index]
        return self.photographs.get(index, lambda: Target.from_image(view.image, self.device, view.mask))

    def state(self) -> dict[str, Any]:
        """Return what a checkpoint holds, as JSON takes it; `views` are the names by which a scene is known again."""
        return {
            "order": self.order,
            "shuffle": self.chance.bit_generator.state,
            "views": [view.name for view in self.views],
        }

    def tensors(self) -> dict[str, Tensor]:
        """Return the tensors that a checkpoint holds."""
        return {name: value for part in self.learned for name, value in part.tensors().items()}

    def restore(self, tensors: Mapping[str, Tensor], state: Mapping[str, Any]) -> None:
        """Go on from `tensors` and a `state`. Raises ValueError and the like for what is none."""
        for part in self.learned:
            part.restore(tensors)
        self.chance.bit_generator.state = state["shuffle"]
        order = state["order"]
        if len(set(order)) != len(order) or not set(order) <= set(range(len(self.views))):
            raise ValueError(f"an order of views that cannot be: {order!r:.60}")
        self.order = [int(view) for view in order]
