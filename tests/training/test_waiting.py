"""What a training step may wait for on a GPU: the number of anchors in view, and nothing of its own besides.

Without a GPU: tensors on "meta" have shapes but no values, and whatever needs a value fails.
"""

import warnings
from dataclasses import replace

import pytest
import torch

from compgs.config import Config
from compgs.entropy.neighbourhood import neighbourhood
from compgs.render import RasterResult, RasterSettings
from compgs.tensors import where
from compgs.tensors.visibility import visible_mask
from compgs.training.step import pictures
from compgs.training.survey import Survey
from compgs.training.trainer import Trainer

from .rules import without

META = torch.device("meta")


def rasterize_nothing(gaussians, camera, settings) -> RasterResult:
    """An image that depends on all Gaussians, in shape: gsplat's place."""
    means2d = gaussians.means[:, :2] * 1.0
    total = means2d.sum() + gaussians.colors.sum() + gaussians.opacities.sum()
    total = total + gaussians.scales.sum() + gaussians.quaternions.sum()
    image = total.expand(camera.height, camera.width, 3)
    return RasterResult(image, image[..., 0], means2d, gaussians.opacities > 0)


def valueless_trainer(scene, config: Config, monkeypatch) -> Trainer:
    trainer = Trainer(scene, config, torch.device("cpu"))
    found = neighbourhood(trainer.model.coordinates).to(META)
    trainer.model.to(META)
    trainer.model._neighbourhood = (trainer.model.coordinates, found)  # (looked for where anchors change)
    trainer.device = trainer.views.device = META
    trainer.noise.pool = trainer.noise.pool.to(META)
    for name in trainer.control.STATISTICS:
        setattr(trainer.control, name, getattr(trainer.control, name).to(META))
    trainer.optimizer = torch.optim.SGD(trainer.optimizer.param_groups, lr=1e-3)
    rows = torch.arange(trainer.model.anchors // 2, device=META)
    monkeypatch.setattr(Survey, "visible_anchors", lambda self, camera: rows)
    monkeypatch.setattr(pictures, "rasterize", rasterize_nothing)
    return trainer


@pytest.mark.parametrize("learned", ["exposure", "poses", "robust"])
def test_what_is_learned_of_each_photograph_needs_no_value_of_a_step(
    blob_scene, tiny_config, monkeypatch, learned
):
    value = "on" if learned == "poses" else True
    config = replace(tiny_config, training=replace(tiny_config.training, **{learned: value}))
    trainer = valueless_trainer(blob_scene, config, monkeypatch)
    monkeypatch.setattr(where, "choosing_pays", lambda device: False)
    trainer.views = valueless_views(trainer.views, monkeypatch)
    for _ in range(len(blob_scene.train_views) + 1):  # one is looked at again
        trainer.step = 29  # nothing else is due
        trainer.train_step()


def valueless_views(views, monkeypatch):
    """What is learned of the training views, without values."""
    for part in views.learned:
        for rows in (getattr(part, name, None) for name in ("photographs", "lenses", "rows")):
            if rows is not None:
                rows.numbers, rows.moments, rows.units = (
                    tensor.to(META) for tensor in (rows.numbers, rows.moments, rows.units)
                )
        for name in ("weights", "spread", "differences", "_looked_at"):
            if isinstance(getattr(part, name, None), torch.Tensor):
                setattr(part, name, getattr(part, name).to(META))
    return views


@pytest.mark.parametrize("layout", ["paired", "separate", "shallow"])
@pytest.mark.parametrize("progress", [0.0, 0.15, 0.75])
def test_a_step_needs_no_value_but_which_anchors_are_in_view(
    blob_scene, tiny_config, monkeypatch, layout, progress
):
    config = replace(tiny_config, model=replace(tiny_config.model, heads=layout))
    trainer = valueless_trainer(blob_scene, config, monkeypatch)
    monkeypatch.setattr(where, "choosing_pays", lambda device: False)
    trainer.step = int(progress * config.training.steps)
    assert trainer.train_step().loss.shape == ()


def test_choosing_among_primitives_would_need_values(blob_scene, tiny_config, monkeypatch):
    trainer = valueless_trainer(blob_scene, tiny_config, monkeypatch)
    with pytest.raises((RuntimeError, NotImplementedError)):
        trainer.train_step()


def test_culling_needs_no_values(blob_scene):
    camera = blob_scene.train_views[0].camera
    mask = visible_mask(torch.zeros(7, 3, device=META), torch.zeros(7, device=META), camera, RasterSettings())
    assert mask.shape == (7,)


def test_leaving_nothing_out_trains_the_same_model(blob_scene, tiny_config, monkeypatch):
    # All anchors: which of them are hidden depends on the last bit of their gradients.
    rules = without(tiny_config.training.rules, "hidden_anchors")
    config = replace(tiny_config, training=replace(tiny_config.training, rules=rules))
    losses = []
    for pays in (True, False):
        monkeypatch.setattr(where, "choosing_pays", lambda device, pays=pays: pays)
        trainer = Trainer(blob_scene, config, torch.device("cpu"))
        losses.append([float(trainer.train_step().loss) for _ in range(6)])
    assert losses[0] == pytest.approx(losses[1], rel=1e-4)


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_a_step_on_cuda_waits_for_two_numbers(blob_scene, tiny_config):
    """The anchors in view, and (inside gsplat) the entries of all tiles."""
    trainer = Trainer(blob_scene, tiny_config, torch.device("cuda"))
    for _ in range(len(blob_scene.train_views)):  # every camera's constants are on the device then
        trainer.train_step()
    torch.cuda.set_sync_debug_mode("warn")
    try:
        with warnings.catch_warnings(record=True) as waits:
            warnings.simplefilter("always")
            trainer.train_step()
    finally:
        torch.cuda.set_sync_debug_mode("default")
    assert len([w for w in waits if "synchroniz" in str(w.message)]) <= 2
