"""Hybrid primitives and inter-primitive prediction (CompGS Sec. 3.1, 3.2) of scenes that are looked at; splats.

All on numpy arrays; `tensors` has what is trained. Names are resolved on first use.
"""

import importlib
from typing import TYPE_CHECKING

_HOME = {
    "HeadDimensions": "head_weights",
    "HeadWeights": "head_weights",
    "HybridModel": "hybrid_model",
    "PrimitiveArrays": "arrays",
    "SplatArrays": "splats",
    "SplatModel": "splats",
}

__all__ = ["HeadDimensions", "HeadWeights", "HybridModel", "PrimitiveArrays", "SplatArrays", "SplatModel"]

if TYPE_CHECKING:
    from compgs.model.arrays import PrimitiveArrays
    from compgs.model.head_weights import HeadDimensions, HeadWeights
    from compgs.model.hybrid_model import HybridModel
    from compgs.model.splats import SplatArrays, SplatModel


def __getattr__(name: str) -> object:
    if name not in _HOME:
        raise AttributeError(f"module 'compgs.model' has no attribute {name!r}")
    return getattr(importlib.import_module(f"compgs.model.{_HOME[name]}"), name)
