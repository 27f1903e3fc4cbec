"""What a step gives, and what a progress display shows of it."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

from compgs.losses import Target, as_taken


@dataclass(frozen=True)
class StepResult:
    loss: Tensor  # []; a tensor, so that the CPU waits for the GPU only when somebody reads it
    image: Tensor  # [H, W, 3] rendered
    photograph: Target  # what it was compared with


@dataclass(frozen=True)
class TrainingStatus:
    """What a progress display shows."""

    step: int
    steps: int
    loss: float
    psnr: float  # dB, of the last training view
    primitives: int
    kind: str  # of primitives: "anchors", "splats"
    estimated_bytes: int
    seconds_per_step: float
    lmbda: (
        float | None
    )  # weight of the rate, which follows the size where one is asked for; None: there is no rate
    seconds_left: float | None = None  # None: the steps that are left, at the present pace
    # Of the whole run, where the sides of the photographs are divided by so much; empty unless they are large.
    seconds_by_divisor: Mapping[int, float] = field(default_factory=dict)


def training_psnr(result: StepResult) -> float:
    """PSNR in dB of the view that a step looked at, over the pixels that count."""
    photograph, counted = result.photograph.image.to(result.image.dtype) / 255.0, result.photograph.counted
    image = as_taken(result.image, result.photograph).detach()
    squares = (image.clamp(0, 1) - photograph) ** 2
    error = float((squares if counted is None else squares[counted]).mean())
    return -10.0 * float(np.log10(max(error, 1e-10)))


def nothing_shown(
    photograph: Target, background: tuple[float, float, float], device: torch.device
) -> StepResult:
    """What a step gives that sees nothing but the background: nothing can be learned from it."""
    image = torch.tensor(background, device=device).expand(*photograph.image.shape)
    return StepResult(torch.zeros((), device=device), image, photograph)
