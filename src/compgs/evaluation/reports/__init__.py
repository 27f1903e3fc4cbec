"""Pages and tables of what was measured: the report on runs, and the page of a comparison of two files."""

from compgs.evaluation.reports.run_report import Report, report
from compgs.evaluation.reports.runs import Run, read_runs
from compgs.evaluation.reports.tables import Column, Spread, Table

__all__ = ["Column", "Report", "Run", "Spread", "Table", "read_runs", "report"]
