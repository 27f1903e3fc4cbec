"""Reductions of a file: what stays decodes to what it was, what becomes coarser stays within half a step."""

import sys
from pathlib import Path

import numpy as np
import pytest

from compgs.codec.content import COVARIANCE_DIM, FileContent, dequantize
from compgs.codec.integer_network import entropy_parameters
from compgs.codec.reader import read_content
from compgs.codec.reduce import rescaled, with_coarser_covariances, without_coupled
from compgs.codec.writer import write_content

sys.path.append(str(Path(__file__).parents[2] / "benchmarks"))

from made_content import make_content

ONE = 1 << 12


@pytest.fixture(scope="module")
def content() -> FileContent:
    return read_content(write_content(make_content(600, 4)))


def kept_anchors(content: FileContent, kept: np.ndarray) -> np.ndarray:
    mask = content.mask.copy()
    mask[mask] = kept
    return mask.any(1)


def test_what_is_kept_decodes_to_what_it_was(content: FileContent) -> None:
    kept = np.random.default_rng(0).random(int(content.mask.sum())) < 0.3
    kept[: int(content.mask[:3].sum())] = False  # three anchors lose all
    smaller = without_coupled(content, kept)
    anchors = kept_anchors(content, kept)
    assert len(smaller.coordinates) == anchors.sum() <= len(content.coordinates) - 3
    before, after = dequantize(content), dequantize(smaller)
    assert np.array_equal(after.reference, before.reference[anchors])
    assert np.array_equal(after.covariance, before.covariance[anchors])
    assert np.array_equal(after.residual, before.residual[kept])
    assert np.array_equal(smaller.coordinates, content.coordinates[anchors])
    written = write_content(smaller)  # the file may hold the remaining anchors in another order
    assert set(map(tuple, read_content(written).coordinates)) == set(map(tuple, smaller.coordinates))
    assert write_content(read_content(written)) == written


def test_the_content_that_was_given_stays_as_it_was(content: FileContent) -> None:
    before = write_content(content)
    without_coupled(content, np.arange(int(content.mask.sum())) % 2 == 0)
    with_coarser_covariances(content, 3.0)
    assert write_content(content) == before


@pytest.mark.parametrize("ratio", [2.0, 3.0, 5.0])
def test_coarser_covariances_stay_within_half_a_new_step_and_cost_less(
    content: FileContent, ratio: float
) -> None:
    coarser = read_content(write_content(with_coarser_covariances(content, ratio)))
    before, after = dequantize(content), dequantize(coarser)
    assert coarser.covariance_step == pytest.approx(ratio * content.covariance_step)
    values, new_values = (
        x.covariance.astype(np.float64) * y.covariance_step / ONE
        for x, y in ((before, content), (after, coarser))
    )
    assert np.abs(values - new_values).max() <= (0.5 + 1 / ONE) * coarser.covariance_step
    assert np.array_equal(after.reference, before.reference)
    assert np.array_equal(after.residual, before.residual)
    assert len(write_content(coarser)) < len(write_content(content))


@pytest.mark.parametrize("hidden", [0, 12])
def test_a_rescaled_network_predicts_the_same_distribution_in_the_new_unit(hidden: int) -> None:
    content = make_content(200, 5, hidden=hidden)
    context = dequantize(content).reference
    network = content.networks["covariance"]
    means, tables = entropy_parameters(network, context)
    new_means, new_tables = entropy_parameters(rescaled(network, 2.0), context)
    # Weights are rounded again: up to half a unit of the last place for each of the inputs.
    assert np.abs(new_means / ONE - means / (2 * ONE)).max() < 0.05
    inside = tables >= 12
    assert inside.any()
    assert np.array_equal(new_tables[inside], tables[inside] - 12)
    assert new_means.shape == (200, COVARIANCE_DIM)


def test_reductions_go_one_after_the_other(content: FileContent) -> None:
    kept = np.arange(int(content.mask.sum())) % 3 > 0
    a = with_coarser_covariances(without_coupled(content, kept), 2.0)
    b = without_coupled(with_coarser_covariances(content, 2.0), kept)
    assert write_content(a) == write_content(b)
