"""Hybrid primitives and inter-primitive prediction (CompGS Sec. 3.1, 3.2)."""

from compgs.model.hybrid_model import HybridModel
from compgs.model.prediction import PredictionHeads, predict
from compgs.model.primitives import Primitives

__all__ = ["HybridModel", "PredictionHeads", "Primitives", "predict"]
