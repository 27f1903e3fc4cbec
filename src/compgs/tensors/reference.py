"""The readable truth of rasterization: plain torch, any dtype, any device, small scenes.

    3D Gaussian ──project──► 2D Gaussian (mean, covariance, depth) ──sort by depth──► composite front to back

`d` is the vector from a pixel's centre to a splat's mean, alpha = opacity * exp(-d^T cov^-1 d / 2) (Kerbl et
al. 2023; the projection is Zwicker et al. 2001). Every faster backend is tested against this one, image and
gradients. Memory grows with Gaussians x pixels of a strip of rows, and autograd keeps all strips.
"""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from compgs.cameras import Camera
from compgs.gaussians import Gaussians
from compgs.render.result import RasterResult
from compgs.render.settings import DEFAULT_SETTINGS, RasterSettings, jacobian_limits

ROWS_PER_STRIP = 8
LEAST_SHARE = 1e-12  # of an opacity


@dataclass(frozen=True, eq=False)
class Splats:
    """M Gaussians after projection."""

    means2d: Tensor  # [M, 2] pixels
    covariances: Tensor  # [M, 2, 2] pixels^2, dilated
    kept: Tensor  # [M] of opacities, where the settings are antialiased: 0 to 1
    depths: Tensor  # [M] world units along the camera's z axis
    drawn: Tensor  # [M] bool: beyond the near plane, and finite


def rasterize_reference(
    gaussians: Gaussians, camera: Camera, settings: RasterSettings = DEFAULT_SETTINGS
) -> RasterResult:
    """Image and gradients by plain autograd."""
    splats = project(gaussians, camera, settings)
    if settings.antialiased:
        gaussians = replace(gaussians, opacities=gaussians.opacities * splats.kept)
    visible = splats.drawn & meets_image(splats, gaussians, camera, settings)
    image, transmittance = composite(splats, gaussians, visible, camera, settings)
    return RasterResult(image, transmittance, splats.means2d, visible)


def rotation_matrices(quaternions: Tensor) -> Tensor:
    """[M, 3, 3] of w-x-y-z quaternions [M, 4], which need not be normalized."""
    w, x, y, z = (quaternions / quaternions.norm(dim=-1, keepdim=True)).unbind(-1)
    rows = [
        torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], -1),
        torch.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], -1),
        torch.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], -1),
    ]
    return torch.stack(rows, -2)


def project(gaussians: Gaussians, camera: Camera, settings: RasterSettings) -> Splats:
    """EWA projection: the perspective map is replaced by its first-order expansion at each mean."""
    like = gaussians.means
    rotation = torch.as_tensor(camera.rotation, dtype=like.dtype, device=like.device)
    translation = torch.as_tensor(camera.translation, dtype=like.dtype, device=like.device)
    x, y, z = (gaussians.means @ rotation.T + translation).unbind(-1)
    geometry = [
        gaussians.means,
        gaussians.quaternions,
        gaussians.scales,
        gaussians.opacities[:, None],
        gaussians.colors,
    ]
    finite = torch.isfinite(torch.cat(geometry, 1)).all(1)
    drawn = finite & (z.detach() >= settings.near_plane)

    # Placeholders, so that what is not drawn has finite values and a gradient of exactly zero.
    def safe(values: Tensor, placeholder: Tensor) -> Tensor:
        return torch.where(drawn.view(-1, *[1] * (values.ndim - 1)), values, placeholder)

    x, y, z = safe(x, like.new_zeros(())), safe(y, like.new_zeros(())), safe(z, like.new_ones(()))
    quaternions = safe(gaussians.quaternions, like.new_tensor([1.0, 0.0, 0.0, 0.0]))
    scales = safe(gaussians.scales, like.new_ones(()))

    left, right, top, bottom = jacobian_limits(camera, settings)
    tx, ty = z * (x / z).clamp(left, right), z * (y / z).clamp(top, bottom)
    zero = torch.zeros_like(z)
    jacobian = torch.stack(
        [
            torch.stack([camera.fx / z, zero, -camera.fx * tx / z**2], -1),
            torch.stack([zero, camera.fy / z, -camera.fy * ty / z**2], -1),
        ],
        -2,
    )  # [M, 2, 3] pixels per world unit
    factor = jacobian @ rotation @ rotation_matrices(quaternions) * scales[:, None, :]
    dilation = settings.dilation_of(camera) * torch.eye(2, dtype=like.dtype, device=like.device)
    covariances = factor @ factor.mT + dilation
    # Squared: the determinant of F F^T for F of two rows, summed from squares, so that nothing cancels.
    before = torch.linalg.cross(factor[:, 0], factor[:, 1]).square().sum(-1)
    # The gradient of a root at zero is not finite.
    kept = torch.sqrt((before / torch.linalg.det(covariances)).clamp(min=LEAST_SHARE**2))
    means2d = torch.stack([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy], -1)
    return Splats(torch.where(drawn[:, None], means2d, zero[:, None]), covariances, kept, z.detach(), drawn)


@torch.no_grad()
def meets_image(splats: Splats, gaussians: Gaussians, camera: Camera, settings: RasterSettings) -> Tensor:
    """[M] bool: some pixel centre lies in the box where alpha can reach the cutoff."""
    reach = 2 * torch.log(gaussians.opacities / settings.alpha_cutoff)  # squared, in standard deviations
    half = torch.sqrt(reach.clamp(min=0)[:, None] * splats.covariances.diagonal(dim1=-2, dim2=-1))
    first = torch.ceil(splats.means2d - half - 0.5).clamp(min=0)
    limit = first.new_tensor([camera.width - 1, camera.height - 1])
    last = torch.minimum(torch.floor(splats.means2d + half - 0.5), limit)
    return (reach > 0) & (first <= last).all(1)


def composite(
    splats: Splats, gaussians: Gaussians, visible: Tensor, camera: Camera, settings: RasterSettings
) -> tuple[Tensor, Tensor]:
    """Image [H, W, 3] and transmittance [H, W]: alpha blending, nearest splat first."""
    like = gaussians.means
    front_to_back = torch.sort(splats.depths, stable=True).indices
    order = front_to_back[visible[front_to_back]]
    means, precisions = splats.means2d[order], torch.linalg.inv(splats.covariances[order])
    opacities, colors = gaussians.opacities[order], gaussians.colors[order]
    background = like.new_tensor(settings.background)

    images, transmittances = [], []
    for first_row in range(0, camera.height, ROWS_PER_STRIP):
        rows = torch.arange(first_row, min(first_row + ROWS_PER_STRIP, camera.height), device=like.device)
        columns = torch.arange(camera.width, device=like.device)
        y, x = torch.meshgrid(rows + 0.5, columns + 0.5, indexing="ij")
        d = means[:, None, None] - torch.stack([x, y], -1).to(like)  # [S, rows, W, 2]
        mahalanobis = torch.einsum("srwi,sij,srwj->srw", d, precisions, d)
        alpha = (opacities[:, None, None] * torch.exp(-mahalanobis / 2)).clamp(max=settings.alpha_cap)
        alpha = torch.where(alpha >= settings.alpha_cutoff, alpha, torch.zeros_like(alpha))
        through = torch.cumprod(1 - alpha, 0)  # what a pixel's splats up to and including this one let pass
        # The splat that would exhaust a pixel is left out, and so is all behind it: the product only falls.
        alpha = torch.where(through > settings.transmittance_stop, alpha, torch.zeros_like(alpha))
        through = torch.cumprod(1 - alpha, 0)
        before = torch.cat([torch.ones_like(through[:1]), through[:-1]])
        transmittance = through[-1] if len(through) else torch.ones_like(x, dtype=like.dtype)
        images.append(
            torch.einsum("srw,sc->rwc", alpha * before, colors) + transmittance[..., None] * background
        )
        transmittances.append(transmittance)
    return torch.cat(images), torch.cat(transmittances)
