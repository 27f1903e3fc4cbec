"""The exposure of each training view: what its camera made of the scene's colors (3DGS, exposure compensation).

    photograph = M rendering + b,    M [3, 3], b [3] of each view

Where cameras chose exposure and white balance by themselves, views contradict one another, and a scene without these
numbers becomes foggy patches that repair each view. They are learned beside the scene, and no file holds them: it has
the colors between all views. A decay pulls them back to M = 1, b = 0, else all of them could brighten together while
the scene darkens.
"""

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from compgs.training.run.restoring import check_tensor

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
        self._looked_at: dict[int, Tensor] = {}

    def of(self, view: int) -> Tensor:
        """[3, 4] of a view, whose gradient `gradients` gives next."""
        exposure = (self.neutral + self.change[view]).requires_grad_()
        self._looked_at[view] = exposure
        return exposure

    @torch.no_grad()
    def gradients(self, views: Sequence[int]) -> Tensor:
        """[V, 13] of views: of M and b, and whether there is one (1) or none (all 0): `of` was not asked since."""
        found = self.change.new_zeros(len(views), 13)
        for row, view in zip(found, views, strict=True):
            exposure = self._looked_at.pop(view, None)
            if exposure is not None and exposure.grad is not None:
                row[:12], row[12] = exposure.grad.view(-1), 1.0
        self._looked_at.clear()
        return found

    @torch.no_grad()
    def learn(self, progress: float, views: Sequence[int], gradients: Tensor) -> None:
        """One step on each of the views that has a gradient [V, 13]; `progress` of the run, 0 to 1."""
        for view, there, gradient in zip(views, gradients[:, 12].tolist(), gradients[:, :12], strict=True):
            if there:
                self._step(progress, view, gradient.view(3, 4))

    def _step(self, progress: float, view: int, gradient: Tensor) -> None:
        first, last = LEARNING_RATES
        rate = first * (last / first) ** progress
        self.steps[view] += 1
        means = []
        for moment, power, keep in zip(self.moments, (1, 2), MOMENTS, strict=True):
            moment[view].lerp_(gradient**power, 1 - keep)
            means.append(moment[view] / (1 - keep ** int(self.steps[view])))
        self.change[view] *= 1 - rate * DECAY
        self.change[view] -= rate * means[0] / (means[1].sqrt() + EPSILON)

    def tensors(self) -> dict[str, Tensor]:
        """Return the tensors that a checkpoint holds."""
        return {
            "exposure/change": self.change,
            "exposure/moments": self.moments,
            "exposure/steps": self.steps,
        }

    def restore(self, tensors: Mapping[str, Tensor]) -> None:
        """Inverse of `tensors`. Raises ValueError, KeyError for what is none."""
        for name in ("change", "moments", "steps"):
            value, stored = getattr(self, name), tensors[f"exposure/{name}"]
            check_tensor(stored, value.shape, value.dtype, f"exposure/{name}")
            value.copy_(stored)
