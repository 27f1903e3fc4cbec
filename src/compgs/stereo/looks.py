"""Photographs as the plane sweep compares them: small, in gray, each with its pose."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from compgs.cameras import Camera
from compgs.numerics.freed_memory import give_back_freed
from compgs.scene.views import View

# Pixels of a photograph as it is compared. A point is wanted every few pixels of a photograph ten times as large;
# finer ones take longer, and find leaves that move.
COMPARED_PIXELS = 60_000
LUMA = (0.299, 0.587, 0.114)  # of ITU-R BT.601: what gray is made of


@dataclass(frozen=True)
class Look:
    """A photograph, small."""

    camera: Camera  # of the small picture
    color: np.ndarray  # [H, W, 3] uint8
    gray: Tensor  # [H, W] float32, 0 to 1
    counted: np.ndarray | None  # [H, W] bool; None: all pixels count


def small_camera(camera: Camera) -> Camera:
    """The same view with about `COMPARED_PIXELS` pixels; one that has no more stays as it is."""
    scale = min(1.0, (COMPARED_PIXELS / (camera.width * camera.height)) ** 0.5)
    return camera.resized(max(1, round(camera.width * scale)), max(1, round(camera.height * scale)))


def looks_of(views: Sequence[View], device: torch.device) -> list[Look]:
    """All views, small. Raises UnreadableImage."""
    looks = []
    for view in views:
        looks.append(look_of(view, device))
        give_back_freed()  # else a gap of a photograph's size stays before the next look: 0.9 GB of Truck's 219
    return looks


def look_of(view: View, device: torch.device) -> Look:
    """One view, small. Raises UnreadableImage."""
    camera = small_camera(view.camera)
    size = camera.height, camera.width
    image = torch.tensor(view.image).permute(2, 0, 1)[None].float()
    small = nn.functional.interpolate(image, size, mode="area")[0].permute(1, 2, 0)
    gray = (small * torch.tensor(LUMA)).sum(-1) / 255.0
    counted = None
    if view.mask is not None:
        mask = torch.tensor(view.mask)[None, None].float()
        # A pixel counts where all of what it is made of does: an edge of a mask is none of the scene.
        counted = nn.functional.interpolate(mask, size, mode="area")[0, 0].numpy() > 0.999
    return Look(camera, small.round().to(torch.uint8).numpy(), gray.to(device), counted)
