"""Splats whose color is a network's, and their file. Free of torch.

| array | what |
|---|---|
| `means` | float16: (mean - `middle`) / `unit` |
| `opacities` | float16: logits |
| `scales`, `rotations` | indices of all stages, splat by splat, in as many bits as they need |
| `scale_codes`, `rotation_codes` | float32 [stages, codes, 3 or 4]: standard deviations and unit quaternions are sums |
| `grid`, `weights.0` ... | float16: the color network |
"""

import functools
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from compgs.cameras import Camera
from compgs.errors import SplatFileError
from compgs.formats.arrays import drawable
from compgs.formats.packed import Packed
from compgs.gaussians import Gaussians
from compgs.model.splats import SplatArrays, SplatModel
from compgs.published.compact_3dgs import MOST_CELLS, MOST_FEATURES, MOST_LEVELS, MOST_TABLE_BITS
from compgs.published.compact_3dgs.color_network import ColorNetwork, network_shapes
from compgs.published.compact_3dgs.hash_grid import GridLayout
from compgs.published.parts.content import Content, Offset, stored_place
from compgs.published.parts.indices import packed_indices, stored_indices

if TYPE_CHECKING:
    from compgs.devices import Device

MOST_STAGES, MOST_CODES = 16, 1 << 12
SMALLEST_SCALE = 1e-6  # of `unit`: sums of codes may be negative
RAW = ("raw",)  # as published, nothing is compressed any further


@dataclass(frozen=True, eq=False)
class NetworkColored:
    """A scene of splats, to be rendered; see `compgs.render.Renderable`. It is drawn on the CPU."""

    shapes: SplatModel  # without color
    network: ColorNetwork

    @property
    def background(self) -> tuple[float, float, float]:
        return self.shapes.background

    @property
    def angular_dilation(self) -> None:
        """3DGS's pixels, in pictures of every size."""
        return None

    @property
    def antialiased(self) -> bool:
        """Trained with plain dilation."""
        return False

    @property
    def world_offset(self) -> Offset:
        return self.shapes.world_offset

    @property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        return self.shapes.bounds

    @property
    def viewpoints(self) -> tuple[Camera, ...]:
        return ()

    @property
    def counts(self) -> Mapping[str, int]:
        return self.shapes.counts

    @property
    def most_gaussians(self) -> int:
        return self.shapes.most_gaussians

    def over(self, background: tuple[float, float, float]) -> "NetworkColored":
        return replace(self, shapes=self.shapes.over(background))

    def gaussians(self, camera: Camera, visible: np.ndarray | None = None) -> Gaussians[np.ndarray]:
        """What a camera sees."""
        found = self.shapes.gaussians(camera, visible)
        return replace(found, colors=self.network.colors(found.means, camera.center))

    def parts(self, camera: Camera, visible: np.ndarray | None = None) -> Iterator[Gaussians[np.ndarray]]:
        """The same, as one part."""
        yield self.gaussians(camera, visible)


@dataclass(frozen=True, eq=False)
class Shapes:
    """What a training gives beside the network."""

    means: np.ndarray  # [M, 3] world units
    opacity_logits: np.ndarray  # [M]
    scale_labels: np.ndarray  # [M, stages]
    rotation_labels: np.ndarray  # [M, stages]
    scale_codes: np.ndarray  # [stages, codes, 3] float32, world units
    rotation_codes: np.ndarray  # [stages, codes, 4] float32


def compact_content(
    shapes: Shapes,
    network: ColorNetwork,
    world_offset: Offset,
    background: tuple[float, float, float],
    device: "Device",
) -> Content:
    """What a file will hold."""
    codes, grid = shapes.scale_codes.shape[1], network.layout
    facts: dict[str, Any] = {
        "offset": list(world_offset),
        "middle": [float(x) for x in network.middle],
        "unit": network.unit,
        "grid_levels": grid.levels,
        "grid_features": grid.features,
        "grid_base": grid.base,
        "grid_growth": grid.growth,
        "grid_bits": grid.table_bits,
    }
    arrays = {
        "means": _half((shapes.means - network.middle) / np.float32(network.unit)),
        "opacities": _half(shapes.opacity_logits),
        "scales": packed_indices(shapes.scale_labels.reshape(-1), codes),
        "rotations": packed_indices(shapes.rotation_labels.reshape(-1), codes),
        "scale_codes": shapes.scale_codes,
        "rotation_codes": shapes.rotation_codes,
        "grid": _half(network.grid),
        **{f"weights.{i}": _half(weights) for i, weights in enumerate(network.weights)},
    }
    return Content(Packed("compact-3dgs", facts, arrays), background, opened, RAW, device)


def opened(packed: Packed, device: "Device", background: tuple[float, float, float]) -> NetworkColored:
    """Inverse of `compact_content`. Raises SplatFileError."""
    network = _network(packed)
    stored = packed.array("means", np.float16, (None, 3))
    count = len(stored)
    if not count:
        raise SplatFileError(f"{packed.path}: holds no splats")
    scales = np.maximum(_summed(packed, "scale", count, 3), np.float32(SMALLEST_SCALE * network.unit))
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):  # whatever a file holds is looked at
        arrays = SplatArrays(
            stored.astype(np.float32) * np.float32(network.unit) + network.middle,
            np.log(scales),
            _summed(packed, "rotation", count, 4),
            packed.array("opacities", np.float16, (count,)).astype(np.float32),
            np.zeros((count, 3), np.float32),
            np.zeros((count, 0, 3), np.float32),
            stored_place(packed),
        )
    return NetworkColored(SplatModel(drawable(packed.path, arrays), background), network)


def _network(packed: Packed) -> ColorNetwork:
    """Raises SplatFileError."""
    growth, unit = packed.number("grid_growth"), packed.number("unit")
    levels = packed.whole_number("grid_levels", 1, MOST_LEVELS)
    base = packed.whole_number("grid_base", 1, MOST_CELLS)
    if not 1 <= growth <= 4 or base * growth ** (levels - 1) > MOST_CELLS:
        raise SplatFileError(
            f"{packed.path}: grid_growth: expected at most {MOST_CELLS} cells, found {growth}"
        )
    if not 1e-30 < unit < 1e30:
        raise SplatFileError(f"{packed.path}: unit: expected above 0, found {unit}")
    layout = GridLayout(
        levels,
        packed.whole_number("grid_features", 1, MOST_FEATURES),
        base,
        growth,
        packed.whole_number("grid_bits", 4, MOST_TABLE_BITS),
    )
    shapes = network_shapes(layout.width)
    weights = [_finite(packed, f"weights.{i}", np.float16, shape) for i, shape in enumerate(shapes)]
    grid = _finite(packed, "grid", np.float16, (layout.total, layout.features))
    middle = np.array(stored_place(packed, "middle"), np.float32)
    return ColorNetwork(layout, grid, tuple(weights), middle, unit)


def _summed(packed: Packed, name: str, count: int, numbers: int) -> np.ndarray:
    """[count, numbers] float32: sums of codes. Raises SplatFileError."""
    codes = _finite(packed, f"{name}_codes", np.float32, (None, None, numbers))
    stages, size = codes.shape[:2]
    if not (1 <= stages <= MOST_STAGES and 1 <= size <= MOST_CODES):
        raise SplatFileError(f"{packed.path}: {name}_codes: found {stages} stages of {size} codes")
    labels = stored_indices(packed, f"{name}s", count * stages, size).reshape(count, stages)
    return functools.reduce(np.add, (codes[stage][labels[:, stage]] for stage in range(stages)))


def _finite(packed: Packed, name: str, kind: type[np.generic], shape: tuple[int | None, ...]) -> np.ndarray:
    """An array as float32. Raises SplatFileError."""
    array = packed.array(name, kind, shape).astype(np.float32)
    if not np.isfinite(array).all():
        raise SplatFileError(f"{packed.path}: {name}: hold what is not a finite number; copy it again")
    return array


def _half(values: np.ndarray) -> np.ndarray:
    """float16; larger numbers than that can hold are its largest."""
    most = np.float32(np.finfo(np.float16).max)
    return np.clip(values, -most, most).astype(np.float16)
