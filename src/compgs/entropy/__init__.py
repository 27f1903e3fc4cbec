"""Quantization and rate (CompGS Sec. 3.3): floats, differentiable; total bits."""

from compgs.entropy.models import STREAMS, EntropyModel, Quantized

__all__ = ["STREAMS", "EntropyModel", "Quantized"]
