"""The exposure of each training view: what its camera made of the scene's colors (3DGS, exposure compensation).

    photograph = M rendering + b,    M [3, 3], b [3] of each view

Where cameras chose exposure and white balance by themselves, views contradict one another, and a scene without these
numbers becomes foggy patches that repair each view. They are learned beside the scene, and no file holds them: it has
the colors between all views. A decay pulls them back to M = 1, b = 0, else all of them could brighten together while
the scene darkens.
"""

import torch
from torch import Tensor

from compgs.training.restoring import check_tensor

# Per step on a view, first and last of a run (exponential between them): it is looked at a few dozen times.
LEARNING_RATES = (0.05, 0.001)
DECAY = 0.05  # times the learning rate, of what a view differs from the scene in a step
MOMENTS = (0.9, 0.99)  # Adam's; the second is shorter than usual, for as few steps
EPSILON = 1e-8


class Exposures:
    """[3, 4] for each view, M and b side by side, by Adam with decoupled decay: a view changes when it is looked at."""

    def __init__(self, views: int, device: torch.device) -> None:
        self.neutral = torch.eye(3, 4, device=device)
        self.change = torch.zeros(views, 3, 4, device=device)  # from the neutral one
        self.moments = torch.zeros(2, views, 3, 4, device=device)
        self.steps = torch.zeros(views, dtype=torch.int64)
        self._current: tuple[int, Tensor] | None = None

    def of(self, view: int) -> Tensor:
        """[3, 4] of a view, whose gradient is learned from next."""
        exposure = (self.neutral + self.change[view]).requires_grad_()
        self._current = view, exposure
        return exposure

    @torch.no_grad()
    def learn(self, progress: float) -> None:
        """One step on the view that was asked for last, if it has a gradient; `progress` of the run, 0 to 1."""
        if self._current is None or self._current[1].grad is None:
            return
        view, exposure = self._current
        gradient = exposure.grad
        assert gradient is not None
        first, last = LEARNING_RATES
        rate = first * (last / first) ** progress
        self.steps[view] += 1
        means = []
        for moment, power, keep in zip(self.moments, (1, 2), MOMENTS, strict=True):
            moment[view].lerp_(gradient**power, 1 - keep)
            means.append(moment[view] / (1 - keep ** int(self.steps[view])))
        self.change[view] *= 1 - rate * DECAY
        self.change[view] -= rate * means[0] / (means[1].sqrt() + EPSILON)
        self._current = None

    def tensors(self) -> dict[str, Tensor]:
        """For a checkpoint."""
        return {
            "exposure/change": self.change,
            "exposure/moments": self.moments,
            "exposure/steps": self.steps,
        }

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """Inverse of `tensors`. Raises ValueError, KeyError for what is none."""
        for name in ("change", "moments", "steps"):
            value, stored = getattr(self, name), tensors[f"exposure/{name}"]
            check_tensor(stored, value.shape, value.dtype, f"exposure/{name}")
            value.copy_(stored)
