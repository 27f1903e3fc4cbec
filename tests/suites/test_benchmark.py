"""What of a suite can be measured here."""

import sys
from dataclasses import replace

import pytest

from compgs import metrics
from compgs.suites.benchmark import measurable
from compgs.suites.suite import load_suite


def test_measures_that_cannot_be_had_are_left_out_and_said(monkeypatch: pytest.MonkeyPatch) -> None:
    suite = replace(load_suite("captures"), train={"lpips": True, "flip": True, "steps": 5})
    for package in ("torchmetrics", "flip_evaluator"):
        monkeypatch.setitem(sys.modules, package, None)
    metrics.lpips_network.cache_clear()
    metrics._flip_evaluate.cache_clear()
    left, notes = measurable(suite)
    assert left.train == {"steps": 5}
    assert [note.partition(" is unavailable: ")[0] for note in notes] == ["LPIPS", "FLIP"]
    assert measurable(left) == (left, [])


def test_flip_stays_where_its_package_is() -> None:
    pytest.importorskip("flip_evaluator")
    metrics._flip_evaluate.cache_clear()
    suite = replace(load_suite("captures"), train={"flip": True})
    assert measurable(suite) == (suite, [])
