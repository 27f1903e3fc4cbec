"""How exactly the file holds the networks' weights, decided once: training rounds to it, the encoder writes it."""

from dataclasses import dataclass

from torch import Tensor

from compgs.entropy.quantization import quantize_weight
from compgs.model.constants import SHARED_RESIDUALS

MORE_FOR_BIASES = 4  # bits: biases are few
MOST_BITS = 16
SHARED_RESIDUAL_BITS = 10  # residual embeddings that all anchors share are few, too


@dataclass(frozen=True)
class StoredWeights:
    """Bits of a weight, sign included."""

    network: int  # of entropy networks
    head: int  # of prediction heads

    def bits(self, name: str, tensor: Tensor) -> int:
        """Return the bits of a weight of the heads' tensor of that name in the file."""
        if name == SHARED_RESIDUALS:
            return SHARED_RESIDUAL_BITS
        return self.head if tensor.dim() > 1 else min(MOST_BITS, self.head + MORE_FOR_BIASES)

    def rounded(self, name: str, tensor: Tensor) -> Tensor:
        """A tensor of the heads as the file will hold it, straight-through."""
        return quantize_weight(tensor, self.bits(name, tensor))
