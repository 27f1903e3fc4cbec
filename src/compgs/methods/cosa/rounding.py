"""From what was trained to the integers of a file."""

import numpy as np
from torch import nn

from compgs.codec.encoder import ONE, integer_network
from compgs.codec.format import MAX_SYMBOL
from compgs.codec.integer_network import IntegerLayer, IntegerNetwork
from compgs.entropy.network import EntropyNetwork
from compgs.entropy.quantization import weight_exponent
from compgs.errors import NotEncodable
from compgs.methods.cosa.entropy import ContextNetwork


class Rounding:
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


def integers(network: nn.Module, bits: int) -> IntegerNetwork:
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
