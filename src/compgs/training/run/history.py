"""The course of a training, for charts: what its progress reports said, a few hundred points of it."""

import math
from dataclasses import dataclass, field
from statistics import fmean
from typing import Any

from compgs.training.run.status import TrainingStatus

MOST_POINTS = 200
# Of a training view each, and so different from report to report: a point has their mean.
AVERAGED = ("loss", "psnr")
# Of a moment: a point has the last one.
LATEST = ("step", "primitives", "estimated_bytes")


@dataclass
class History:
    """Progress reports of one run, from where it began or went on."""

    reports: list[TrainingStatus] = field(default_factory=list)

    def add(self, status: TrainingStatus) -> None:
        self.reports.append(status)

    def curve(self) -> dict[str, list[Any]]:
        """Return at most MOST_POINTS of `step`, `primitives`, `estimated_bytes`, `loss` and `psnr` (dB, training
        views).
        """
        if not self.reports:
            return {name: [] for name in (*LATEST, *AVERAGED)}
        group = math.ceil(len(self.reports) / MOST_POINTS)
        # From the end, so that the last point is the last report's.
        ends = range(len(self.reports), 0, -group)
        groups = [self.reports[max(0, end - group) : end] for end in ends][::-1]
        return {
            **{name: [getattr(reports[-1], name) for reports in groups] for name in LATEST},
            **{
                name: [_mean([getattr(each, name) for each in reports]) for reports in groups]
                for name in AVERAGED
            },
        }


def _mean(values: list[float]) -> float:
    """Average those that are finite, if any is: a picture without an error has an infinite PSNR."""
    finite = [value for value in values if math.isfinite(value)]
    return fmean(finite or values)
