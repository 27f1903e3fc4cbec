"""Rasterization on CUDA through gsplat (Apache-2.0), an optional extra.

gsplat's parts are composed here instead of calling its `rasterization`, so that `means2d` is one [M, 2]
tensor that lies on the path from parameters to image: densification reads its gradient. Written against
gsplat 1.5.
"""

import contextlib
import functools
import importlib
import importlib.util
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import torch
from torch import Tensor

from compgs.cameras import Camera
from compgs.errors import ConfigError, MissingDependency, install_line
from compgs.gaussians import Gaussians
from compgs.render.result import RasterResult
from compgs.render.settings import DEFAULT_SETTINGS, RasterSettings

TILE_SIZE = 16  # pixels


def rasterize_gsplat(gaussians: Gaussians, camera: Camera, settings: RasterSettings) -> RasterResult:
    """float32 tensors on CUDA. `visible` is gsplat's box test, which rounds boxes up to whole pixels."""
    check_settings(settings)
    gsplat = load_gsplat()
    means, opacities = gaussians.means, gaussians.opacities
    background = background_on(settings.background, means.device)
    if len(gaussians) == 0:
        return nothing_drawn(gaussians, camera, background)

    view, intrinsics = camera_on(camera, means.device)
    radii, means2d, depths, conics, kept = gsplat.fully_fused_projection(
        means.contiguous(),
        None,
        gaussians.quaternions.contiguous(),
        gaussians.scales.contiguous(),
        view,
        intrinsics,
        camera.width,
        camera.height,
        eps2d=settings.dilation_of(camera),
        near_plane=settings.near_plane,
        packed=False,
        opacities=opacities.contiguous(),
        calc_compensations=settings.antialiased,
    )
    visible = (radii[0] > 0).all(-1)
    # Rows of Gaussians that are not drawn are not initialized by gsplat.
    means2d = torch.where(visible[:, None], means2d[0], means2d.new_zeros(()))
    if settings.antialiased:
        opacities = opacities * torch.where(visible, kept[0], kept.new_zeros(()))
    columns, rows = -(-camera.width // TILE_SIZE), -(-camera.height // TILE_SIZE)
    with torch.no_grad():
        _, tiles, splats = gsplat.isect_tiles(
            means2d[None], radii, depths, TILE_SIZE, columns, rows, packed=False
        )
        offsets = gsplat.isect_offset_encode(tiles, 1, columns, rows)
    image, alphas = gsplat.rasterize_to_pixels(
        means2d[None],
        conics,
        gaussians.colors[None].contiguous(),
        opacities[None].contiguous(),
        camera.width,
        camera.height,
        TILE_SIZE,
        offsets.reshape(1, rows, columns),
        splats,
        backgrounds=background[None],
        packed=False,
    )
    return RasterResult(image[0], 1 - alphas[0, ..., 0], means2d, visible)


def check_settings(settings: RasterSettings) -> None:
    """Raises ConfigError for a setting that gsplat's kernels hold as a compiled constant."""
    free = {"background", "near_plane", "dilation", "angular_dilation", "antialiased"}
    fixed = replace(DEFAULT_SETTINGS, **{name: getattr(settings, name) for name in free})
    if settings != fixed:
        raise ConfigError(
            f"{settings}: on CUDA only {', '.join(sorted(free))} can differ from the defaults; "
            "move the Gaussians to the CPU"
        )


def nothing_drawn(gaussians: Gaussians, camera: Camera, background: Tensor) -> RasterResult:
    """The background alone. Its gradient by every Gaussian is zero, where there would otherwise be none."""
    parts = gaussians.means, gaussians.quaternions, gaussians.scales, gaussians.opacities, gaussians.colors
    zero = sum(part.sum() for part in parts) * 0.0
    image = background.expand(camera.height, camera.width, 3) + zero
    transmittance = image.new_ones(camera.height, camera.width) + zero
    return RasterResult(image, transmittance, gaussians.means[:, :2] * 1.0, gaussians.opacities > 0)


def load_gsplat() -> ModuleType:
    """The gsplat package. Raises MissingDependency where it cannot work."""
    if not torch.cuda.is_available():
        raise MissingDependency(
            "rendering on CUDA: no CUDA device is available; move the Gaussians to the CPU"
        )
    try:
        import gsplat
    except ImportError as error:
        raise MissingDependency(
            f"rendering on CUDA needs gsplat ({error}); {install_line('cuda')}"
        ) from error
    return gsplat


def build_kernels(say: Callable[[str], None]) -> None:
    """Load gsplat's compiled kernels, or compile them; `say` is told before minutes pass.

    gsplat compiles them on first use, once for an installation. Done here, before a run, the first step does not wait
    for it, and it can be interrupted. Raises MissingDependency where there are no kernels and no compiler.
    """
    load_gsplat()
    if importlib.util.find_spec("gsplat.csrc") is None and not _built_before():
        say("compiling gsplat's CUDA kernels, once for this installation: some 5 to 20 minutes")
    try:
        with contextlib.redirect_stdout(sys.stderr):  # gsplat prints, and stdout may be a program's
            backend = importlib.import_module("gsplat.cuda._backend")
    except (ImportError, OSError, RuntimeError) as error:
        raise MissingDependency(f"gsplat's CUDA kernels could not be compiled: {error}") from error
    if backend._C is None:
        raise MissingDependency(
            "rendering on CUDA: gsplat has no compiled kernels, and nvcc to compile them was not found; "
            "install the CUDA toolkit (nvcc), or use --device cpu"
        )


def _built_before() -> bool:
    """Whether an earlier process compiled the kernels."""
    from torch.utils.cpp_extension import _get_build_directory

    return any(Path(_get_build_directory("gsplat_cuda", verbose=False)).glob("gsplat_cuda.*"))


# Small tensors that would otherwise be copied to the device, and waited for, at every view.
@functools.lru_cache(maxsize=4096)
def camera_on(camera: Camera, device: torch.device) -> tuple[Tensor, Tensor]:
    """World to camera [1, 4, 4] and intrinsics [1, 3, 3] on a device."""
    intrinsics = [[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]]
    return (
        torch.tensor(camera.world_to_camera, dtype=torch.float32, device=device)[None],
        torch.tensor(intrinsics, dtype=torch.float32, device=device)[None],
    )


@functools.lru_cache(maxsize=16)
def background_on(background: tuple[float, float, float], device: torch.device) -> Tensor:
    """[3] RGB on a device."""
    return torch.tensor(background, dtype=torch.float32, device=device)
