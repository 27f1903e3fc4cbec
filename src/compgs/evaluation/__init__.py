"""Evaluation: a decoded file against held-out views; rate-distortion curves (CompGS Sec. 4).

| file | does |
|---|---|
| `measure`, `results` | measures a file on held-out views: `evaluate`, and what it returns |
| `comparison`, `compared_files` | put two files of one scene side by side, without photographs |
| `reduction` | makes a file smaller without training, and measures what that loses |
| `bd_rate` | compares two curves of quality over bytes |
| `held_out`, `fit` | checks the views before they are measured |
| `exposure`, `alignment` | fits colors of renderings, and places of cameras, to their photographs |
| `importance` | measures what a primitive adds to the pictures |
| `error_account`, `error_sheet`, `contact_sheet` | show where the error is, and the pictures beside the photographs |
| `camera_path`, `capture_cameras`, `tour`, `clearance` | cameras without photographs, on ways clear of what is near |
| `video`, `animation` | write films and moving pictures |
| `reports/` | the pages and tables that `compgs report` and `compgs compare` write |
"""

from compgs.evaluation.bd_rate import bd_rate
from compgs.evaluation.compared_files import Comparison
from compgs.evaluation.comparison import compare
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
