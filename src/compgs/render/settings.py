"""The conventions of rasterization: those of 3DGS and gsplat, so that a scene looks as it does elsewhere."""

from collections.abc import Sequence
from dataclasses import dataclass
from statistics import median

from compgs.cameras import Camera

# Pixels^2, of pictures much smaller than those of the training, where splats would fall between the pixels.
LEAST_DILATION = 0.02


@dataclass(frozen=True)
class RasterSettings:
    """How splats become pixels; the same numbers for every backend."""

    background: tuple[float, float, float] = (0.0, 0.0, 0.0)  # RGB, 0 to 1, behind the last splat
    near_plane: float = 0.01  # world units; a Gaussian whose centre is nearer is not drawn (gsplat)
    dilation: float = (
        0.3  # pixels^2 added to the projected variances: no splat is thinner than a pixel (3DGS)
    )
    alpha_cutoff: float = 1.0 / 255.0  # a splat touches only pixels where its alpha reaches this (3DGS)
    alpha_cap: float = 0.999  # no splat is more opaque than this (gsplat)
    transmittance_stop: float = 1e-4  # a pixel is finished before its transmittance falls to this (3DGS)
    margin: float = 0.3  # half images; beyond the image plus this margin the Jacobian is held constant (3DGS)
    # The same as a scene was trained with, whatever the size of the picture: per fx fy of a camera (squares of the
    # tangents of angles), in place of `dilation`.
    angular_dilation: float | None = None
    # Whether an opacity falls as dilation spreads its splat, so that a small splat stays as bright as it is (the 2D Mip
    # filter, Yu et al. 2024): by the square root of the determinants of its covariance before and after. For splats
    # that were trained so; others would become too dark.
    antialiased: bool = False

    def dilation_of(self, camera: Camera) -> float:
        """Pixels^2 that are added in the picture of a camera."""
        if self.angular_dilation is None:
            return self.dilation
        return max(LEAST_DILATION, self.angular_dilation * camera.fx * camera.fy)


DEFAULT_SETTINGS = RasterSettings()


def as_angle(pixels: float, cameras: Sequence[Camera]) -> float:
    """`RasterSettings.angular_dilation` with which most cameras add so many pixels^2."""
    return pixels / median(camera.fx * camera.fy for camera in cameras)


def jacobian_limits(camera: Camera, settings: RasterSettings) -> tuple[float, float, float, float]:
    """Ranges of x/z (left, right) and y/z (top, bottom) where the Jacobian follows the mean."""
    wide = settings.margin * 0.5 * camera.width / camera.fx
    high = settings.margin * 0.5 * camera.height / camera.fy
    return (
        -camera.cx / camera.fx - wide,
        (camera.width - camera.cx) / camera.fx + wide,
        -camera.cy / camera.fy - high,
        (camera.height - camera.cy) / camera.fy + high,
    )
