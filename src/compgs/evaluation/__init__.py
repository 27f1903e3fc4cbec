"""Evaluation: a decoded file against held-out views; rate-distortion curves (CompGS Sec. 4)."""

from compgs.evaluation.bd_rate import bd_rate
from compgs.evaluation.measure import evaluate
from compgs.evaluation.reduction import Reduction, reduce_file
from compgs.evaluation.results import Results, ViewResult

__all__ = ["Reduction", "Results", "ViewResult", "bd_rate", "evaluate", "reduce_file"]
