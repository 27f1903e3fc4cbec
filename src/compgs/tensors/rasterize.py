"""One function from tensors to pixels; the device decides who draws."""

from torch import Tensor

from compgs.cameras import Camera
from compgs.gaussians import Gaussians
from compgs.render.result import RasterResult
from compgs.render.settings import DEFAULT_SETTINGS, RasterSettings
from compgs.tensors import where
from compgs.tensors.reference import rasterize_reference


def rasterize(
    gaussians: Gaussians[Tensor], camera: Camera, settings: RasterSettings = DEFAULT_SETTINGS
) -> RasterResult[Tensor]:
    """Differentiable rendering: gsplat on CUDA, numba for float32 on the CPU, the reference otherwise.

    The kernels for the CPU have no gradients of antialiased splats, which nothing here trains: the reference has.

    Gradients go to means, quaternions, scales, opacities and colors; cameras and settings are constants.
    """
    means = gaussians.means
    # Imported here: a renderer on the CPU needs no gsplat, one on CUDA no compiled CPU kernels.
    if where.on_gpu(means):
        from compgs.tensors.gsplat_backend import rasterize_gsplat

        return rasterize_gsplat(gaussians, camera, settings)
    if where.in_kernels(means):
        from compgs.tensors.numba_backend import rasterize_numba, wants_gradients

        if not (settings.antialiased and wants_gradients(gaussians)):
            return rasterize_numba(gaussians, camera, settings)
    return rasterize_reference(gaussians, camera, settings)
