"""A file becomes a scene again: the mirror image of writer.py. Every promise is bounded before anything is computed."""

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from compgs.codec.fields import FieldReader
from compgs.codec.format import MAX_ANCHORS, MAX_SYMBOL
from compgs.codec.limits import HEAD_PRODUCTS, NETWORK_PRODUCTS, check_amount
from compgs.codec.mask_coder import decode_masks
from compgs.codec.octree import decode_positions
from compgs.codec.rans import read_symbols
from compgs.codec.tables import gaussian_tables
from compgs.codec.weights import decode_heads, decode_networks
from compgs.errors import BitstreamError, CorruptSection, SplatFileError
from compgs.formats.packed import Packed
from compgs.published.anchors import AnchorScene, Frame, network_shapes
from compgs.published.cosa.chain import coordinate_inputs, walk
from compgs.published.cosa.content import CosaContent, scene_of
from compgs.published.cosa.shape import GROUPS, ChainShape

if TYPE_CHECKING:
    from compgs.devices import Device

MOST = (64, 256, 16, 256)  # coupled primitives, features, latents, channels of a context
DEEPEST = 21  # of the cube
FARTHEST = 1 << 31  # voxels, of its corner
SMALLEST, LARGEST = 2.0**-64, 2.0**64


def opened(packed: Packed, device: "Device", background: tuple[float, float, float]) -> AnchorScene:
    """The scene of such a file; drawn by the CPU, on whatever device. Raises SplatFileError."""
    return scene_of(content_of(packed))


def content_of(packed: Packed) -> CosaContent:
    """Raises SplatFileError, naming what is wrong."""
    try:
        return _content(packed)
    except BitstreamError as error:
        raise SplatFileError(f"{packed.path}: {error}; copy it again") from error


def _content(packed: Packed) -> CosaContent:
    """Raises BitstreamError, SplatFileError."""
    shape, frame, steps, origin, depth = _facts(packed)
    size = sum(array.nbytes for array in packed.arrays.values())
    count = packed.whole_number("anchors", 1, MAX_ANCHORS)

    def part(name: str) -> bytes:
        return packed.array(name, np.uint8, (None,)).tobytes()

    coordinates = decode_positions(part("positions"), count)  # (a quarter of a byte an anchor at least)
    mask = decode_masks(part("masks"), count, shape.coupled)
    if not mask.any(1).all():
        raise CorruptSection("masks: an anchor has no primitives")
    sizes = list(shape.network_sizes())
    networks = decode_networks(
        part("context"),
        "context",
        [(inputs, outputs) for _, inputs, outputs in sizes],
        lambda products: check_amount(NETWORK_PRODUCTS, count * products, size, "context"),
    )
    heads = decode_heads(
        part("networks"),
        "networks",
        lambda weights: check_amount(HEAD_PRODUCTS, count * weights, size, "networks"),
    )
    weights = dict(heads)
    _check_weights({name: tensor.values.shape for name, tensor in weights.items()}, shape)
    reader = FieldReader(part("latents"), "latents")
    named = {name: network for (name, _, _), network in zip(sizes, networks, strict=True)}
    places = coordinate_inputs(coordinates, np.array(origin, np.int64), depth)
    symbols: list[np.ndarray] = []
    tables: list[np.ndarray] = []

    def code(group: str, means: np.ndarray, index: np.ndarray) -> np.ndarray:
        found = read_symbols(reader, index.ravel(), gaussian_tables()).reshape(index.shape)
        if found.size and (found.min() < -MAX_SYMBOL or found.max() > MAX_SYMBOL):
            raise CorruptSection(f"latents: a symbol of a {group} is not in -{MAX_SYMBOL} to {MAX_SYMBOL}")
        symbols.append(found)
        tables.append(index)
        return found

    latents = walk(shape, named, places, mask, code)
    reader.end()
    return CosaContent(
        shape=shape,
        frame=frame,
        steps=steps,
        origin=origin,
        depth=depth,
        coordinates=coordinates,
        mask=mask,
        networks=named,
        latents=latents,
        symbols=tuple(symbols),
        tables=tuple(tables),
        weights=weights,
    )


def _facts(packed: Packed) -> tuple[ChainShape, Frame, dict[str, float], tuple[int, int, int], int]:
    """Raises SplatFileError for what no encoder writes."""
    sizes = _numbers(packed, "shape", len(MOST), whole=True)
    if not all(1 <= size <= most for size, most in zip(sizes, MOST, strict=True)):
        raise SplatFileError(f"{packed.path}: shape: expected 1 to {MOST}, found {sizes}")
    shape = ChainShape(*(int(size) for size in sizes))
    steps = _numbers(packed, "steps", len(GROUPS))
    *corner, depth = (int(v) for v in _numbers(packed, "cube", 4, whole=True))
    if not 0 <= depth <= DEEPEST or max(map(abs, corner)) >= FARTHEST:
        raise SplatFileError(f"{packed.path}: cube: {corner}, {depth} levels, expected at most {DEEPEST}")
    voxel, unit, x, y, z, red, green, blue = _numbers(packed, "frame", 8)
    if not all(SMALLEST <= value <= LARGEST for value in (voxel, unit, *steps)):
        raise SplatFileError(f"{packed.path}: a step or unit is not in {SMALLEST:.3g} to {LARGEST:.3g}")
    frame = Frame(voxel, unit, (red, green, blue), (x, y, z))
    return shape, frame, dict(zip(GROUPS, steps, strict=True)), (corner[0], corner[1], corner[2]), depth


def _numbers(packed: Packed, name: str, count: int, *, whole: bool = False) -> list[float]:
    """One of the facts. Raises SplatFileError unless it is a list of so many finite numbers."""
    values: Any = packed.facts.get(name)
    kinds = (int,) if whole else (int, float)
    fits = isinstance(values, list) and len(values) == count
    if not fits or not all(type(v) in kinds and math.isfinite(v) and abs(v) <= LARGEST for v in values):
        raise SplatFileError(f"{packed.path}: {name}: expected {count} numbers, found {values!r:.80}")
    return list(values)


def _check_weights(found: dict[str, tuple[int, ...]], shape: ChainShape) -> None:
    """Raises CorruptSection unless these are the shapes of the rendering networks, of some hidden width."""
    width = found.get("opacity_bias1", (0,))
    expected = network_shapes(shape.features, shape.coupled, width[0] if width else 0)
    if found != expected or 0 in width:
        differing = sorted(
            name for name in found.keys() | expected.keys() if found.get(name) != expected.get(name)
        )
        raise CorruptSection(f"networks: {differing[0] if differing else 'width'} is not as expected")
