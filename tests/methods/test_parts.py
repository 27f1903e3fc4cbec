"""Codebooks, fake quantization, significance, and how numbers of a few bits stand in files."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from compgs.errors import SplatFileError
from compgs.formats.packed import Packed
from compgs.methods.parts.books import entries_within
from compgs.methods.parts.fake_quantization import fake_half, fake_levels, straight_through
from compgs.methods.parts.significance import all_but_lowest, view_significance
from compgs.methods.parts.vector_quantization import (
    averaged_codes,
    code_means,
    first_codes,
    k_means,
    nearest_codes,
    residual_codes,
    residual_labels,
    residual_sums,
)
from compgs.published.parts.content import stored_place
from compgs.published.parts.indices import (
    index_bits,
    label_counts,
    packed_indices,
    stored_counts,
    stored_indices,
)
from compgs.published.parts.levels import Levels, stored_levels
from compgs.render import RasterSettings
from compgs.scene.views import Scene
from compgs.tensors.rasterize import rasterize
from compgs.tensors.splats import splat_gaussians
from compgs.training.splats.parameters import initial_splats


def chance(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def squares(vectors: torch.Tensor, codes: torch.Tensor) -> float:
    return float((vectors - codes[nearest_codes(vectors, codes)]).square().sum())


@pytest.fixture(scope="module")
def clusters() -> tuple[torch.Tensor, torch.Tensor]:
    """Five tight clusters [500, 3], and their middles."""
    middles = 10 * torch.randn(5, 3, generator=chance(1))
    return middles[torch.arange(500) % 5] + 0.1 * torch.randn(500, 3, generator=chance(2)), middles


# codebooks ---------------------------------------------------------------------------------------------------------


def test_the_nearest_code_is_the_one_of_the_smallest_distance_far_from_zero_too(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("compgs.methods.parts.vector_quantization.MOST_DISTANCES", 100)  # in many parts
    vectors, codes = (torch.randn(n, 4, generator=chance(n)) for n in (301, 37))
    expected = torch.cdist(vectors.double(), codes.double()).argmin(1)
    assert torch.equal(nearest_codes(vectors, codes), expected)
    assert float((nearest_codes(vectors + 1000, codes + 1000) == expected).float().mean()) > 0.98
    assert nearest_codes(torch.zeros(2, 4), torch.ones(3, 4)).tolist() == [0, 0], "of equals the first"
    assert len(nearest_codes(torch.zeros(0, 4), codes)) == 0


def test_k_means_finds_clusters_and_leaves_empty_codes(clusters: tuple[torch.Tensor, torch.Tensor]) -> None:
    vectors, middles = clusters
    far = torch.full((1, 3), 1e3)
    codes, labels = k_means(vectors, torch.cat([middles + 0.5, far]), 2)
    assert torch.equal(codes[5:], far)
    for label in range(5):
        torch.testing.assert_close(codes[label], vectors[labels == label].mean(0))
    assert (codes[:5] - middles).abs().max() < 0.05


def test_a_mean_counts_each_vector_by_its_weight() -> None:
    vectors = torch.tensor([[0.0], [1.0], [5.0]])
    means = code_means(
        vectors, torch.tensor([0, 0, 1]), torch.full((3, 1), 9.0), torch.tensor([1.0, 3.0, 0.0])
    )
    assert means.tolist() == [[0.75], [9.0], [9.0]], "without weight nothing moves a code"


def test_codes_begin_at_different_vectors_and_the_same_chance_gives_the_same() -> None:
    vectors = torch.arange(20.0)[:, None]
    first = first_codes(vectors, 8, chance())
    assert len(torch.unique(first)) == 8 and torch.equal(first, first_codes(vectors, 8, chance()))
    assert sorted(first_codes(vectors, 30, chance())[:, 0].tolist()) == list(range(20))


@pytest.mark.parametrize("batch", [100, 1000])
def test_moving_averages_find_what_k_means_finds(
    batch: int, clusters: tuple[torch.Tensor, torch.Tensor]
) -> None:
    vectors, middles = clusters
    found = averaged_codes(vectors, middles + 1, 60, chance(), batch=batch)
    assert squares(vectors, found) < 1.1 * squares(vectors, k_means(vectors, middles, 5)[0])


def test_moving_averages_go_to_what_weighs_more() -> None:
    vectors, weights = torch.tensor([[0.0], [1.0]]), torch.tensor([1.0, 9.0])
    found = averaged_codes(vectors, torch.tensor([[0.5]]), 30, chance(), weights=weights)
    assert found.item() == pytest.approx(0.9, abs=1e-5)
    one = averaged_codes(vectors, torch.tensor([[0.5]]), 1, chance(), weights=weights)
    assert one.item() == pytest.approx(0.9, abs=1e-5), "a code has no memory before its first batch"


def test_empty_codes_find_vectors_when_they_begin_again(clusters: tuple[torch.Tensor, torch.Tensor]) -> None:
    vectors, middles = clusters
    begun = torch.cat([middles[:1], torch.full((7, 3), 1e3)])  # seven codes that nothing is near
    stuck = averaged_codes(vectors, begun, 30, chance(), batch=100)
    found = averaged_codes(vectors, begun, 30, chance(), batch=100, reseeded=2)
    assert squares(vectors, found) < 0.1 * squares(vectors, stuck)


def test_each_stage_codes_what_those_before_left() -> None:
    vectors = torch.randn(400, 3, generator=chance(3))
    books, labels = residual_codes(vectors, 3, 8, 10, chance())
    assert books.shape == (3, 8, 3) and labels.shape == (400, 3)
    assert torch.equal(labels, residual_labels(vectors, books))
    errors = [float((vectors - residual_sums(books[:s], labels[:, :s])).square().sum()) for s in range(1, 4)]
    assert errors[1] < 0.5 * errors[0] and errors[2] < 0.5 * errors[1]
    books.requires_grad_()
    residual_sums(books, labels).sum().backward()
    counts = torch.stack([torch.bincount(labels[:, s], minlength=8) for s in range(3)])
    assert torch.equal(books.grad[..., 0], counts.float())  # type: ignore[index]


# fake quantization -------------------------------------------------------------------------------------------------


def test_what_is_drawn_is_drawn_exactly_and_gradients_pass_by() -> None:
    values = torch.tensor([1e-3, 1e6], requires_grad=True)
    drawn = straight_through(values, torch.tensor([1e6, 1e-3]))
    assert drawn.tolist() == torch.tensor([1e6, 1e-3]).tolist()
    (2 * drawn).sum().backward()
    assert values.grad is not None and values.grad.tolist() == [2, 2]


@pytest.mark.parametrize("bits", [1, 5, 8, 16])
def test_a_training_sees_the_very_values_of_the_file(bits: int) -> None:
    values = torch.randn(1000, 3, generator=chance(bits)) * 3.7 - 100
    stored = Levels.of(values.numpy(), bits)
    assert stored.codes.min() == 0 and stored.codes.max() == (1 << bits) - 1
    assert np.array_equal(fake_levels(values, bits).numpy(), stored.values())
    step = float(values.max() - values.min()) / ((1 << bits) - 1)
    assert np.abs(stored.values() - values.numpy()).max() <= 0.501 * step + 1e-4
    packed = Packed("toy", stored.facts("x"), {"x": stored.codes})
    assert np.array_equal(stored_levels(packed, "x", (None, 3), bits), stored.values())


def test_equal_values_have_levels() -> None:
    values = torch.full((4,), 0.3)
    assert np.array_equal(Levels.of(values.numpy()).values(), values.numpy())
    assert torch.equal(fake_levels(values), values)


def test_half_precision_stays_finite() -> None:
    values = torch.tensor([0.1, 1e6, -1e6], requires_grad=True)
    drawn = fake_half(values)
    assert drawn.tolist() == [float(np.float16(0.1)), 65504, -65504]
    drawn.sum().backward()
    assert values.grad is not None and values.grad.tolist() == [1, 1, 1]


# significance ------------------------------------------------------------------------------------------------------


def test_significance_is_the_sum_of_blending_weights_whatever_the_colors(blob_scene: Scene) -> None:
    from compgs.config import SplatConfig

    splats = initial_splats(blob_scene.points, SplatConfig())
    cameras = [view.camera for view in blob_scene.train_views[:3]]
    found = view_significance(splats, cameras, RasterSettings())
    expected = np.zeros(len(splats))
    for camera in cameras:
        gaussians = splat_gaussians(splats, camera)
        for row in range(0, len(splats), 10):  # white in black: its own weights are the image
            colors = torch.zeros_like(gaussians.colors)
            colors[row] = 1
            expected[row] += float(rasterize(replace(gaussians, colors=colors), camera).image[..., 0].sum())
    np.testing.assert_allclose(found[::10].numpy(), expected[::10], rtol=1e-4, atol=1e-3)
    assert found.max() > 1
    behind = replace(splats, means=splats.means + torch.tensor([1e3, 0.0, 0.0]))
    assert not view_significance(behind, cameras[:1], RasterSettings()).any()


def test_the_lowest_share_goes_and_something_stays() -> None:
    values = torch.tensor([3.0, 1.0, 2.0, 1.0, 5.0])
    assert all_but_lowest(values, 0.39).tolist() == [True, False, True, True, True]
    assert all_but_lowest(values, 0.4).tolist() == [True, False, True, False, True]
    assert all_but_lowest(values, 0.0).all()
    assert all_but_lowest(values, 1.0).tolist() == [False, False, False, False, True]


# files -------------------------------------------------------------------------------------------------------------


def test_indices_take_as_many_bits_as_their_codes_need() -> None:
    assert [index_bits(k) for k in (1, 2, 3, 4, 5, 4096, 4097)] == [0, 1, 2, 2, 3, 12, 13]
    labels = np.random.default_rng(0).integers(0, 37, 101)
    data = packed_indices(labels, 37)
    assert len(data) == -(-101 * 6 // 8)
    packed = Packed("toy", {}, {"a": data, "none": np.zeros(0, np.uint8)}, Path("x.packed"))
    assert np.array_equal(stored_indices(packed, "a", 101, 37), labels)
    assert np.array_equal(stored_indices(packed, "none", 3, 1), [0, 0, 0])
    with pytest.raises(
        SplatFileError, match=r"x\.packed: a: expected indices of 35 entries, found 3[56] for"
    ):
        stored_indices(packed, "a", 101, 35)
    with pytest.raises(SplatFileError, match=r"a: expected uint8 of shape \(77\)"):
        stored_indices(packed, "a", 102, 37)


def test_sorted_labels_are_counts() -> None:
    labels = np.array([0, 0, 2, 2, 2, 4])
    counts = label_counts(labels, 6)
    assert counts.dtype == np.uint32 and counts.tolist() == [2, 0, 3, 0, 1, 0]
    packed = Packed("toy", {}, {"a": counts})
    assert np.array_equal(stored_counts(packed, "a", 6, 6), labels)
    with pytest.raises(SplatFileError, match="a: are of 6 splats, expected 7"):
        stored_counts(packed, "a", 7, 6)
    with pytest.raises(SplatFileError, match="a: expected uint32"):
        stored_counts(packed, "a", 6, 5)


@pytest.mark.parametrize("value", [None, [1, 2], [1, 2, "x"], [1, 2, True], 3])
def test_an_offset_that_is_none_is_refused(value: object) -> None:
    facts = {} if value is None else {"offset": value}
    with pytest.raises(SplatFileError, match="offset: expected three numbers"):
        stored_place(Packed("toy", facts, {}))  # type: ignore[arg-type]
    assert stored_place(Packed("toy", {"offset": [1, 2.5, -3e6]}, {})) == (1.0, 2.5, -3e6)


def test_codebooks_are_halved_until_they_take_no_more_than_their_share() -> None:
    assert entries_within(4096, 1.0, lambda k: 40.0 * k, 1.0) == 4096
    for share in (0.05, 0.1, 0.5):
        entries = entries_within(4096, 200_000, lambda k: 40.0 * k, share)
        assert 40 * entries / (200_000 + 40 * entries) <= share < 80 * entries / (200_000 + 80 * entries)
    assert entries_within(4096, 1.0, lambda k: 40.0 * k, 0.1) == 1
