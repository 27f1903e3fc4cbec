"""From dequantized latents to Gaussians in plain numpy, written from docs/bitstream_prediction.md alone.

Slow, one primitive at a time, in float64, and independent of the package: it shows that the document is complete, and
the tests hold the real prediction against it.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

Vector = np.ndarray
Arrays = dict[str, np.ndarray]

CUTOFF = 1.0 / 255.0
LARGEST = 2.0**127
SLOPE = 2.0**-6
TOLERANCE = 1e-4
SIZE_TOLERANCE = 1e-6
POSITION_TOLERANCE = 2.0**-21


@dataclass(frozen=True)
class Content:
    """What a decoder has read: N anchors, P coupled primitives, numbers in the units of the document."""

    heads: Arrays  # by name: integers times 2^-exponent
    layout: str  # "separate", "paired" or "shallow"
    coordinates: np.ndarray  # [N, 3] whole numbers of voxels
    mask: np.ndarray  # [N, K] bool: which coupled primitives exist
    references: np.ndarray  # [N, reference_dim]
    log_scales: np.ndarray  # [N, 6]
    residuals: (
        np.ndarray
    )  # [P, residual_dim], by anchor, then slot; not looked at if the heads have `residuals`
    voxel_size: float  # world units
    view_distance_scale: float  # world units
    world_offset: tuple[float, float, float] = (0.0, 0.0, 0.0)  # world units


class Primitive(NamedTuple):
    """A coupled primitive as a camera sees it, in the local frame."""

    anchor: int
    slot: int
    mean: Vector  # [3] world units from the world offset
    scales: Vector  # [3] world units
    quaternion: Vector  # [4] w-x-y-z, not normalized
    opacity: float
    color: Vector  # [3]
    position: Vector  # [3] of its anchor: mean = position + move * reach
    move: Vector  # [3]
    reach: Vector  # [3] world units
    size: Vector  # [3] world units; scales are shares of it


def rounded(content: Content, dtype: type) -> Content:
    """The same content in numbers of another precision, in which everything is then computed."""
    return replace(
        content,
        heads={name: tensor.astype(dtype) for name, tensor in content.heads.items()},
        references=content.references.astype(dtype),
        log_scales=content.log_scales.astype(dtype),
        residuals=content.residuals.astype(dtype),
    )


def leaky(x: Vector) -> Vector:
    return np.where(x >= 0, x, SLOPE * x)


def sigmoid(x: Vector) -> Vector:
    with np.errstate(over="ignore"):
        return 1 / (1 + np.exp(-x))


def network_steps(heads: Arrays, network: str, x: Vector) -> Iterator[tuple[str, Vector]]:
    """Every step of a residual MLP, by name; the last one is its output."""

    def tensor(name: str) -> np.ndarray:
        return heads[f"{network}.{name}"]

    h = x @ tensor("input_weight") + tensor("input_bias")
    yield "entry", h
    h = leaky(h)
    yield "hidden", h
    for b in range(sum(name.startswith(f"{network}.blocks.") for name in heads) // 4):
        u = h @ tensor(f"blocks.{b}.weight1") + tensor(f"blocks.{b}.bias1")
        yield f"block {b} entry", u
        h = h + (leaky(u) @ tensor(f"blocks.{b}.weight2") + tensor(f"blocks.{b}.bias2"))
        yield f"block {b}", h
    yield "skip", x @ tensor("skip_weight")
    yield "output", h @ tensor("output_weight") + x @ tensor("skip_weight") + tensor("output_bias")


def evaluate(heads: Arrays, network: str, *parts: Vector) -> Vector:
    *_, (_, output) = network_steps(heads, network, np.concatenate(parts))
    return output


def view_embedding(position: Vector, center: Vector, view_distance_scale: float) -> Vector:
    offset = position - center
    distance = np.sqrt((offset * offset).sum())
    return np.append(offset / max(distance, 1e-12), distance / view_distance_scale).astype(position.dtype)


def residuals_by_slot(content: Content) -> Iterator[tuple[int, int, Vector]]:
    """Anchor, slot and residual embedding of every coupled primitive that exists."""
    shared = content.heads.get("residuals")
    own = iter(content.residuals)
    for anchor, slot in np.argwhere(content.mask):
        yield int(anchor), int(slot), next(own) if shared is None else shared[slot]


def geometry_and_appearance(
    content: Content, reference: Vector, view: Vector, residual: Vector
) -> tuple[Vector, Vector]:
    """r [10] and a [4] of one coupled primitive."""
    heads = content.heads
    if content.layout != "separate":
        return (
            evaluate(heads, "geometry", reference, residual),
            evaluate(heads, "appearance", reference, view, residual),
        )
    geometry = [evaluate(heads, name, reference, residual) for name in ("translation", "covariance")]
    appearance = [evaluate(heads, name, reference, view, residual) for name in ("opacity", "color")]
    return np.concatenate(geometry), np.concatenate(appearance)


def primitives(content: Content, camera_center: tuple[float, float, float]) -> Iterator[Primitive]:
    """All coupled primitives, drawn or not, as a camera at `camera_center` (world units) sees them."""
    dtype = content.references.dtype.type
    center = (np.array(camera_center, np.float64) - np.array(content.world_offset)).astype(dtype)
    for anchor, slot, residual in residuals_by_slot(content):
        position = content.coordinates[anchor].astype(dtype) * dtype(content.voxel_size)
        view = view_embedding(position, center, content.view_distance_scale)
        r, a = geometry_and_appearance(content, content.references[anchor], view, residual)
        reach, size = np.split(np.exp(content.log_scales[anchor]) * dtype(content.voxel_size), 2)
        yield Primitive(
            anchor,
            slot,
            mean=position + r[:3] * reach,
            scales=sigmoid(r[3:6]) * size,
            quaternion=r[6:10] + np.array([1, 0, 0, 0], dtype),
            opacity=float(np.tanh(a[0])),
            color=sigmoid(a[1:4]),
            position=position,
            move=r[:3],
            reach=reach,
            size=size,
        )


def drawn(content: Content, camera_center: tuple[float, float, float]) -> list[Primitive]:
    """Those that are drawn, in the order of the file."""
    return [p for p in primitives(content, camera_center) if is_drawn(p)]


def is_drawn(p: Primitive) -> bool:
    numbers = np.concatenate([p.mean, p.scales, p.quaternion, [p.opacity], p.color])
    return p.opacity > CUTOFF and bool((np.abs(numbers) < LARGEST).all() and p.quaternion.any())


def stacked(chosen: list[Primitive]) -> Arrays:
    """One array for each field, a row a primitive."""
    return {name: np.array([getattr(p, name) for p in chosen], np.float64) for name in Primitive._fields}


def tolerances(truth: Arrays) -> Arrays:
    """What docs/bitstream_prediction.md allows each number to differ by."""
    norm = np.linalg.norm(truth["quaternion"], axis=1, keepdims=True)
    far = np.abs(truth["position"]).max(1, keepdims=True)
    return {
        "mean": TOLERANCE * truth["reach"] * (1 + np.abs(truth["move"])) + POSITION_TOLERANCE * far,
        "scales": TOLERANCE * truth["scales"] + SIZE_TOLERANCE * truth["size"],
        "quaternion": TOLERANCE * np.maximum(norm, 1),
        "opacity": np.full(len(norm), TOLERANCE),
        "color": np.full((len(norm), 1), TOLERANCE),
    }
