"""Scenes that are drawn on another device than the CPU: the same arrays in front, torch tensors behind.

They take the place of `HybridModel` and `SplatModel` wherever these are looked at, and give numpy arrays as these do.
In float64 on the CPU they are the readable truth that the kernels are compared with.
"""

import functools
from collections.abc import Iterator
from dataclasses import dataclass, fields

import numpy as np
import torch
from torch import Tensor, nn

from compgs.cameras import Camera
from compgs.gaussians import Gaussians
from compgs.model.constants import CUTOFF_SIGMAS
from compgs.model.hybrid_model import BLOCK, HybridModel
from compgs.model.splats import SplatModel
from compgs.render.result import RasterResult
from compgs.render.settings import RasterSettings
from compgs.tensors import where
from compgs.tensors.heads import PredictionHeads, heads_of
from compgs.tensors.prediction import (
    camera_center,
    predict_appearance,
    predict_geometry,
    see,
)
from compgs.tensors.primitives import Primitives, anchor_range
from compgs.tensors.rasterize import rasterize
from compgs.tensors.splats import Splats, splat_gaussians, splat_radii
from compgs.tensors.visibility import visible_mask

CPU = torch.device("cpu")
GPU_BLOCK = 1 << 18  # anchors: a GPU is not busy with fewer


@dataclass(frozen=True, eq=False, repr=False)
class HybridOnDevice(HybridModel):
    """A hybrid scene that torch predicts and draws."""

    device: torch.device = CPU
    dtype: torch.dtype = torch.float32  # of everything
    appearance_dtype: torch.dtype = torch.float32  # of opacity and color, in float32; bfloat16: for GPUs

    @classmethod
    def of(cls, model: HybridModel, device: torch.device) -> "HybridOnDevice":
        """The same scene."""
        return cls(**{field.name: getattr(model, field.name) for field in fields(HybridModel)}, device=device)

    @functools.cached_property
    def primitive_tensors(self) -> Primitives:
        p = self.primitives
        return Primitives(
            positions=self._tensor(p.positions),
            log_scales=self._tensor(p.log_scales),
            references=self._tensor(p.references),
            residuals=self._tensor(p.residuals),
            anchor_index=torch.from_numpy(np.array(p.anchor_index)).to(self.device),
            voxel_size=p.voxel_size,
        )

    @functools.cached_property
    def networks(self) -> PredictionHeads:
        return heads_of(self.heads).to(self.device, self.dtype)

    @functools.cached_property
    def first_coupled(self) -> Tensor:
        """[N + 1] int64: where the coupled primitives of each anchor begin, and where the last one's end."""
        counts = torch.bincount(self.primitive_tensors.anchor_index, minlength=self.anchors)
        return nn.functional.pad(counts.cumsum(0), (1, 0))

    @functools.cached_property
    def geometry_tensors(self) -> tuple[Tensor, Tensor, Tensor]:
        """`geometry` on the device."""
        p = self.primitive_tensors
        means, scales, quaternions = (p.positions.new_empty(self.coupled, size) for size in (3, 3, 4))
        with torch.no_grad():
            for anchors, coupled in self._blocks():
                part = anchor_range(p, anchors, coupled)
                means[coupled], scales[coupled], quaternions[coupled] = predict_geometry(
                    self.networks, part, part.residuals, part.anchor_index
                )
        return means, scales, quaternions

    @functools.cached_property
    def bounds_tensors(self) -> tuple[Tensor, Tensor]:
        """`bounds` on the device."""
        p = self.primitive_tensors
        means, scales, _ = self.geometry_tensors
        radii = means.new_zeros(len(p))
        for _, coupled in self._blocks():
            index = p.anchor_index[coupled]
            offset = means[coupled] - p.positions.index_select(0, index)
            reach = offset.norm(dim=1) + CUTOFF_SIGMAS * scales[coupled].amax(1)
            radii.scatter_reduce_(0, index, reach, "amax")
        return p.positions, radii

    @property
    def geometry(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        means, scales, quaternions = map(_array, self.geometry_tensors)
        return means, scales, quaternions

    @functools.cached_property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        centers, radii = map(_array, self.bounds_tensors)
        return centers, radii

    def parts(self, camera: Camera, visible: np.ndarray | None = None) -> Iterator[Gaussians[np.ndarray]]:
        yield self.gaussians(camera, visible)

    def drawn(
        self, camera: Camera, visible: np.ndarray | None = None
    ) -> tuple[Gaussians[np.ndarray], np.ndarray]:
        """Return what is drawn; on a GPU all primitives of the anchors in view, those that are not drawn with opacity
        0.
        """
        mask = None if visible is None else torch.from_numpy(np.array(visible)).to(self.device)
        gaussians, index = self.drawn_tensors(camera, mask)
        return _arrays(gaussians), _array(index)

    @torch.no_grad()
    def drawn_tensors(
        self, camera: Camera, visible: Tensor | None = None
    ) -> tuple[Gaussians[Tensor], Tensor]:
        """`drawn` on the device."""
        chosen, center = self._chosen(camera, visible)
        blocks = chosen.split(GPU_BLOCK if chosen.is_cuda else BLOCK)
        parts = [self._appearance(anchors, center) for anchors in blocks]
        index, opacities, colors = (torch.cat(part) for part in zip(*parts, strict=True))
        means, scales, quaternions = (array.index_select(0, index) for array in self.geometry_tensors)
        return Gaussians(means, quaternions, scales, opacities, colors), index

    def draw(self, camera: Camera, settings: RasterSettings) -> RasterResult[np.ndarray]:
        """What a camera of the model's frame sees."""
        visible = visible_mask(*self.bounds_tensors, camera, settings)
        return _drawn(self.drawn_tensors(camera, visible)[0], camera, settings)

    def blended(
        self, gaussians: Gaussians[np.ndarray], camera: Camera, settings: RasterSettings
    ) -> "BlendedOnDevice":
        """The image of Gaussians, which need not be the scene's own, with its gradients."""
        return BlendedOnDevice.of(gaussians, camera, settings, self.device)

    def _tensor(self, array: np.ndarray) -> Tensor:
        return torch.from_numpy(np.array(array)).to(self.device, self.dtype)

    def _blocks(self) -> Iterator[tuple[slice, slice]]:
        """All anchors, BLOCK at a time, and their coupled primitives."""
        starts = self.first_coupled[:-1:BLOCK].tolist()
        for i, start in enumerate(starts):
            end = starts[i + 1] if i + 1 < len(starts) else self.coupled
            yield slice(i * BLOCK, min((i + 1) * BLOCK, self.anchors)), slice(start, end)

    def _chosen(self, camera: Camera, visible: Tensor | None) -> tuple[Tensor, Tensor]:
        """Rows of the anchors to look at ([V] int64, ascending), and the camera's center [3]."""
        center = camera_center(camera, self.device).to(self.dtype)
        if visible is None:
            return torch.arange(self.anchors, device=self.device), center
        return torch.nonzero(visible).view(-1), center

    def _appearance(
        self,
        anchors: Tensor,  # [V] int64, ascending
        center: Tensor,  # [3] of the camera, world units
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Predict the appearance of the anchors' coupled primitives that are drawn: which they are [M], opacities [M],
        colors [M, 3].

        On a GPU all of them, those that are not drawn with opacity 0.
        """
        p = self.primitive_tensors
        first = self.first_coupled.index_select(0, anchors)
        counts = self.first_coupled.index_select(0, anchors + 1) - first
        rows = torch.repeat_interleave(counts)  # of `anchors`, one for each coupled primitive
        # The anchors' ranges of coupled primitives, one after the other.
        coupled = torch.arange(len(rows), device=rows.device)
        coupled += (first + counts - counts.cumsum(0)).index_select(0, rows)
        references, positions = (t.index_select(0, anchors) for t in (p.references, p.positions))
        seen = see(references, positions, center, self.distance_unit)
        residuals = p.residuals.index_select(0, coupled)
        found = predict_appearance(
            self.networks,
            seen,
            residuals,
            rows,
            dtype=self.appearance_dtype,
            compact=where.choosing_pays(rows.device),
        )
        index = coupled if found.index is None else coupled.index_select(0, found.index)
        return index, found.opacities, found.colors


@dataclass(frozen=True, eq=False, repr=False)
class SplatsOnDevice(SplatModel):
    """Splats that torch activates and draws."""

    device: torch.device = CPU

    @classmethod
    def of(cls, model: SplatModel, device: torch.device) -> "SplatsOnDevice":
        """The same scene."""
        return cls(**{field.name: getattr(model, field.name) for field in fields(SplatModel)}, device=device)

    @functools.cached_property
    def splat_tensors(self) -> Splats:
        return Splats.of(self.splats).to(self.device)

    @torch.no_grad()
    def draw(self, camera: Camera, settings: RasterSettings) -> RasterResult[np.ndarray]:
        """What a camera of the model's frame sees."""
        splats = self.splat_tensors
        visible = visible_mask(splats.means, splat_radii(splats), camera, settings)
        chosen = splats.rows(torch.nonzero(visible).view(-1))
        return _drawn(splat_gaussians(chosen, camera), camera, settings)

    def blended(
        self, gaussians: Gaussians[np.ndarray], camera: Camera, settings: RasterSettings
    ) -> "BlendedOnDevice":
        """The image of Gaussians, which need not be the scene's own, with its gradients."""
        return BlendedOnDevice.of(gaussians, camera, settings, self.device)


@dataclass(frozen=True, eq=False)
class BlendedOnDevice:
    """An image, and what it takes to say how it depends on opacities and colors."""

    tensor: Tensor  # the image, in the autograd graph
    opacities: Tensor
    colors: Tensor

    @classmethod
    def of(
        cls,
        gaussians: Gaussians[np.ndarray],
        camera: Camera,
        settings: RasterSettings,
        device: torch.device,
    ) -> "BlendedOnDevice":
        g = Gaussians(*(torch.from_numpy(np.array(value)).to(device) for value in vars(gaussians).values()))
        g.opacities.requires_grad_()
        g.colors.requires_grad_()
        with torch.enable_grad():
            image = rasterize(g, camera, settings).image
        return cls(image, g.opacities, g.colors)

    @functools.cached_property
    def image(self) -> np.ndarray:
        """[H, W, 3] float32 RGB over the background; not clamped."""
        return _array(self.tensor)

    def gradients(self, d_image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the gradients by opacities [M] and colors [M, 3] of a number whose gradient by the image is [H, W, 3]
        float32.
        """
        d_tensor = torch.from_numpy(np.array(d_image)).to(self.tensor)
        inputs = self.opacities, self.colors
        d_opacities, d_colors = torch.autograd.grad(self.tensor, inputs, d_tensor, retain_graph=True)
        return _array(d_opacities), _array(d_colors)


def on_device(model: HybridModel | SplatModel, device: torch.device) -> HybridModel | SplatModel:
    """The same scene, to be drawn there."""
    if isinstance(model, HybridModel):
        return HybridOnDevice.of(model, device)
    return SplatsOnDevice.of(model, device)


def drawn_gaussians(
    gaussians: Gaussians[np.ndarray], camera: Camera, settings: RasterSettings, device: torch.device
) -> RasterResult[np.ndarray]:
    """The picture of Gaussians of several scenes, in one frame."""
    g = Gaussians(*(torch.from_numpy(np.array(value)).to(device) for value in vars(gaussians).values()))
    return _drawn(g, camera, settings)


def _drawn(
    gaussians: Gaussians[Tensor], camera: Camera, settings: RasterSettings
) -> RasterResult[np.ndarray]:
    with torch.no_grad():
        result = rasterize(gaussians, camera, settings)
    return RasterResult(*map(_array, vars(result).values()))


def _arrays(gaussians: Gaussians[Tensor]) -> Gaussians[np.ndarray]:
    return Gaussians(*map(_array, vars(gaussians).values()))


def _array(tensor: Tensor) -> np.ndarray:
    return tensor.detach().cpu().numpy()
