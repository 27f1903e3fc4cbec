"""How far splats are dilated, as an angle: what a picture of the training's size is drawn with, at every size.

3DGS adds 0.3 pixels^2 to the variances of what it projects, whatever the size of the picture: twice as large, splats
are too thin; half as large, too thick. A scene of ours was trained with one size of pixels, and keeps their angle.

Photographs are sharper than 0.3 pixels^2. Where many views look and bits are cheap, less is added, and the splats
learn what is as sharp as that; where few look, thin splats show themselves between the views.
"""

from collections.abc import Sequence

import numpy as np

from compgs.cameras import Camera
from compgs.codec.format import LARGEST_DILATION, SMALLEST_DILATION
from compgs.config import Config
from compgs.render.settings import LEAST_DILATION, as_angle
from compgs.training.few_views import fewness
from compgs.training.own_residuals import FEW_ENOUGH, Limits

# Of a file for each anchor of the beginning, where a size is asked for: from here on bits are as cheap as with a lambda
# of 0.002 (docs/log/2026-11-24-25-dilation.md).
BYTES = 5


def dilation(config: Config, anchors: int, views: int) -> float:
    """Pixels^2 of the training's photographs, in a run that starts with so many anchors."""
    m = config.model
    sharp = fewness(views) < FEW_ENOUGH and Limits(m.sharp_where_many, BYTES).met(config, anchors)
    return min(m.dilation, LEAST_DILATION) if sharp else m.dilation


def angular_dilation(pixels: float, cameras: Sequence[Camera]) -> float:
    """The same as an angle, as a file can hold it: float32."""
    angle = min(max(as_angle(pixels, cameras), SMALLEST_DILATION), LARGEST_DILATION)
    return float(np.float32(angle))
