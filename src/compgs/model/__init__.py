"""Hybrid primitives and inter-primitive prediction (CompGS Sec. 3.1, 3.2).

Names are resolved on first use: the kernels and what works on arrays alone (`inference`) need no torch.
"""

import importlib
from typing import TYPE_CHECKING

_HOME = {
    "HeadDimensions": "heads",
    "HybridModel": "hybrid_model",
    "PredictionHeads": "heads",
    "Primitives": "primitives",
    "make_heads": "heads",
    "predict": "prediction",
}

__all__ = ["HeadDimensions", "HybridModel", "PredictionHeads", "Primitives", "make_heads", "predict"]

if TYPE_CHECKING:
    from compgs.model.heads import HeadDimensions, PredictionHeads, make_heads
    from compgs.model.hybrid_model import HybridModel
    from compgs.model.prediction import predict
    from compgs.model.primitives import Primitives


def __getattr__(name: str) -> object:
    if name not in _HOME:
        raise AttributeError(f"module 'compgs.model' has no attribute {name!r}")
    return getattr(importlib.import_module(f"compgs.model.{_HOME[name]}"), name)
