"""Anchors that add least are removed while the others can still make up for them."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
import torch

from compgs.config import Config, ControlConfig
from compgs.gaussians import Gaussians
from compgs.render import render
from compgs.scene.views import Scene, View
from compgs.tensors.rasterize import rasterize
from compgs.training.rate_control import RateState
from compgs.training.target_size import pruned_share
from compgs.training.trainer import Trainer

CPU = torch.device("cpu")


def with_pruning(config: Config, share: float, at: tuple[float, ...]) -> Config:
    control = replace(config.control, prune_share=share, prune_less=0.0, prune_at=at)  # as with many views
    return replace(config, control=control)


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
    trainer = Trainer(blob_scene, with_pruning(tiny_config, 0.1, ()), CPU)
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
    np.testing.assert_allclose(unequal.contributions().numpy(), expected, rtol=1e-3, atol=0.05)
    assert not expected[::9].any()
    some = unequal.contributions(most=3).numpy()
    of = [unequal.scene.train_views[i] for i in (0, 2, 5)]
    np.testing.assert_allclose(some, by_color(unequal, of), rtol=1e-3, atol=0.05)


@pytest.mark.parametrize(("lmbda", "share"), [(0.002, 0.1), (0.016, 0.2), (0.00025, 0.05)])
def test_those_go_that_add_least_and_more_of_them_where_bits_weigh_more(
    unequal: Trainer, lmbda: float, share: float
) -> None:
    """At eight times the usual lambda twice the share: `rate_exponent` is a third."""
    model = unequal.model
    kept = least_first(unequal.contributions().sum(1).numpy(), share)
    assert 0.1 * len(kept) < kept.sum() < 0.85 * len(kept)
    coordinates, references = model.coordinates[kept], model.references.detach()[kept]
    unequal.rate = RateState(lmbda)
    unequal.prune()
    assert torch.equal(model.coordinates, coordinates)
    assert torch.equal(model.references.detach(), references)


def test_no_pruning_takes_more_than_half(tiny_config: Config) -> None:
    control = ControlConfig(prune_share=0.02)
    assert pruned_share(control, 0.002, 0.0) == pytest.approx(0.02)
    assert pruned_share(control, 0.054, 0.0) == pytest.approx(0.06)
    assert pruned_share(replace(control, prune_share=0.4), 0.054, 0.0) == 0.5


@pytest.mark.parametrize("share", [0.0, 0.03, 0.3])
def test_the_file_gets_the_primitives_that_the_views_would_miss(unequal: Trainer, share: float) -> None:
    unequal.config = replace(unequal.config, control=replace(unequal.config.control, idle_share=share))
    everything = unequal.contributions().numpy()
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
    total, left = trainer.contributions().numpy(), trainer.model.mask.numpy()
    assert 0.7 * total.sum() < total[left].sum() < 0.9 * total.sum()
    assert total[~left].max() <= total[left].min()


def test_what_no_view_misses_can_go_without_a_change(unequal: Trainer) -> None:
    unequal.config = with_pruning(unequal.config, 0.0, ())
    anchors = unequal.model.anchors
    views = unequal.scene.train_views[:3]
    before = [render(unequal.model.as_hybrid_model(), view.camera).image for view in views]
    unequal.prune()
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
    never = trained(blob_scene, with_pruning(config, 0.05, ()))
    twice = trained(blob_scene, with_pruning(config, 0.05, (0.5, 0.75)))
    assert twice.model.anchors < never.model.anchors


def test_pruning_that_falls_on_a_view_of_nothing_happens_all_the_same(
    blob_scene: Scene, tiny_config: Config
) -> None:
    view = blob_scene.train_views[0]
    aside = view.camera.world_to_camera.copy()
    aside[:3, 3] -= 1e4
    lost = replace(view, camera=replace(view.camera, world_to_camera=aside))
    config = with_pruning(tiny_config, 0.1, (0.0,))
    trainer = Trainer(replace(blob_scene, train_views=(lost, *blob_scene.train_views[1:])), config, CPU)
    trainer.views.order = [0]  # the first view
    anchors = trainer.model.anchors
    trainer.train_step()
    assert trainer.model.anchors < anchors
