"""A trained model becomes a file: the mirror image of `compgs.published.cosa.reader`."""

from pathlib import Path
from typing import Any

import numpy as np

from compgs.codec.mask_coder import encode_masks
from compgs.codec.octree import encode_positions
from compgs.codec.rans import encode_symbols
from compgs.codec.tables import gaussian_tables
from compgs.codec.weights import encode_heads, encode_networks
from compgs.formats.packed import Packed, write_packed
from compgs.methods.cosa.model import CosaModel
from compgs.published.cosa.content import CosaContent
from compgs.published.cosa.shape import GROUPS


def packed_content(content: CosaContent) -> Packed:
    """The container of it."""
    s, f = content.shape, content.frame
    streams = [
        encode_symbols(symbols.ravel(), tables.ravel(), gaussian_tables())
        for symbols, tables in zip(content.symbols, content.tables, strict=True)
    ]
    networks = [content.networks[name] for name, _, _ in s.network_sizes()]
    arrays = {
        "positions": encode_positions(content.coordinates),
        "masks": encode_masks(content.mask),
        "context": encode_networks(networks),
        "networks": encode_heads(list(content.weights.items())),
        "latents": b"".join(streams),
    }
    facts: dict[str, Any] = {
        "anchors": len(content.coordinates),
        "shape": [s.coupled, s.features, s.latents, s.context],
        "steps": [content.steps[group] for group in GROUPS],
        "cube": [*content.origin, content.depth],
        "frame": [f.voxel_size, f.distance_unit, *f.world_offset, *f.background],
    }
    return Packed("cosa-gs", facts, {name: np.frombuffer(data, np.uint8) for name, data in arrays.items()})


def write(model: CosaModel, path: Path) -> int:
    """The number of bytes. Raises NotEncodable, OutputError."""
    return write_packed(path, packed_content(model.content()))
