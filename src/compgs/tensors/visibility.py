"""Which anchors may be in a view, on torch tensors: `render/visibility.py` says how it is found out."""

import functools

import torch
from torch import Tensor

from compgs.cameras import Camera
from compgs.render import visibility
from compgs.render.settings import RasterSettings
from compgs.tensors import where


@torch.no_grad()
def visible_mask(
    positions: Tensor,  # [N, 3] world units
    radii: Tensor,  # [N] world units, of spheres that hold all that is drawn of an anchor
    camera: Camera,
    settings: RasterSettings,
) -> Tensor:  # [N] bool
    """False only where nothing of an anchor can reach a pixel."""
    if where.in_kernels(positions, radii):
        arrays = positions.detach().contiguous().numpy(), radii.detach().contiguous().numpy()
        return torch.from_numpy(visibility.visible_mask(*arrays, camera, settings))
    normals = frustum_on(camera, settings, positions.dtype, positions.device)
    return (positions @ normals[:, :3].T + normals[:, 3] >= -radii[:, None] * normals[:, 4]).all(1)


@functools.lru_cache(maxsize=4096)
def frustum_on(camera: Camera, settings: RasterSettings, dtype: torch.dtype, device: torch.device) -> Tensor:
    """`frustum` on a device; kept, as a copy to a GPU waits for it to finish its work."""
    return torch.as_tensor(visibility.frustum(camera, settings), dtype=dtype, device=device)
