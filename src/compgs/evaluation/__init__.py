"""Evaluation: a decoded file against held-out views; rate-distortion curves (CompGS Sec. 4)."""

from compgs.evaluation.bd_rate import bd_rate
from compgs.evaluation.comparison import Comparison, compare
from compgs.evaluation.measure import evaluate
from compgs.evaluation.reduction import Reduction, reduce_file
from compgs.evaluation.results import Results, ViewResult

__all__ = [
    "Comparison",
    "Reduction",
    "Results",
    "ViewResult",
    "bd_rate",
    "compare",
    "evaluate",
    "reduce_file",
]
