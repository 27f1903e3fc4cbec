"""What a profile calls the parts of a step of the hybrid method."""

from collections.abc import Iterator

from torch import Tensor

from compgs.gaussians import Gaussians
from compgs.render import RasterResult

# Methods of the trainer and of what it has, by dotted names.
PARTS = {
    "survey.visible_anchors": "culling",
    "latents.quantize": "entropy",
    "gradients.predict_shared": "prediction",
    "gradients.predict": "prediction",
    "pictures.rasterize": "projection and rasterization",
    "gradients.regularize": "loss",
    "pictures.backward": "prediction, backward",
    "latents.rate_of": "entropy",
    "latents.backward_latents": "entropy, backward",
    "latents.learn_neighbours": "entropy, backward",
    "update": "optimizer",
    "gradients.observe": "control",
    "finish_step": "control",
}


def stations(
    loss: Tensor, rendered: RasterResult, gaussians: Gaussians
) -> Iterator[tuple[str, tuple[Tensor, ...]]]:
    """Where the gradients of a view arrive, part by part; the rest is the prediction's."""
    yield "loss, backward", (rendered.image,)
    yield "rasterization, backward", (rendered.means2d,)
    yield "projection, backward", (gaussians.means, gaussians.quaternions, gaussians.scales)
