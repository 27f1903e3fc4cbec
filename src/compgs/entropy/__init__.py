"""Quantization and rate (CompGS Sec. 3.3): floats, differentiable; total bits. `codec` has the twin in integers.

| file | holds |
|---|---|
| `models` | the entropy model: quantized latents, and their bits by stream; its drawing is there |
| `quantization` | rounding, noise in its place, and weights as a file holds them |
| `gaussian`, `factorized` | bits of symbols: given a mean and a scale, or by a learned density |
| `conditional`, `network` | networks that predict means and scales |
| `contexts` | what is known of an anchor before it is decoded |
| `neighbourhood`, `neighbour_network` | what anchors around have, and what it lets expect |
"""

from compgs.entropy.models import STREAMS, EntropyModel, Quantized

__all__ = ["STREAMS", "EntropyModel", "Quantized"]
