"""Anchors pay for themselves: those go whose bits cost more than the error that they keep away (not in the paper).

Without anchor n the images of the training views would change by d_n. Where the loss is as small as it gets, it is
flat: what an anchor keeps away from it is of second order, `control.prune_worth` times the mean of d_n^2 over all
values of all views, part of which the other anchors take over in what is left of the run. Its bits b_n cost
lambda * RATE_PER_BIT / N * b_n, as in the objective (`losses.rate`).

The squares need no image without the anchor. With random signs s of the values, the expectation of (sum of s d_n)^2 is
the sum of d_n^2 (Hutchinson 1989), and one backward pass gives the sums of s d_n of all anchors at once. Each view has
one draw of signs. Blending weights (`importance.py`) would be as cheap, but an anchor before another of the same color
has large ones, and nobody would miss it.
"""

import math
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from compgs.cameras import Camera
from compgs.config import ControlConfig
from compgs.losses import RATE_PER_BIT
from compgs.render import RasterSettings
from compgs.tensors.contributions import signed_changes
from compgs.tensors.prediction import Prediction
from compgs.training.shortcuts.coarse import COARSEST_PIXELS, halved, times_halved


@torch.no_grad()
def squared_changes(
    cameras: Sequence[tuple[int, Camera]],  # of views, with numbers that tell their draws apart
    predicted: Callable[[Camera], tuple[Tensor, Prediction] | None],
    shape: tuple[int, int],  # N, K
    settings: RasterSettings,
    device: torch.device,
) -> tuple[Tensor, Tensor]:  # [N] float64, 1 for a value that goes from 0 to 1; [N] float64 cameras
    """Estimated squared changes of the cameras' images without an anchor, summed over all their values; and how many of
    the cameras may show the anchor.

    `predicted`: for a camera, the visible anchors [V] and their prediction, or None if no anchor is visible.
    """
    total = torch.zeros(shape[0], dtype=torch.float64, device=device)
    shown_by = torch.zeros_like(total)
    for number, camera in cameras:
        seen = predicted(camera)
        if seen is None:
            continue
        rows, prediction = seen
        signs = random_signs(number, (camera.height, camera.width, 3), device)
        changes = signed_changes(prediction.gaussians, camera, signs, settings).double()
        # [V, K], so that an anchor's are summed in the same order everywhere
        slots = changes.new_zeros(len(rows) * shape[1])
        slots[prediction.index] = changes
        total[rows] += slots.view(len(rows), shape[1]).sum(1) ** 2
        shown_by[rows] += 1
    return total, shown_by


def pruning_camera(camera: Camera) -> Camera:
    """The view of a camera as pruning renders it: large ones with sides halved, in a fraction of the time."""
    return halved(camera, times_halved(camera.width, camera.height, COARSEST_PIXELS))


def random_signs(seed: int, shape: tuple[int, ...], device: torch.device) -> Tensor:
    """-1 or 1, float32; drawn on the CPU, so that a pruning takes the same anchors on every device."""
    chance = torch.Generator().manual_seed(seed)
    return (torch.randint(0, 2, shape, generator=chance).float() * 2.0 - 1.0).to(device)


def bit_price(lmbda: float, anchors: int) -> float:
    """What a bit of one of so many anchors adds to the objective."""
    return lmbda * RATE_PER_BIT / anchors


def anchors_worth_their_bits(
    changes: Tensor,  # [N] mean squared change of a value of the training views; infinite: not known
    bits: Tensor,  # [N] of each anchor
    lmbda: float,
    control: ControlConfig,
    discount: float,  # share by which a bit is cheaper than to the objective
    *,
    least_bits: float = 0.0,
    most_bits: float = math.inf,
    prunings: int = 1,  # foreseen: how many there are, one after the other
) -> Tensor:  # [N] bool
    """The anchors that stay: those worth their bits, and of the others the best while all that stay have fewer bits
    than `least_bits`; if they have more than `most_bits`, the best. What no view would miss goes, of the rest at most
    half in a pruning: what replaces each other must not go together.
    """
    # A further pruning takes what the first would at a fifth more, about: by then the others have taken over
    # (plush_480 and fox, 1 500 steps).
    price = bit_price(lmbda, len(bits)) * (1.0 - discount) * (1.0 + 0.2 * (prunings - 1))
    worth = control.prune_worth * changes / bits.double()
    stays = changes > 0
    most = int((1.0 - 0.5**prunings) * stays.sum())
    worst = torch.nonzero(stays).view(-1)
    worst = worst[torch.argsort(worth[worst], stable=True)[:most]]
    with_it = (bits * stays).sum() - bits[worst].cumsum(0) + bits[worst]
    goes = (worth[worst] < price) & (with_it - bits[worst] >= least_bits) | (with_it > most_bits)
    stays[worst[goes]] = False
    return stays
