"""What a file of COSA-GS holds, as integers, and the scene that this is. Free of torch."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from compgs.codec.integer_network import FRACTION_BITS, IntegerNetwork
from compgs.codec.weights import QuantizedTensor
from compgs.published.anchors import AnchorScene, Frame
from compgs.published.cosa.shape import ChainShape


@dataclass(frozen=True, eq=False)
class CosaContent:
    """N anchors, in canonical order (`ordering/order.py`), each with a primitive at least."""

    shape: ChainShape
    frame: Frame
    steps: Mapping[str, float]  # of each group, float32
    origin: tuple[int, int, int]  # voxels: corner of the cube in which coordinates are -1 to 1
    depth: int  # its side is 2^depth voxels
    coordinates: np.ndarray  # [N, 3] int32 voxels
    mask: np.ndarray  # [N, K] bool: coupled primitives that exist
    networks: Mapping[str, IntegerNetwork]
    latents: Mapping[str, np.ndarray]  # of each group: Q12, in steps: [N, channels]; of offsets [P, 3]
    symbols: tuple[np.ndarray, ...]  # as they are coded, one after the other
    tables: tuple[np.ndarray, ...]  # of these symbols
    weights: Mapping[str, QuantizedTensor]  # of the rendering networks


def scene_of(content: CosaContent) -> AnchorScene:
    """Return the scene that the content describes, to be rendered."""

    def natural(group: str) -> np.ndarray:
        step = np.float32(content.steps[group] * 2.0**-FRACTION_BITS)
        return content.latents[group].astype(np.float32) * step

    offsets = np.zeros((*content.mask.shape, 3), np.float32)
    offsets[content.mask] = natural("offset")
    return AnchorScene(
        content.frame,
        content.coordinates.astype(np.float32) * np.float32(content.frame.voxel_size),
        natural("feature"),
        offsets,
        natural("position_scale"),
        natural("size"),
        content.mask,
        {n: (t.values * 2.0**-t.exponent).astype(np.float32) for n, t in content.weights.items()},
    )
