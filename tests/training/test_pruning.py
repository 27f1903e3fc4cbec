"""Anchors that add least are removed while the others can still make up for them."""

from dataclasses import replace

import pytest
import torch

from compgs.config import Config
from compgs.losses import photometric_loss
from compgs.render import rasterize
from compgs.scene.views import Scene
from compgs.training.trainer import Trainer

CPU = torch.device("cpu")


def with_pruning(config: Config, share: float, at: tuple[float, ...]) -> Config:
    return replace(config, control=replace(config.control, prune_share=share, prune_at=at))


def trained(scene: Scene, config: Config) -> Trainer:
    trainer = Trainer(scene, config, CPU)
    for _ in range(config.training.steps):
        trainer.train_step()
    return trainer


def test_what_is_removed_adds_no_more_than_its_share(blob_scene: Scene, tiny_config: Config) -> None:
    trainer = Trainer(blob_scene, with_pruning(tiny_config, 0.1, ()), CPU)
    for _ in range(5):
        trainer.train_step()
    before = trainer.contributions().sum(1)
    trainer.prune()
    after = trainer.contributions().sum(1)
    assert 0 < len(after) < len(before)
    gone = before.sort().values[: len(before) - len(after)]
    assert gone.sum() <= 0.1 * before.sum()
    assert gone.max() <= before.sort().values[len(gone) :].min()


def test_an_anchor_that_no_view_misses_can_go_without_a_change(
    blob_scene: Scene, tiny_config: Config
) -> None:
    trainer = Trainer(blob_scene, with_pruning(tiny_config, 0.0, ()), CPU)
    with torch.no_grad():
        trainer.model.log_scales[::2, 3:] = -20.0  # too small to meet a pixel's centre
    view = blob_scene.train_views[0]

    def distortion() -> float:
        rows = trainer.visible_anchors(view.camera)
        gaussians = trainer.predict(trainer.model.quantized(rows), rows, view.camera, True).gaussians
        with torch.no_grad():
            return float(
                photometric_loss(
                    rasterize(gaussians, view.camera, trainer.settings).image, trainer.views.photograph(0)
                )
            )

    before, anchors = distortion(), trainer.model.anchors
    trainer.prune()
    assert trainer.model.anchors < anchors
    assert distortion() == pytest.approx(before, rel=1e-3)


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
