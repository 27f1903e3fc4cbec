"""Structural similarity on torch tensors, on any device and in any precision; `numerics/ssim.py` says what it is."""

import functools

import torch
from torch import Tensor

from compgs.numerics.ssim import C1, C2, WINDOW_SIZE, window


@functools.lru_cache(maxsize=16)
def window_on(dtype: torch.dtype, device: torch.device) -> Tensor:
    """`window` on a device; kept, as a copy to a GPU waits for it to finish its work."""
    return torch.as_tensor(window(), dtype=dtype, device=device)


def ssim(x: Tensor, y: Tensor, counted: Tensor | None = None) -> Tensor:
    """Mean SSIM of [H, W, 3] images over the pixels of a mask [H, W] bool, or all: plain torch, any device and type."""
    if counted is not None:
        x, y = (image * counted[:, :, None] for image in (x, y))
    taps = window_on(x.dtype, x.device)

    def blur(maps: Tensor) -> Tensor:  # [N, 1, H, W]
        maps = torch.nn.functional.conv2d(maps, taps.view(1, 1, -1, 1), padding=(WINDOW_SIZE // 2, 0))
        return torch.nn.functional.conv2d(maps, taps.view(1, 1, 1, -1), padding=(0, WINDOW_SIZE // 2))

    maps = torch.cat([x, y, x * x, y * y, x * y], 2).permute(2, 0, 1)[:, None]
    m, n, xx, yy, xy = blur(maps).view(5, 3, *x.shape[:2])
    similarity = (2 * m * n + C1) * (2 * (xy - m * n) + C2)
    similarity = similarity / ((m * m + n * n + C1) * (xx - m * m + yy - n * n + C2))
    if counted is None:
        return similarity.mean()
    return (similarity * counted).sum() / (3 * counted.sum().clamp_min(1))
