"""From Gaussians to pixels on the CPU: projection, binning and blending by kernels, on numpy arrays.

means, quaternions, scales ──► means2d, covariances ─┐
opacities, colors ───────────────────────────────────┴──► tiles ──► image, transmittance

`tensors/rasterize.py` has the same on torch tensors, with all gradients, and on CUDA.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from compgs.cameras import Camera
from compgs.gaussians import Gaussians
from compgs.render.binning import PARAMETERS, TileLists, list_tiles, pack_splats
from compgs.render.projection import camera_numbers, kept_opacity, project_forward
from compgs.render.result import RasterResult
from compgs.render.settings import DEFAULT_SETTINGS, RasterSettings
from compgs.render.tiles import MOMENTS, blend_backward, blend_forward, sum_moments


def rasterize(
    gaussians: Gaussians[np.ndarray], camera: Camera, settings: RasterSettings = DEFAULT_SETTINGS
) -> RasterResult[np.ndarray]:
    """The image of Gaussians, float32. Raises MemoryError for splats that would need absurd amounts of it."""
    return rasterize_parts([gaussians], len(gaussians), camera, settings)


def rasterize_parts(
    parts: Iterable[Gaussians[np.ndarray]],
    most: int,
    camera: Camera,
    settings: RasterSettings = DEFAULT_SETTINGS,
) -> RasterResult[np.ndarray]:
    """Rasterize Gaussians that come in parts, at most `most` together; no two parts need be in memory."""
    lists = tile_lists(parts, most, camera, settings)
    image, transmittance, _ = blend(lists, camera, settings)
    return RasterResult(image, transmittance, lists.packed[:, 0:2].copy(), lists.visible)


def tile_lists(
    parts: Iterable[Gaussians[np.ndarray]], most: int, camera: Camera, settings: RasterSettings
) -> TileLists:
    """What each tile of the image is blended from."""
    packed, depths = np.empty((most, PARAMETERS), np.float32), np.empty(most, np.float32)
    determinants = np.empty(most, np.float32)
    numbers = camera_numbers(camera, settings)
    m = 0
    for gaussians in parts:
        g = contiguous(gaussians)
        rows = slice(m, m + len(g))
        # In the columns that they give way to: memory that is not touched costs nothing.
        project_forward(
            g.means,
            g.quaternions,
            g.scales,
            numbers,
            packed[rows, 0:2],
            packed[rows, 2:5],
            depths[rows],
            determinants[rows],
        )
        packed[rows, 5] = g.opacities * _kept(packed[rows, 2:5], determinants[rows], camera, settings)
        packed[rows, 6:9] = g.colors
        m += len(g)
        del gaussians, g
    packed, depths = packed[:m], depths[:m]
    splats = pack_splats(
        means2d=packed[:, 0:2],
        covariances=packed[:, 2:5],
        determinants=determinants[:m],
        depths=depths,
        opacities=packed[:, 5],
        colors=packed[:, 6:9],
        width=camera.width,
        height=camera.height,
        settings=settings,
        packed=packed,
    )
    del determinants
    return list_tiles(splats, depths)


def _kept(
    covariances: np.ndarray, determinants: np.ndarray, camera: Camera, settings: RasterSettings
) -> np.ndarray | float:
    """Share of the opacities that is drawn, [M] or one number."""
    if not settings.antialiased:
        return 1.0
    return kept_opacity(covariances, determinants, settings.dilation_of(camera))


def contiguous(gaussians: Gaussians[np.ndarray]) -> Gaussians[np.ndarray]:
    """Return arrays as the kernels take them: float32, in C order, writable; copies nothing that is so already."""
    # Kernels would be compiled anew for arrays that are read-only.
    arrays = (np.require(value, np.float32, ("C", "W")) for value in vars(gaussians).values())
    return Gaussians(*arrays)


def blend(
    lists: TileLists, camera: Camera, settings: RasterSettings
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """image [H, W, 3], transmittance [H, W], and per tile the entry after the last one needed."""
    image = np.empty((camera.height, camera.width, 3), np.float32)
    transmittance = np.empty((camera.height, camera.width), np.float32)
    ends = np.empty(len(lists.starts) - 1, np.int64)
    blend_forward(
        lists.packed,
        lists.starts,
        lists.entries,
        lists.order,
        np.array(settings.background, np.float32),
        *blend_thresholds(settings),
        image,
        transmittance,
        ends,
    )
    return image, transmittance, ends


def blend_thresholds(settings: RasterSettings) -> tuple[np.float32, np.float32, np.float32]:
    """Alpha cutoff, alpha cap, and the transmittance at which a pixel is finished."""
    return (
        np.float32(settings.alpha_cutoff),
        np.float32(settings.alpha_cap),
        np.float32(settings.transmittance_stop),
    )


@dataclass(frozen=True, eq=False)
class BlendGradients:
    """Holds the gradients of a number that depends on the image, by what was blended into it, M Gaussians."""

    means2d: np.ndarray  # [M, 2]
    covariances: np.ndarray  # [M, 3]
    opacities: np.ndarray  # [M]
    colors: np.ndarray  # [M, 3]


def blend_gradients(
    lists: TileLists,
    ends: np.ndarray,  # and so on, from `blend`
    image: np.ndarray,
    transmittance: np.ndarray,
    opacities: np.ndarray,  # [M]
    settings: RasterSettings,
    d_image: np.ndarray,  # [H, W, 3]
    d_transmittance: np.ndarray,  # [H, W]
) -> BlendGradients:
    """The mirror image of `blend`."""
    moments = np.empty((len(lists.entries), MOMENTS), np.float32)
    blend_backward(
        lists.packed,
        lists.starts,
        lists.entries,
        lists.order,
        ends,
        *blend_thresholds(settings),
        image,
        transmittance,
        d_image,
        d_transmittance,
        moments,
    )
    m = len(opacities)
    gradients = BlendGradients(*(np.empty(shape, np.float32) for shape in ((m, 2), (m, 3), (m,), (m, 3))))
    sum_moments(
        lists.visible,
        lists.packed,
        lists.first_slot,
        lists.slots_used,
        lists.slots,
        moments,
        opacities,
        gradients.means2d,
        gradients.covariances,
        gradients.opacities,
        gradients.colors,
    )
    return gradients


@dataclass(frozen=True, eq=False)
class BlendedOnCpu:
    """An image, and what it takes to say how it depends on opacities and colors."""

    image: np.ndarray  # [H, W, 3] RGB over the background; not clamped
    _transmittance: np.ndarray
    _lists: TileLists
    _ends: np.ndarray
    _opacities: np.ndarray  # as they are drawn
    _kept: np.ndarray | float  # their share of the Gaussians' own
    _settings: RasterSettings

    def gradients(self, d_image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the gradients by opacities [M] and colors [M, 3] of a number whose gradient by the image is [H, W, 3]
        float32.
        """
        found = blend_gradients(
            self._lists,
            self._ends,
            self.image,
            self._transmittance,
            self._opacities,
            self._settings,
            np.require(d_image, np.float32, ("C", "W")),
            np.zeros_like(self._transmittance),
        )
        return found.opacities * self._kept, found.colors


def blended(
    gaussians: Gaussians[np.ndarray], camera: Camera, settings: RasterSettings = DEFAULT_SETTINGS
) -> BlendedOnCpu:
    """The image of Gaussians, with its gradients by their opacities and colors."""
    kept = opacity_shares(gaussians, camera, settings)
    opacities = np.require(gaussians.opacities * kept, np.float32, ("C", "W"))
    plain = replace(settings, antialiased=False)
    lists = tile_lists([replace(gaussians, opacities=opacities)], len(gaussians), camera, plain)
    image, transmittance, ends = blend(lists, camera, settings)
    return BlendedOnCpu(image, transmittance, lists, ends, opacities, kept, settings)


def opacity_shares(
    gaussians: Gaussians[np.ndarray], camera: Camera, settings: RasterSettings
) -> np.ndarray | float:
    """Share of the opacities that is drawn, [M] or one number."""
    if not settings.antialiased:
        return 1.0
    g, m = contiguous(gaussians), len(gaussians)
    means2d, covariances = np.empty((m, 2), np.float32), np.empty((m, 3), np.float32)
    depths, determinants = np.empty(m, np.float32), np.empty(m, np.float32)
    numbers = camera_numbers(camera, settings)
    project_forward(g.means, g.quaternions, g.scales, numbers, means2d, covariances, depths, determinants)
    return kept_opacity(covariances, determinants, settings.dilation_of(camera))
