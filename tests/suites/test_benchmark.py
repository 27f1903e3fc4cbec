"""What of a suite can be measured here."""

import sys
from dataclasses import replace

import pytest

from compgs import metrics
from compgs.lpips import weights
from compgs.suites.benchmark import measurable
from compgs.suites.suite import load_suite


def test_measures_that_cannot_be_had_are_left_out_and_said(monkeypatch: pytest.MonkeyPatch) -> None:
    suite = replace(
        load_suite("captures"),
        train={"lpips": True, "lpips_weights": "nowhere.npz", "flip": True, "steps": 5},
    )
    monkeypatch.setitem(sys.modules, "flip_evaluator", None)
    monkeypatch.setattr(weights, "PACKAGE", "a_package_that_is_nowhere")
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
