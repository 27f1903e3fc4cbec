"""Anchors that stand behind others are passed over by the view that does not show them, and by no other."""

from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from torch import Tensor

from compgs.gaussians import Gaussians
from compgs.tensors.rasterize import rasterize
from compgs.training.shortcuts.hidden import GradientSizes, HiddenAnchors, with_gradient_sizes
from compgs.training.step.step_views import step_views
from compgs.training.survey import predict_view
from compgs.training.trainer import Trainer

CPU = torch.device("cpu")
K = 2


def memory(share: float = 0.1, views: int = 3, anchors: int = 4) -> HiddenAnchors:
    return HiddenAnchors(share, views, (anchors, K), CPU)


def look(
    hidden: HiddenAnchors, rows: list[int], index: list[int], opacities: list[float], sizes: list[float]
) -> None:
    """View 1 draws primitives `index` of the anchors `rows`."""
    prediction = SimpleNamespace(index=torch.tensor(index), opacities=torch.zeros(K * len(rows)))
    gaussians = SimpleNamespace(opacities=torch.tensor(opacities))
    hidden.observe(1, torch.tensor(rows), prediction, gaussians, GradientSizes(torch.tensor(sizes)))


def observed(
    hidden: HiddenAnchors, rows: list[int], index: list[int], opacities: list[float], sizes: list[float]
):
    """What view 1 remembers after it has drawn primitives `index` of the anchors `rows` twice."""
    for _ in range(2):
        look(hidden, rows, index, opacities, sizes)
    return hidden.others(1, torch.arange(len(hidden.hidden))).tolist()


def test_anchors_of_small_gradients_are_hidden_also_those_of_which_nothing_is_drawn():
    # Anchor 3 has one primitive of 0.3 (the other is not drawn: 0.15 on average), anchor 0 none, anchor 2 small ones.
    assert observed(memory(), [0, 2, 3], [2, 3, 5], [0.5, 0.5, 0.9], [0.05, 0.1, 0.3]) == [1, 3]


def test_what_chance_left_out_says_nothing():
    left_out = 0.0
    # Of anchor 0 both are left out, of anchor 1 one, beside one of 0.15.
    rows, index = [0, 1], [0, 1, 2, 3]
    assert observed(memory(), rows, index, [left_out, left_out, 0.5, left_out], [0, 0, 0.15, 0]) == [
        0,
        1,
        2,
        3,
    ]
    assert observed(memory(), rows, index, [left_out, 0.5, 0.5, left_out], [0, 0.01, 0.15, 0]) == [1, 2, 3]


def test_gradients_that_are_no_numbers_hide_nothing():
    assert observed(memory(anchors=1), [0], [0, 1], [0.5, 0.5], [torch.nan, 0.0]) == [0]


def test_other_views_and_later_looks_decide_for_themselves():
    hidden = memory()
    observed(hidden, [0, 1], [0, 1, 2, 3], [0.5] * 4, [0.0, 0.0, 1.0, 1.0])
    assert hidden.others(0, torch.arange(4)).tolist() == [0, 1, 2, 3]
    # Anchor 0, which was hidden, is not looked at, and stays so; anchor 1 is now; then all are looked at again.
    assert observed(hidden, [1], [0, 1], [0.5] * 2, [0.0, 0.0]) == [2, 3]
    assert observed(hidden, [0, 1], [0, 1, 2, 3], [0.5] * 4, [1.0, 1.0, 0.0, 0.0]) == [0, 2, 3]


def test_an_anchor_is_hidden_after_two_looks_in_a_row_that_did_not_show_it():
    hidden, everything = memory(anchors=1), torch.arange(1)
    found = []
    for shows in (False, True, False, False, False, True, False):
        look(hidden, [0], [0, 1], [0.5] * 2, [float(shows)] * 2)
        found.append(len(hidden.others(1, everything)) == 0)
    assert found == [False, False, False, True, True, False, False]


def test_memory_follows_anchors_that_come_and_go():
    hidden = memory()
    observed(hidden, [0], [0, 1], [0.5] * 2, [0.0] * 2)
    look(hidden, [3], [0, 1], [0.5] * 2, [0.0] * 2)
    hidden.replaced(torch.tensor([False, True, True, True]), 2)
    assert hidden.others(1, torch.arange(5)).tolist() == [0, 1, 2, 3, 4]
    look(hidden, [2], [0, 1], [0.5] * 2, [0.0] * 2)
    assert hidden.others(1, torch.arange(5)).tolist() == [0, 1, 3, 4]
    hidden.replaced(torch.tensor([False, True, True, True, False]), 0)
    assert hidden.others(1, torch.arange(3)).tolist() == [0, 2]


def test_a_bit_is_kept_for_each_anchor_and_view_and_views_do_not_mix():
    hidden = memory(views=300, anchors=50)
    assert all(bits.numel() == 50 * 38 and bits.element_size() == 1 for bits in hidden.tensors().values())
    chance = torch.Generator().manual_seed(0)
    expected = torch.zeros(50, 300, dtype=torch.bool)
    for view in (0, 7, 8, 9, 255, 299, 7, 8):
        rows = torch.nonzero(torch.rand(50, generator=chance) < 0.7).view(-1)
        found = torch.rand(len(rows), generator=chance) < 0.5
        sizes = torch.where(found, 0.0, 1.0).repeat_interleave(K)
        index = torch.arange(K * len(rows))
        prediction = SimpleNamespace(index=index, opacities=torch.zeros(len(index)))
        gaussians = SimpleNamespace(opacities=torch.full((len(index),), 0.5))
        for _ in range(2):
            hidden.observe(view, rows, prediction, gaussians, GradientSizes(sizes))
        expected[rows, view] = found
    for view in range(300):
        shown = hidden.others(view, torch.arange(50))
        assert shown.tolist() == torch.nonzero(~expected[:, view]).view(-1).tolist()


def test_without_a_share_nothing_is_remembered():
    hidden = memory(share=0.0)
    assert observed(hidden, [0], [0], [0.5], [0.0]) == [0, 1, 2, 3]
    assert hidden.tensors()["hidden"].numel() == 0


def test_where_hardly_anything_is_drawn_nothing_is_hidden():
    hidden = memory(anchors=6)
    rows, sizes = list(range(6)), [1.0, 1.0]
    assert observed(hidden, rows, [0, 1], [0.5, 0.5], sizes) == [0]  # a sixth of all
    assert observed(hidden, rows, [0], [0.5], sizes[:1]) == rows  # a twelfth
    assert observed(hidden, rows, [0, 1], [0.5, 0.5], sizes) == [0]
    nothing = SimpleNamespace(index=torch.tensor([], dtype=torch.int64), opacities=torch.zeros(K * 6))
    hidden.observe(1, torch.arange(6), nothing, SimpleNamespace(opacities=torch.zeros(0)), GradientSizes())
    assert hidden.others(1, torch.arange(6)).tolist() == rows


def test_what_one_rank_remembers_comes_back_and_is_of_no_use_to_several():
    one, other = memory(), memory()
    observed(one, [0, 3], [0, 1, 6, 7], [0.5] * 4, [0.0, 0.0, 1.0, 1.0])
    other.restore(one.tensors(), {})
    assert torch.equal(other.hidden, one.hidden) and one.hidden.any()
    assert torch.equal(other.missed, one.missed)
    of_several = memory(share=0.0)
    of_several.restore(one.tensors(), {})
    assert of_several.others(1, torch.arange(4)).tolist() == [0, 1, 2, 3]
    other.restore(of_several.tensors(), {})
    with pytest.raises(ValueError, match="missed: expected"):
        other.restore(memory(anchors=5).tensors(), {})


@pytest.fixture
def trainer(blob_scene, tiny_config):
    training = replace(tiny_config.training, steps=120)
    found = Trainer(blob_scene, replace(tiny_config, training=training), CPU)
    for _ in range(61):
        found.train_step()
    return found


def test_steps_with_the_rate_look_at_all_and_others_at_what_showed(trainer):
    seen = []
    for _ in range(8):
        views, step = trainer.views, trainer.step
        looks = trainer.views_of_step(trainer.now)
        (view,) = looks.views
        everything = trainer.survey.visible_anchors(trainer.scene.train_views[view].camera)
        shown = everything if step % 4 == 0 else trainer.hidden.others(view, everything)
        assert torch.equal(looks.own.rows, shown)
        seen.append(len(everything) - len(shown))
        trainer.learn(looks, trainer.now)
        trainer.step += 1
        assert trainer.views is views
    assert max(seen) > 0, "nothing was hidden: the scene does not test anything"
    assert seen[(-trainer.step) % 4] == 0


def test_a_view_hardly_changes_without_what_is_hidden_in_it(trainer):
    chance, changes, left_out = torch.Generator().manual_seed(0), [], 0
    for number, view in enumerate(trainer.scene.train_views):
        rows = trainer.survey.visible_anchors(view.camera)
        looks = step_views([number], [rows], trainer.model.anchors, trainer.noise)
        for _ in range(2):
            trainer.learn(looks, trainer.now)  # looks, and moves nothing
        shown = trainer.hidden.others(number, rows)
        as_many = rows[torch.randperm(len(rows), generator=chance)[: len(shown)].sort().values]
        images = []
        with torch.no_grad():
            for some in (rows, shown, as_many):
                model = trainer.model
                prediction = predict_view(model, model.quantized(some), some, view.camera, stored=False)
                images.append(rasterize(prediction.gaussians, view.camera, trainer.settings).image)
        changes.append([(images[0] - image).abs().mean() for image in images[1:]])
        left_out += len(rows) - len(shown)
    hidden, others = torch.tensor(changes).mean(0)
    assert left_out > 0 and hidden < 0.25 * others, (left_out, hidden, others)


def leaves(dtype: torch.dtype) -> Gaussians[Tensor]:
    chance = torch.Generator().manual_seed(0)
    shapes = (400, 3), (400, 4), (400, 3), (400,), (400, 3)
    return Gaussians(*(torch.rand(s, generator=chance).to(dtype).requires_grad_() for s in shapes))


def weighed(found: Gaussians[Tensor], weights: Tensor) -> Tensor:
    return (
        weights * (3 * found.opacities + found.colors.sum(1))
        + weights**2 * (found.means + found.scales).sum(1)
    ).sum() + (found.quaternions**2).sum()


def test_sizes_of_gradients_are_known_after_the_backward_pass_which_they_do_not_change() -> None:
    given, plain, weights, sizes = (
        leaves(torch.float32),
        leaves(torch.float32),
        10.0 ** torch.linspace(-4, 0, 400),
        GradientSizes(),
    )
    found = with_gradient_sizes(given, sizes)
    assert sizes.values is None
    weighed(found, weights).backward()
    weighed(plain, weights).backward()
    for name in ("means", "quaternions", "scales", "opacities", "colors"):
        assert torch.equal(getattr(given, name).grad, getattr(plain, name).grad), name
    scales = given.scales.detach().double()
    shown = 6 * weights.double()
    placed = 2 * weights.double() ** 2 * scales.sum(1)
    expected = (shown / shown.mean() + placed / placed.mean()) / 2
    assert sizes.values is not None
    torch.testing.assert_close(sizes.values.double(), expected, rtol=1e-5, atol=0)


def test_nothing_is_small_beside_nothing() -> None:
    given, sizes = leaves(torch.float32), GradientSizes()
    weighed(with_gradient_sizes(given, sizes), torch.zeros(400)).backward()
    assert sizes.values is not None and not (sizes.values < 1e9).any()


def test_other_precisions_do_without_sizes() -> None:
    given, sizes = leaves(torch.float64), GradientSizes()
    weighed(with_gradient_sizes(given, sizes), torch.ones(400)).backward()
    assert sizes.values is None and given.means.grad is not None
