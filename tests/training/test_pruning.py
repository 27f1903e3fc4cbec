"""Anchors that are not worth their bits are removed while the others can still make up for them."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
import torch

from compgs.cameras import Camera
from compgs.config import Config, ControlConfig
from compgs.gaussians import Gaussians
from compgs.render import render
from compgs.scene.views import Scene, View
from compgs.tensors.contributions import contributions, signed_changes
from compgs.tensors.rasterize import rasterize
from compgs.training.plan import pruning_views
from compgs.training.rate.rate_control import RateState
from compgs.training.shortcuts.coarse import halved
from compgs.training.structure.pruning import (
    anchors_worth_their_bits,
    pruning_camera,
    random_signs,
    squared_changes,
)
from compgs.training.trainer import Trainer

from .rules import without

CPU = torch.device("cpu")


def with_pruning(config: Config, worth: float, at: tuple[float, ...]) -> Config:
    control = replace(config.control, prune_worth=worth, prune_at=at)
    rules = without(config.training.rules, "bit_discount")  # as with many views
    return replace(config, control=control, training=replace(config.training, rules=rules))


def trained(scene: Scene, config: Config) -> Trainer:
    trainer = Trainer(scene, config, CPU)
    for _ in range(config.training.steps):
        trainer.train_step()
    return trainer


def least_first(contributions: np.ndarray, share: float) -> np.ndarray:
    """[P] bool, those that stay: one after the other goes, the least first, while all together are within the share."""
    kept = np.ones(len(contributions), bool)
    gone = 0.0
    for i in np.argsort(contributions, kind="stable"):
        gone += contributions[i]
        if gone > share * contributions.sum():
            break
        kept[i] = False
    return kept & (contributions > 0)


def by_color(trainer: Trainer, views: Sequence[View]) -> np.ndarray:
    """[N, K] contributions of all primitives: how much brighter the images get with the primitive's color."""
    model = trainer.model.as_hybrid_model()
    total = np.zeros(model.coupled, np.float32)
    for view in views:
        arrays, index = model.drawn(view.camera)
        drawn = Gaussians(*(torch.from_numpy(array) for array in vars(arrays).values()))
        red = drawn.colors[:, :1].clone().requires_grad_()
        image = rasterize(replace(drawn, colors=red.expand(-1, 3)), view.camera).image
        image[..., 0].sum().backward()
        total[index] += red.grad[:, 0].numpy()
    return total.reshape(trainer.model.anchors, -1)


@pytest.fixture
def unequal(blob_scene: Scene, tiny_config: Config) -> Trainer:
    """Before the first step; anchors and slots that are easily told apart, and some that no view sees."""
    trainer = Trainer(blob_scene, with_pruning(tiny_config, 20.0, ()), CPU)
    chance = torch.Generator().manual_seed(0)
    model = trainer.model
    with torch.no_grad():
        model.references += torch.randn(model.references.shape, generator=chance)
        model.residuals += torch.randn(model.residuals.shape, generator=chance)
    model.coordinates[::9, 2] += 10_000  # far above all cameras
    return trainer


def test_contributions_are_what_primitives_add_to_all_the_images(unequal: Trainer) -> None:
    expected = by_color(unequal, unequal.scene.train_views)
    assert not np.allclose(expected, expected[:, ::-1], rtol=0.1, atol=1)
    np.testing.assert_allclose(unequal.survey.contributions().numpy(), expected, rtol=1e-3, atol=0.05)
    assert not expected[::9].any()
    some = unequal.survey.contributions(most=3).numpy()
    of = [unequal.scene.train_views[i] for i in (0, 2, 5)]
    np.testing.assert_allclose(some, by_color(unequal, of), rtol=1e-3, atol=0.05)


def without_each(trainer: Trainer, view: View) -> tuple[np.ndarray, np.ndarray]:
    """[P, H * W * 3] float64: how the view changes with each primitive that it may show; [P] anchors of these."""
    with torch.no_grad():
        rows, prediction = trainer.survey.predicted(view.camera)
    drawn = prediction.gaussians
    whole = rasterize(drawn, view.camera).image
    changes = []
    for i in range(len(drawn)):
        opacities = drawn.opacities.clone()
        opacities[i] = 0
        changes.append((whole - rasterize(replace(drawn, opacities=opacities), view.camera).image).double())
    k = trainer.model.dimensions.coupled_primitives
    return torch.stack(changes).flatten(1).numpy(), rows[prediction.index // k].numpy()


def test_squared_changes_are_those_of_images_without_an_anchor(unequal: Trainer) -> None:
    """Against images rendered without one primitive after the other. 96 draws scatter by 14 % of an anchor's own."""
    views = unequal.scene.train_views[:2]
    expected = np.zeros(unequal.model.anchors)
    for view in views:
        changes, anchors = without_each(unequal, view)
        of_anchors = np.zeros((unequal.model.anchors, changes.shape[1]))
        np.add.at(of_anchors, anchors, changes)
        expected += (of_anchors**2).sum(1)
    draws = [
        squared_changes(
            [(number, views[0].camera), (number + 1000, views[1].camera)],
            unequal.survey.predicted, unequal.survey.shape, unequal.settings, CPU,
        )[0].numpy()
        for number in range(96)
    ]  # fmt: skip
    found = np.mean(draws, 0)
    assert (expected > 1e-3).sum() > 20
    np.testing.assert_allclose(found, expected, rtol=0.75, atol=1e-6)
    assert found.sum() == pytest.approx(expected.sum(), rel=0.1)
    assert not found[::9].any()


def test_changes_are_a_mean_over_the_values_of_all_views(unequal: Trainer) -> None:
    views = unequal.scene.train_views
    numbered = [(unequal.step * len(views) + i, view.camera) for i, view in enumerate(views)]
    total, _ = squared_changes(
        numbered, unequal.survey.predicted, unequal.survey.shape, unequal.settings, CPU
    )
    values = sum(view.image.size for view in views)
    assert torch.equal(unequal.survey.changes(256), total / values)


def test_what_only_views_see_that_are_not_asked_outlasts_a_pruning(unequal: Trainer) -> None:
    """Of a view that looks away nothing is known, nor of what only others show; what no view shows is worth nothing."""
    away = unequal.scene.train_views[0].camera
    away = replace(away, world_to_camera=np.diag([-1.0, 1.0, -1.0, 1.0]) @ away.world_to_camera)
    asked = replace(unequal.scene.train_views[0], camera=away)
    unequal.scene = replace(unequal.scene, train_views=(asked, unequal.scene.train_views[1]))
    unequal.survey.scene = unequal.scene
    hidden = np.ones(unequal.model.anchors, bool)
    hidden[unequal.survey.visible_anchors(away).numpy()] = False
    assert hidden.any()
    assert (np.isinf(unequal.survey.changes(1).numpy()) == hidden).all()
    bits = torch.ones(unequal.model.anchors)
    kept = anchors_worth_their_bits(unequal.survey.changes(1), bits, 0.1, unequal.config.control, 0.0)
    assert kept.numpy()[hidden].all()
    assert torch.isfinite(unequal.survey.changes(2)).all()


@pytest.mark.parametrize(("views", "asked"), [(12, 48), (81, 48), (97, 49), (300, 150), (1000, 256)])
def test_a_pruning_asks_half_of_the_views_but_some_at_least(views: int, asked: int) -> None:
    assert pruning_views(views) == asked


def test_large_views_are_judged_with_sides_halved(unequal: Trainer) -> None:
    """Not below forty thousand pixels: what anchors change there is about what they change in the whole image."""
    camera = unequal.scene.train_views[0].camera
    sizes = [
        pruning_camera(camera.resized(width, height))
        for width, height in ((390, 400), (480, 359), (1920, 1080))
    ]
    assert [(c.width, c.height) for c in sizes] == [(390, 400), (240, 180), (480, 270)]
    large = camera.resized(4 * camera.width, 4 * camera.height)
    found = [
        np.mean(
            [
                squared_changes(
                    [(number, c)], unequal.survey.predicted, unequal.survey.shape, unequal.settings, CPU
                )[0].numpy()
                for number in range(64)
            ],
            0,
        )
        / (c.width * c.height)
        for c in (large, halved(large, 1))
    ]
    order = [np.argsort(np.argsort(values)) for values in found]
    assert np.corrcoef(order)[0, 1] > 0.95
    assert found[1].sum() == pytest.approx(found[0].sum(), rel=0.25)


def test_nobody_would_miss_an_anchor_in_front_of_another_of_the_same_color() -> None:
    """But it has most of the blending weights: a small one in front of a large one, beside one that stands alone."""
    means = torch.tensor([[-0.3, 0.0, 3.0], [-0.3, 0.0, 2.0], [0.6, 0.0, 2.0]])
    sizes = torch.tensor([[2.0], [0.12], [0.05]]).expand(3, 3)
    wall = [0.8, 0.2, 0.1]
    drawn = Gaussians(
        means, torch.tensor([[1.0, 0, 0, 0]]).expand(3, 4), sizes,
        torch.tensor([0.98, 0.9, 0.9]), torch.tensor([wall, wall, [0.0, 0.9, 0.9]]),
    )  # fmt: skip
    camera = Camera(np.eye(4), 30.0, 30.0, 12.0, 9.0, 24, 18)
    weights = contributions(drawn, camera)
    draws = (random_signs(seed, (camera.height, camera.width, 3), CPU) for seed in range(64))
    changes = torch.stack([signed_changes(drawn, camera, signs) ** 2 for signs in draws]).mean(0)
    assert weights[1] > 2 * weights[2]
    assert changes[1] < 0.01 * changes[2]


CHANGES = torch.tensor([0.0, 1e-7, 2e-7, 4e-7, 8e-7, 0.0, 1e-6, 9e-7], dtype=torch.float64)
BITS = torch.tensor([50.0, 50.0, 50.0, 400.0, 50.0, 50.0, 50.0, 50.0])


@pytest.mark.parametrize(
    ("lmbda", "discount", "stays"),
    [
        (0.0, 0.0, [0, 1, 1, 1, 1, 0, 1, 1]),  # bits cost nothing: only what no view shows goes
        (
            6.3e-6,
            0.0,
            [0, 1, 1, 0, 1, 0, 1, 1],
        ),  # the fourth is worth more than the first two, but for its bits
        (1.27e-5, 0.0, [0, 0, 1, 0, 1, 0, 1, 1]),
        (1.27e-5, 0.75, [0, 1, 1, 1, 1, 0, 1, 1]),  # few views: a bit costs a quarter
        (1.0, 0.0, [0, 0, 0, 0, 1, 0, 1, 1]),  # all are too dear: of those in view at most half
    ],
)
def test_those_stay_whose_worth_is_more_than_the_price_of_their_bits(
    lmbda: float, discount: float, stays: list[int]
) -> None:
    """20 x change / bits is 4, 8, 2, 32, 40, 36 x 1e-8 of those in view; a bit costs lambda x 5 / 132 / 8."""
    control = ControlConfig(prune_worth=20.0)
    assert anchors_worth_their_bits(CHANGES, BITS, lmbda, control, discount).int().tolist() == stays


@pytest.mark.parametrize(
    ("least_bits", "stays"),
    [
        (0.0, [0, 0, 1, 0, 1, 0, 1, 1]),  # 200 bits stay
        (200.0, [0, 0, 1, 0, 1, 0, 1, 1]),
        (201.0, [0, 1, 1, 0, 1, 0, 1, 1]),
        (251.0, [0, 1, 1, 1, 1, 0, 1, 1]),
        (1e6, [0, 1, 1, 1, 1, 0, 1, 1]),  # what no view shows does not help
    ],
)
def test_of_those_that_do_not_pay_the_best_stay_while_the_file_would_be_too_small(
    least_bits: float, stays: list[int]
) -> None:
    control = ControlConfig(prune_worth=20.0)
    assert (
        anchors_worth_their_bits(CHANGES, BITS, 1.27e-5, control, 0.0, least_bits=least_bits).int().tolist()
        == stays
    )


@pytest.mark.parametrize(
    ("most_bits", "stays"),
    [
        (650.0, [0, 1, 1, 1, 1, 0, 1, 1]),  # at no price all that a view would miss stay
        (649.0, [0, 1, 1, 0, 1, 0, 1, 1]),
        (250.0, [0, 1, 1, 0, 1, 0, 1, 1]),
        (249.0, [0, 0, 1, 0, 1, 0, 1, 1]),
        (1.0, [0, 0, 0, 0, 1, 0, 1, 1]),  # at most half of them go
    ],
)
def test_where_the_file_would_be_too_large_those_go_that_are_worth_least(
    most_bits: float, stays: list[int]
) -> None:
    control = ControlConfig(prune_worth=20.0)
    assert (
        anchors_worth_their_bits(CHANGES, BITS, 0.0, control, 0.0, most_bits=most_bits).int().tolist()
        == stays
    )


@pytest.mark.parametrize(
    ("prunings", "stays"),
    [(1, [0, 0, 1, 0, 1, 0, 1, 1]), (3, [0, 0, 0, 0, 1, 0, 1, 1]), (60, [0, 0, 0, 0, 0, 0, 0, 1])],
)
def test_several_prunings_take_as_one_at_a_higher_price_but_each_at_most_half(
    prunings: int, stays: list[int]
) -> None:
    """A bit costs 6 x 1e-8 in one pruning, 8.4 in three, 77 in sixty, and these leave no anchor but the best."""
    control = ControlConfig(prune_worth=20.0)
    changes = CHANGES.clone()
    changes[7] = 1e-4
    assert (
        anchors_worth_their_bits(changes, BITS, 1.27e-5, control, 0.0, prunings=prunings).int().tolist()
        == stays
    )


def test_pruning_takes_what_does_not_pay_by_the_bits_of_the_file(unequal: Trainer) -> None:
    model = unequal.model
    unequal.structure.config = with_pruning(unequal.config, 20.0, ())
    changes = unequal.survey.changes(256).numpy()
    streams = model.quantized(rate=True).bits.values()
    bits = sum(stream.detach().double().numpy() for stream in streams) + 10
    ratio = 20 * changes / bits * len(bits) * 132 / 5
    # In the middle of the widest gap, so that no rounding decides.
    some = int((changes > 0).sum())
    least = np.sort(ratio[changes > 0])[int(0.17 * some) : int(0.25 * some)]
    gap = int(np.argmax(least[1:] / least[:-1]))
    lmbda = float(np.sqrt(least[gap] * least[gap + 1]))
    kept = (ratio > lmbda) & (changes > 0)
    assert 0.7 * (changes > 0).sum() < kept.sum() < 0.85 * (changes > 0).sum()
    coordinates, references = model.coordinates[kept], model.references.detach()[kept]
    unequal.rate = RateState(lmbda)
    unequal.structure.prune(unequal.step, unequal.rate)
    assert torch.equal(model.coordinates, coordinates)
    assert torch.equal(model.references.detach(), references)


@pytest.mark.parametrize("share", [0.0, 0.03, 0.3])
def test_the_file_gets_the_primitives_that_the_views_would_miss(unequal: Trainer, share: float) -> None:
    unequal.structure.config = replace(
        unequal.config, control=replace(unequal.config.control, idle_share=share)
    )
    everything = unequal.survey.contributions().numpy()
    kept = least_first(everything.reshape(-1), share).reshape(everything.shape)
    assert kept.any() and not kept[::9].any()
    unequal.finish()
    assert unequal.model.mask.tolist() == kept.tolist()
    assert unequal.model.as_hybrid_model().coupled == kept.sum() < kept.size


def test_a_run_ends_with_leaving_out_what_hardly_anybody_sees(blob_scene: Scene, tiny_config: Config) -> None:
    config = replace(
        tiny_config,
        control=replace(tiny_config.control, idle_share=0.2),
        training=replace(tiny_config.training, steps=3),
    )
    trainer = Trainer(blob_scene, config, CPU)
    trainer.run(None, None)
    total, left = trainer.survey.contributions().numpy(), trainer.model.mask.numpy()
    assert 0.7 * total.sum() < total[left].sum() < 0.9 * total.sum()
    assert total[~left].max() <= total[left].min()


def test_what_no_view_misses_can_go_without_a_change(unequal: Trainer) -> None:
    unequal.rate = RateState(0.0)
    anchors = unequal.model.anchors
    views = unequal.scene.train_views[:3]
    before = [render(unequal.model.as_hybrid_model(), view.camera).image for view in views]
    unequal.structure.prune(unequal.step, unequal.rate)
    assert unequal.model.anchors <= anchors - len(range(0, anchors, 9))
    for view, old in zip(views, before, strict=True):
        new = render(unequal.model.as_hybrid_model(), view.camera).image
        torch.testing.assert_close(new, old, atol=1e-5, rtol=0)


def test_moments_stay_with_their_anchors_and_training_goes_on(blob_scene: Scene, tiny_config: Config) -> None:
    trainer = Trainer(blob_scene, tiny_config, CPU)
    trainer.train_step()
    kept = torch.arange(trainer.model.anchors) % 3 != 0
    name = trainer.model.anchor_parameters[0]
    moment = trainer.optimizer.state[getattr(trainer.model, name)]["exp_avg"][kept].clone()
    trainer.control.keep(trainer.model, trainer.optimizer, kept)
    assert torch.equal(trainer.optimizer.state[getattr(trainer.model, name)]["exp_avg"], moment)
    assert len(trainer.control.seen) == trainer.model.anchors == int(kept.sum())
    trainer.train_step()


def test_a_run_has_fewer_anchors_where_it_prunes(blob_scene: Scene, tiny_config: Config) -> None:
    config = replace(tiny_config, training=replace(tiny_config.training, steps=20))
    never = trained(blob_scene, with_pruning(config, 20.0, ()))
    twice = trained(blob_scene, with_pruning(config, 20.0, (0.5, 0.75)))
    assert twice.model.anchors < never.model.anchors


def test_pruning_that_falls_on_a_view_of_nothing_happens_all_the_same(
    blob_scene: Scene, tiny_config: Config
) -> None:
    view = blob_scene.train_views[0]
    aside = view.camera.world_to_camera.copy()
    aside[:3, 3] -= 1e4
    lost = replace(view, camera=replace(view.camera, world_to_camera=aside))
    config = with_pruning(tiny_config, 20.0, (0.0,))
    trainer = Trainer(replace(blob_scene, train_views=(lost, *blob_scene.train_views[1:])), config, CPU)
    trainer.views.order = [0]  # the first view
    anchors = trainer.model.anchors
    trainer.train_step()
    assert trainer.model.anchors < anchors
