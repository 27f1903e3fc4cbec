"""The objective of training (CompGS Sec. 3.3 and 3.4), on one page.

    loss = D + lambda R
    D    = (1 - w) L1 + w (1 - SSIM) + scale_weight * mean product of the primitives' scales, in `scale_unit`s

R is made of the bits of the anchors in view, of five streams: reference and residual embeddings, their
hyperpriors, and the covariance parameters. It can be normalized in two ways:

- "elements", as the authors' release: the sum over the streams of their mean bits per element. A bit of a
  small stream weighs more than one of a large stream: twenty times for a hyperprior against the residual
  embeddings.
- "bits": R = 5 bits / (132 anchors). Every bit weighs the same, as it does in the file. Five streams and
  32 + 6 + 80 + 4 + 10 = 132 elements an anchor are the paper's: with as many bits per element in every stream, both
  normalizations are equal, so that lambda means about the same. The factor is a constant, so that lambda also means
  the same whatever the dimensions of the model are.

Bits themselves are counted in `entropy`; only this module divides them.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from compgs.numerics.ssim import l1_and_ssim
from compgs.tensors import where
from compgs.tensors.ssim import ssim

SSIM_WEIGHT = 0.2  # w of 3DGS, and of the published methods that build on it
COMMON_EXTENT = 5.0  # world units
# With a smaller share of a view's primitives drawn, the scene is about to vanish: what is not drawn has no gradient.
FEW_DRAWN = 0.1
REVIVED = 0.05  # opacity, well above the rasterizer's cutoff


@dataclass(frozen=True)
class Target:
    """A photograph to compare with: its 8-bit pixels, 3 bytes each, on the renderer's device.

    Its local means and variances are not kept: to compute them again costs about a fifth of the loss, to keep
    them would take 24 bytes a pixel, nine times the memory of the photographs.
    """

    image: Tensor  # [H, W, 3] uint8
    counted: Tensor | None = None  # [H, W] bool: pixels to compare; None: all
    # What the photograph's camera makes of a rendering [H, W, 3]; None: nothing.
    taken: Callable[[Tensor], Tensor] | None = None

    @staticmethod
    def from_image(
        image: np.ndarray, device: torch.device | str = "cpu", mask: np.ndarray | None = None
    ) -> "Target":
        """Make a target from uint8 [H, W, 3] and bool [H, W], True where a pixel counts; on the CPU it shares the
        arrays' memory where it can.
        """
        counted = None if mask is None else _tensor(mask, device)
        return Target(_tensor(image, device), counted)


def _tensor(array: np.ndarray, device: torch.device | str) -> Tensor:
    return torch.from_numpy(np.require(array, requirements=("C", "W"))).to(device)


def as_taken(image: Tensor, target: Target) -> Tensor:
    """The rendering [H, W, 3] as the target's camera shows it."""
    return image if target.taken is None else target.taken(image)


def photometric_loss(
    image: Tensor,  # [H, W, 3] rendered, 0 to 1
    target: Target | Tensor,  # [H, W, 3] uint8, or of the image's type and 0 to 1
    ssim_weight: float = SSIM_WEIGHT,
) -> Tensor:
    """(1 - w) L1 + w (1 - SSIM), as in 3DGS, as the target's camera shows the image; means over its pixels
    that count (`numerics/ssim.py`).
    """
    target = target if isinstance(target, Target) else Target(target)
    y, counted, image = target.image, target.counted, as_taken(image, target)
    assert image.shape == y.shape, f"image {tuple(image.shape)}, target {tuple(y.shape)}"
    if where.in_kernels(image) and y.dtype in (torch.uint8, torch.float32):
        return _FusedPhotometric.apply(image, y, counted, ssim_weight)
    if y.dtype == torch.uint8:
        y = y.to(image.dtype) / 255.0
    if counted is None:
        return (1.0 - ssim_weight) * (image - y).abs().mean() + ssim_weight * (1.0 - ssim(image, y))
    # By products and sums: which pixels count is not asked, as the answer would have to come from the GPU.
    pixels = counted.sum()
    l1 = ((image - y).abs() * counted[:, :, None]).sum() / (3 * pixels.clamp_min(1))
    loss = (1.0 - ssim_weight) * l1 + ssim_weight * (1.0 - ssim(image, y, counted))
    return loss * (pixels > 0)


class _FusedPhotometric(torch.autograd.Function):
    """The gradient is computed along with the loss: both need the same local means."""

    @staticmethod
    def forward(
        ctx: Any, image: Tensor, target: Tensor, counted: Tensor | None, ssim_weight: float
    ) -> Tensor:
        x, y = image.detach().contiguous().numpy(), target.detach().contiguous().numpy()
        mask = None if counted is None else counted.numpy()
        l1, similarity, gradient = l1_and_ssim(x, y, ssim_weight, ctx.needs_input_grad[0], mask)
        if gradient is not None:
            ctx.save_for_backward(torch.from_numpy(gradient))
        return image.new_tensor((1.0 - ssim_weight) * l1 + ssim_weight * (1.0 - similarity))

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, None, None, None]:
        (gradient,) = ctx.saved_tensors
        return gradient * grads[0], None, None, None


def scale_regularizer(scales: Tensor, drawn: Tensor | None = None) -> Tensor:
    """Mean product of the three scales, [M, 3] in `scale_unit`s, of those that are drawn ([M] bool; None: all): large
    primitives are expensive to render.
    """
    # (a view may see none)
    if drawn is None:
        return scales.prod(1).sum() / max(1, len(scales))
    return (scales.prod(1) * drawn).sum() / drawn.sum().clamp_min(1)


def scale_unit(
    means: Tensor,  # [M, 3] world units
    camera_center: Tensor,  # [3] world units
    extent: float,  # of the scene, world units
) -> Tensor:
    """[M, 1] world units to measure the scales of primitives in, for the regularizer: a fifth of the scene's extent or,
    beyond it, of the distance from the camera.

    In world units, as in the authors' release, a scene in meters and the same one in millimeters are two scenes, and
    where the background is far, its volume is all that counts: the image goes flat. A fifth: scenes scaled as structure
    from motion leaves them have extents of about five units, and the published weight is for those.
    """
    distance = (means.detach() - camera_center).norm(dim=1, keepdim=True)
    return distance.clamp_min(extent) / COMMON_EXTENT


def revival_loss(opacities: Tensor) -> Tensor:
    """Pulls the opacities [P] of primitives that are not drawn back to where they are.

    On an empty background, all opacities fall together before the references can tell the object from the air around
    it; below the cutoff nothing would ever bring them back.
    """
    return 0.1 * torch.relu(REVIVED - opacities).mean()


RATE_PER_BIT = 5.0 / 132.0  # of an anchor, with "bits"


def rate(bits: Mapping[str, Tensor], channels: Mapping[str, int], normalization: str) -> Tensor:
    """R from the bits [N] of each stream and its channels, elements an anchor; see the module's docstring."""
    assert bits.keys() == channels.keys() and bits, f"bits of {list(bits)}, channels of {list(channels)}"
    means = {name: b.mean() for name, b in bits.items()}
    if normalization == "elements":
        return torch.stack([means[name] / max(1, channels[name]) for name in means]).sum()
    assert normalization == "bits", f"unknown normalization {normalization!r}"
    return RATE_PER_BIT * torch.stack(list(means.values())).sum()


def rate_distortion_loss(distortion: Tensor, rate: Tensor, lmbda: float) -> Tensor:
    """D + lambda R (CompGS Sec. 3.3). lambda weighs the rate; CompressAI's `lmbda` weighs the distortion."""
    return distortion + lmbda * rate
