"""A trained model becomes a file: the mirror image of reader.py."""

from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn

from compgs.codec.encoder import ONE, integer_network, quantized_tensor
from compgs.codec.format import MAX_SYMBOL
from compgs.codec.integer_network import IntegerLayer, IntegerNetwork
from compgs.codec.mask_coder import encode_masks
from compgs.codec.octree import encode_positions
from compgs.codec.rans import encode_symbols
from compgs.codec.tables import gaussian_tables
from compgs.codec.weights import encode_heads, encode_networks
from compgs.entropy.network import EntropyNetwork
from compgs.entropy.quantization import weight_exponent
from compgs.errors import NotEncodable
from compgs.formats.packed import Packed, write_packed
from compgs.methods.cosa.chain import coordinate_inputs, walk
from compgs.methods.cosa.content import CosaContent
from compgs.methods.cosa.entropy import ContextNetwork
from compgs.methods.cosa.model import CosaModel
from compgs.methods.cosa.shape import GROUPS
from compgs.ordering.order import canonical_order


@torch.no_grad()
def content_of(model: CosaModel) -> CosaContent:
    """All that the file holds, as integers. Raises NotEncodable for what has diverged, or has nothing left."""
    for name, parameter in model.named_parameters():
        if not torch.isfinite(parameter).all():
            raise NotEncodable(f"{name} holds values that are not finite: the training has diverged")
    mask = model.kept().cpu().numpy()
    rows = np.flatnonzero(mask.any(1))
    if not len(rows):
        raise NotEncodable("all primitives are masked: there is nothing to encode")
    coordinates = model.coordinates.cpu().numpy()
    rows = rows[canonical_order(coordinates[rows])]
    coordinates, mask = coordinates[rows], mask[rows]
    networks = {
        name: _integers(n, model.config.cosa.network_bits) for name, n in model.chain.networks.items()
    }
    steps = {group: float(np.float32(model.chain.step(group).item())) for group in GROUPS}
    y = {g: v.detach().cpu().double().numpy()[rows] / steps[g] for g, v in model.natural().items()}
    y["offset"] = y["offset"].reshape(*mask.shape, 3)[mask]
    coded = _Rounding(y)
    places = coordinate_inputs(coordinates, model.origin.cpu().numpy(), int(model.depth))
    latents = walk(model.chain.shape, networks, places, mask, coded)
    corner_x, corner_y, corner_z = (int(v) for v in model.origin)
    return CosaContent(
        shape=model.chain.shape,
        frame=model.frame,
        steps=steps,
        origin=(corner_x, corner_y, corner_z),
        depth=int(model.depth),
        coordinates=coordinates,
        mask=mask,
        networks=networks,
        latents=latents,
        symbols=tuple(coded.symbols),
        tables=tuple(coded.tables),
        weights={n: quantized_tensor(w, model.weight_bits(w)) for n, w in model.networks.weights().items()},
    )


class _Rounding:
    """Symbols from values [rows, channels] in steps; remembers what it has coded."""

    def __init__(self, y: dict[str, np.ndarray]) -> None:
        self.y = y
        self.symbols: list[np.ndarray] = []
        self.tables: list[np.ndarray] = []
        self.latents = 0

    def __call__(self, group: str, means: np.ndarray, tables: np.ndarray) -> np.ndarray:
        y = self.y[group]
        if group == "latent":
            y, self.latents = y[:, self.latents : self.latents + 1], self.latents + 1
        steps = np.rint(y - means / ONE)
        if steps.size and np.abs(steps).max() > MAX_SYMBOL:
            raise NotEncodable(
                f"a {group.replace('_', ' ')} is {np.abs(steps).max():.3g} steps from what is expected of it, at most "
                f"{MAX_SYMBOL} can be coded: the training has diverged"
            )
        symbols = steps.astype(np.int32)
        self.symbols.append(symbols)
        self.tables.append(tables)
        return symbols


def _integers(network: nn.Module, bits: int) -> IntegerNetwork:
    """Return the network as the decoder evaluates it."""
    if isinstance(network, EntropyNetwork):
        return integer_network(network, bits)
    assert isinstance(network, ContextNetwork)
    layers = []
    limit = (1 << (bits - 1)) - 1
    for weight, bias in network.layers():
        exponent = weight_exponent(weight, bits)
        values = (weight.detach().double() * 2.0**exponent).round().clamp(-limit, limit)
        fixed = np.rint(bias.detach().double().cpu().numpy() * ONE).astype(np.int64)
        layers.append(IntegerLayer(values.cpu().numpy().astype(np.int32), fixed, exponent, rectify=True))
    return IntegerNetwork(tuple(layers))


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
    return write_packed(path, packed_content(content_of(model)))
