"""Coarse photographs first (not in the paper): what a step costs by its pixels is saved until details are due.

Until a share of the run photographs and renderings have a half of their width and height, or a quarter, an eighth in
equal parts of it before, as long as COARSEST_PIXELS are left: with fewer the prediction networks, and not the pixels,
are what a step takes its time for. At 480 x 359 pixels a run takes a quarter less time for the same quality in the same
bytes, at 960 x 717 four tenths less (docs/results/tried.md).
"""

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor, nn

from compgs.cameras import Camera
from compgs.losses import Target
from compgs.training.step.kept_photographs import KeptPhotographs
from compgs.training.step.views_in_turn import ViewsInTurn

COARSEST_PIXELS = 40_000


def halvings(progress: float, until: float, width: int, height: int) -> int:
    """How often a photograph of that size is halved at a `progress` of the run, 0 to 1."""
    if progress >= until:
        return 0
    return math.ceil(times_halved(width, height, COARSEST_PIXELS) * (1 - progress / until))


def times_halved(width: int, height: int, least: int) -> int:
    """How often both sides can be halved with `least` pixels left."""
    return int(math.log(max(1.0, width * height / least), 4))


def halved(camera: Camera, times: int) -> Camera:
    """The same view with sides halved so many times."""
    return camera.resized(*(max(1, round(side / 2**times)) for side in (camera.width, camera.height)))


def usual_camera(cameras: Sequence[Camera]) -> Camera:
    """One of the middle one's size."""
    by_size = sorted(range(len(cameras)), key=lambda i: cameras[i].width * cameras[i].height)
    return cameras[by_size[len(by_size) // 2]]


def divided(camera: Camera, divisor: int) -> Camera:
    """The same view with sides divided by so much."""
    if divisor == 1:
        return camera
    return camera.resized(*(max(1, side // divisor) for side in (camera.width, camera.height)))


class CoarseViews:
    """The training views as a step looks at them: camera, and what to compare its image with."""

    def __init__(self, views: ViewsInTurn, until: float) -> None:
        self.views = views
        self.until = until  # of the run
        self.cameras: dict[tuple[int, int], Camera] = {}  # by view and halvings
        self.photographs = KeptPhotographs(1 << 29)

    def sized(self, camera: Camera, progress: float) -> Camera:
        """A camera as a step at a `progress` of the run, 0 to 1, looks at it."""
        return halved(camera, halvings(progress, self.until, camera.width, camera.height))

    def look(self, view: int, camera: Camera, progress: float) -> tuple[Camera, Target]:
        """Return camera and target at a `progress` of the run, 0 to 1; the target knows its camera where photometry is
        learned.
        """
        times = halvings(progress, self.until, camera.width, camera.height)
        if times == 0:
            return camera, self.views.photograph(view)
        key = view, times
        small = self.cameras.get(key) or halved(camera, times)
        self.cameras[key] = small
        target = self.photographs.get(
            key, lambda: smaller(self.views.stored(view), small.width, small.height)
        )
        return small, self.views.with_camera(view, target)


def smaller(photograph: Target, width: int, height: int) -> Target:
    """Means over the pixels that become one. One counts if at least half of what it is made of does."""

    def shrunk(image: Tensor) -> Tensor:  # [H, W, C]
        small = nn.functional.interpolate(image.permute(2, 0, 1)[None].float(), (height, width), mode="area")
        return small[0].permute(1, 2, 0)

    image = shrunk(photograph.image).round().to(torch.uint8).contiguous()
    counted = photograph.counted
    if counted is not None:
        counted = (shrunk(counted[..., None])[..., 0] >= 0.5).contiguous()
    return replace(photograph, image=image, counted=counted)
