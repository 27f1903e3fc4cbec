"""Reductions of a file: what stays decodes to what it was, what becomes coarser stays within half a step."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from compgs.codec.content import FileContent, GroupShape, Role, dequantize
from compgs.codec.integer_network import entropy_parameters
from compgs.codec.reader import read_content
from compgs.codec.reduce import rescaled, with_coarser_covariances, without_coupled
from compgs.codec.writer import write_content
from compgs.errors import NotEncodable

sys.path.append(str(Path(__file__).parents[2] / "benchmarks"))

from made_content import make_content, make_dimensions, paper_groups

ONE = 1 << 12


NEIGHBOURS = (
    GroupShape(Role.SIDE, 2, sees_neighbours=True),
    GroupShape(Role.REFERENCE, 12, (0.33,), (0,), sees_neighbours=True),
    GroupShape(Role.LOG_SCALES, 6, (0.125,), (1,)),
    GroupShape(Role.SIDE, 3),
    GroupShape(Role.RESIDUAL, 4, (1.0,), (1, 3)),
)


@pytest.fixture(scope="module", params=["paper", "neighbours", "rows"])
def content(request: pytest.FixtureRequest) -> FileContent:
    groups = paper_groups() if request.param == "paper" else NEIGHBOURS
    rows = request.param == "rows"
    dilation = 2.0**-20 if rows else None
    made = make_content(900, 4, make_dimensions(10, groups), angular_dilation=dilation, row_context=rows)
    return read_content(write_content(made))


def kept_anchors(content: FileContent, kept: np.ndarray) -> np.ndarray:
    mask = content.mask.copy()
    mask[mask] = kept
    return mask.any(1)


def scene_of(content: FileContent, kept: np.ndarray) -> dict[tuple[int, ...], list[np.ndarray]]:
    """Of each anchor, by its place: latents of every group, of residuals those of the primitives that are kept."""
    owner = np.repeat(np.arange(len(content.mask)), content.mask.sum(1))
    latents = dequantize(content)
    return {
        tuple(content.coordinates[n]): [
            x[kept & (owner == n)] if group.shape.role == Role.RESIDUAL else x[n]
            for group, x in zip(content.groups, latents, strict=True)
        ]
        for n in np.unique(owner[kept])
    }


def test_what_is_kept_decodes_to_what_it_was(content: FileContent) -> None:
    kept = np.random.default_rng(0).random(int(content.mask.sum())) < 0.3
    kept[: int(content.mask[:3].sum())] = False  # three anchors lose all
    smaller = without_coupled(content, kept)
    anchors = kept_anchors(content, kept)
    assert len(smaller.coordinates) == anchors.sum() <= len(content.coordinates) - 3
    before, after = scene_of(content, kept), scene_of(smaller, np.ones(kept.sum(), bool))
    assert after.keys() == before.keys()
    for place, latents in after.items():
        assert all(np.array_equal(a, b) for a, b in zip(latents, before[place], strict=True))
    written = write_content(smaller)  # the file may hold the remaining anchors in another order
    assert set(map(tuple, read_content(written).coordinates)) == set(map(tuple, smaller.coordinates))
    assert write_content(read_content(written)) == written


def test_the_content_that_was_given_stays_as_it_was(content: FileContent) -> None:
    before = write_content(content)
    without_coupled(content, np.arange(int(content.mask.sum())) % 2 == 0)
    with_coarser_covariances(content, 3.0)
    assert write_content(content) == before


SIX_STEPS = (0.125, 0.15, 0.1, 0.2, 0.25, 0.175)


@pytest.fixture(scope="module", params=["one step", "six steps", "blocks", "rows"])
def any_content(request: pytest.FixtureRequest) -> FileContent:
    groups = list(paper_groups())
    if request.param == "six steps":
        groups[2] = GroupShape(Role.LOG_SCALES, 6, SIX_STEPS, (1,))
    blocks, rows = 2 if request.param == "blocks" else 0, request.param == "rows"
    dimensions, dilation = make_dimensions(10, tuple(groups)), 2.0**-20 if rows else None
    made = make_content(600, 4, dimensions, blocks=blocks, angular_dilation=dilation, row_context=rows)
    return read_content(write_content(made))


@pytest.mark.parametrize("ratio", [2.0, 3.0, 5.0])
def test_coarser_covariances_stay_within_half_a_new_step_and_cost_less(
    any_content: FileContent, ratio: float
) -> None:
    coarser = read_content(write_content(with_coarser_covariances(any_content, ratio)))
    before, after = dequantize(any_content), dequantize(coarser)
    steps, new_steps = (np.array(c.group(Role.LOG_SCALES).shape.steps) for c in (any_content, coarser))
    assert new_steps == pytest.approx(ratio * steps)
    values, new_values = before[2] * steps / ONE, after[2] * new_steps / ONE
    assert (np.abs(values - new_values).max(0) <= (0.5 + 1 / ONE) * new_steps).all()
    for i in (0, 1, 3, 4):
        assert np.array_equal(after[i], before[i])
    assert len(write_content(coarser)) < len(write_content(any_content))


@pytest.mark.parametrize("blocks", [0, 2])
@pytest.mark.parametrize("ratios", [np.full(6, 2.0), np.array([1.0, 2.0, 4.0, 8.0, 2.0, 0.5])])
def test_a_rescaled_network_predicts_the_same_distribution_in_the_new_unit(
    blocks: int, ratios: np.ndarray
) -> None:
    content = make_content(200, 5, blocks=blocks, hidden=12)
    context = dequantize(content)[1]
    network = content.group(Role.LOG_SCALES).prior
    means, tables = entropy_parameters(network, context)
    rescaled_network = rescaled(network, ratios)
    assert rescaled_network.skip == network.skip
    new_means, new_tables = entropy_parameters(rescaled_network, context)
    # Weights are rounded again: up to half a unit of the last place for each of the inputs.
    assert np.abs(new_means / ONE - means / (ratios * ONE)).max() < 0.05
    lower = tables - 12 * np.log2(ratios)
    inside = (lower >= 0) & (lower <= 127) & (tables > 0) & (tables < 127)
    assert inside.any(0).all()
    assert np.array_equal(new_tables[inside], lower[inside])
    assert new_means.shape == (200, 6)


def test_log_scales_that_others_are_conditioned_on_are_left_alone() -> None:
    """So are several groups of them, and those with tables: there is no network to tell of the new unit."""
    side, f = GroupShape(Role.SIDE, 2), GroupShape(Role.REFERENCE, 4, (1.0,), (0,))
    c = GroupShape(Role.LOG_SCALES, 6, (0.5,), (1,))
    half = replace(c, channels=3)
    for groups in (
        (side, f, c, GroupShape(Role.REFERENCE, 2, (1.0,), (2,))),
        (side, f, half, half),
        (side, f, replace(c, context=())),
    ):
        content = make_content(20, 1, make_dimensions(2, groups))
        with pytest.raises(NotEncodable, match="log scales"):
            with_coarser_covariances(content, 2.0)


def test_reductions_go_one_after_the_other(content: FileContent) -> None:
    kept = np.arange(int(content.mask.sum())) % 3 > 0
    a = with_coarser_covariances(without_coupled(content, kept), 2.0)
    b = without_coupled(with_coarser_covariances(content, 2.0), kept)
    assert write_content(a) == write_content(b)


def test_nothing_is_left_out_where_the_rest_would_become_something_else() -> None:
    """Latents of this file follow the coordinates in the octree; without its outer anchors that is another one."""
    content = read_content((Path(__file__).parents[1] / "golden" / "odd.cgs").read_bytes())
    far = np.abs(content.coordinates - np.median(content.coordinates, axis=0)).max(1)
    inner = np.repeat(far <= np.median(far), content.mask.sum(1))
    with pytest.raises(NotEncodable, match="depend on where an anchor is in the whole scene"):
        without_coupled(content, inner)
