"""Pictures of training views: drawn, compared with their photographs, and led back to what they were drawn from."""

import torch
from torch import Tensor

from compgs.cameras import Camera
from compgs.gaussians import Gaussians
from compgs.losses import (
    FEW_DRAWN,
    Target,
    photometric_loss,
    revival_loss,
    scale_regularizer,
    scale_unit,
)
from compgs.render import RasterResult, RasterSettings
from compgs.tensors.prediction import Prediction, camera_center
from compgs.tensors.rasterize import rasterize


class Pictures:
    """Draws views, compares them, and goes back from there."""

    def __init__(self, settings: RasterSettings, ssim_weight: float) -> None:
        self.settings = settings
        self.ssim_weight = ssim_weight

    def rasterize(self, gaussians: Gaussians, camera: Camera, *, watched: bool) -> RasterResult:
        """Draw a view. Where control of density watches the step, the gradients by the 2D means are kept for it."""
        rendered = rasterize(gaussians, camera, self.settings)
        if watched:
            rendered.means2d.retain_grad()
        return rendered

    def compare(self, rendered: RasterResult, target: Target) -> Tensor:
        """[] by how much a picture differs from its photograph."""
        return photometric_loss(rendered.image, target, self.ssim_weight)

    def backward(self, loss: Tensor, rendered: RasterResult, gaussians: Gaussians) -> None:
        """Compute the gradients of a view. The arguments are the tensors at which a profile takes the time
        (`stations` of the trainers).
        """
        loss.backward()


def volume_loss(prediction: Prediction, gaussians: Gaussians, camera: Camera, extent: float) -> Tensor:
    """[] mean product of the scales of a view's Gaussians, in units of the scene's `extent` or their distance."""
    unit = scale_unit(gaussians.means, camera_center(camera, gaussians.means.device), extent)
    return scale_regularizer(gaussians.scales / unit, prediction.drawn)


def vanishing_loss(prediction: Prediction) -> Tensor | float:
    """Keep a scene of which hardly anything is drawn from vanishing; 0 otherwise."""
    if prediction.drawn is not None:
        few = prediction.drawn.float().mean() < FEW_DRAWN
        return torch.where(few, revival_loss(prediction.opacities), 0.0)
    if len(prediction.index) < FEW_DRAWN * len(prediction.opacities):
        return revival_loss(prediction.opacities)
    return 0.0
