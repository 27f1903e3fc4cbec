"""How long the rest of a run takes, where its steps do not all look at as many pixels.

A run on large photographs begins with coarse ones, and its last steps take many times as long as its first. So one
picture of the present scene is drawn, and compared, at each size that is still to come, with gradients and without
learning: what that takes more than at the present size, a step there will take more than one of now. Steps of a size
that have been timed themselves count as they were.
"""

import time
from collections.abc import Callable, Iterator, Mapping
from typing import TYPE_CHECKING

import numpy as np
import torch

from compgs.cameras import Camera
from compgs.gaussians import Gaussians
from compgs.losses import Target, photometric_loss
from compgs.render.render_model import Renderable, settings_of
from compgs.tensors.rasterize import rasterize

if TYPE_CHECKING:
    from compgs.training.run.any_trainer import AnyTrainer

SPARED = 50.0  # times the seconds that drawing took have to pass before sizes are drawn again: 2 % of a run
DIVISORS = (1, 2, 4, 8)  # of the sides of large photographs, for which that is said

Size = tuple[int, int]


class TimeLeft:
    """Seconds that a run takes from now on, at the pace of steps of each size."""

    def __init__(
        self,
        trainer: "AnyTrainer",
        steps: int,
        views: int = 1,  # of a step, of this process
        draws: "Callable[[Renderable, Camera], float] | None" = None,
    ) -> None:
        """`draws`: seconds that it takes to draw a scene and compare it, with gradients."""
        self.trainer = trainer
        self.steps = steps
        self.views = views
        self.draws = draws or drawing_seconds
        self.timed: dict[Size, float] = {}  # seconds of a step, where there were some
        self.drawn: dict[Size, float] = {}  # seconds of a picture
        self._drawn_at = -np.inf
        self._took = 0.0

    @property
    def size(self) -> Size:
        """Return the size of the pictures that the next step looks at."""
        return _size(self.trainer.camera_at(self.trainer.step))

    def look(self, seconds_per_step: float) -> float:
        """Time steps of the present size as so long, and draw what has to be drawn; the seconds that drawing took."""
        start = time.perf_counter()
        self.timed[self.size] = seconds_per_step
        cameras = self._to_come(1)
        if self._is_large():
            for divisor in DIVISORS[1:]:
                cameras |= self._to_come(divisor, whole=True)
        waiting = _some({size: camera for size, camera in cameras.items() if size not in self.timed})
        if not waiting or not seconds_per_step or start - self._drawn_at < SPARED * self._took:
            return 0.0
        scene = self.trainer.snapshot()
        now = self.trainer.camera_at(self.trainer.step)
        for camera in (now, *waiting.values()):
            self.drawn[_size(camera)] = self.views * self.draws(scene, camera)
        self._drawn_at = time.perf_counter()
        self._took = self._drawn_at - start
        return self._took

    def seconds(self) -> float:
        """Return the seconds from now to the end of the run."""
        return self._of_steps(self.trainer.step, 1)

    def by_divisor(self) -> Mapping[int, float]:
        """Seconds of the whole run where the sides of the photographs are divided by so much; nothing unless they are
        large.
        """
        if not self._is_large() or not self.drawn:
            return {}
        return {divisor: self._of_steps(0, divisor) for divisor in DIVISORS}

    def _is_large(self) -> bool:
        """Whether people are told what smaller photographs would take."""
        width, height = _size(self.trainer.camera_at(self.steps))
        return width * height > 2_000_000

    def _of_steps(self, first: int, divisor: int) -> float:
        each = [self._of_step(_size(camera)) for camera in self._cameras(first, divisor)]
        return (self.steps - first) * float(np.mean(each))

    def _of_step(self, size: Size) -> float:
        if size in self.timed:
            return self.timed[size]
        known = self.timed.get(self.size, 0.0)
        if self.size not in self.drawn:
            return known
        drawn = self.drawn.get(size)
        if drawn is None:  # not drawn: as the nearest that was, by its pixels
            near = min(self.drawn, key=lambda other: abs(np.log(_pixels(other) / _pixels(size))))
            drawn = self.drawn[near] * _pixels(size) / _pixels(near)
        return max(known + drawn - self.drawn[self.size], 0.1 * known)

    def _to_come(self, divisor: int, *, whole: bool = False) -> dict[Size, Camera]:
        """Cameras of all sizes from now on, or of a whole run."""
        first = 0 if whole else self.trainer.step
        return {_size(camera): camera for camera in self._cameras(first, divisor)}

    def _cameras(self, first: int, divisor: int) -> Iterator[Camera]:
        """The cameras of 200 steps from the `first` on, evenly spaced, which stand for all."""
        for step in np.linspace(first, self.steps, 200, endpoint=False).astype(int):
            yield self.trainer.camera_at(int(step), divisor)


def drawing_seconds(scene: Renderable, camera: Camera) -> float:
    """Seconds of a picture that is drawn, compared with a photograph, and gone back through for its gradients."""
    seen = scene.gaussians(camera)
    device = torch.device(getattr(scene, "device", "cpu"))
    gaussians = Gaussians(
        *(torch.tensor(np.asarray(value), device=device).requires_grad_() for value in vars(seen).values())
    )
    target = Target(torch.zeros(camera.height, camera.width, 3, dtype=torch.uint8, device=device))
    _wait_for(device)
    start = time.perf_counter()
    photometric_loss(rasterize(gaussians, camera, settings_of(scene)).image, target).backward()
    _wait_for(device)
    return time.perf_counter() - start


def _some(cameras: dict[Size, Camera]) -> dict[Size, Camera]:
    """Six of them at most, from the smallest to the largest."""
    sizes = sorted(cameras, key=_pixels)
    chosen = np.unique(np.linspace(0, len(sizes) - 1, min(len(sizes), 6)).round().astype(int))
    return {sizes[i]: cameras[sizes[i]] for i in chosen}


def _wait_for(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def _size(camera: Camera) -> Size:
    return camera.width, camera.height


def _pixels(size: Size) -> int:
    return size[0] * size[1]
