"""Anchors with view-dependent networks: the readable equations, their twin on arrays, and the spheres around them."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from compgs.config import Config, ModelConfig, TrainingConfig
from compgs.errors import ConfigError
from compgs.methods.anchors.model import AnchorModel, initial_anchors
from compgs.methods.anchors.prediction import predict_anchors
from compgs.methods.anchors.settings import AnchorSection
from compgs.methods.anchors.trainer import PARTS, AnchorTrainer, train_anchors
from compgs.model.constants import CUTOFF_SIGMAS
from compgs.published.anchors import network_shapes
from compgs.render import Renderable
from compgs.scene.views import Scene
from compgs.training.run.profile import StepProfile
from compgs.training.run.run import Run

K = 3


class Settings(Config):
    anchors = AnchorSection()


@pytest.fixture
def config() -> Config:
    return Settings(
        model=ModelConfig(coupled_primitives=K, reference_dim=6, width=8),
        training=TrainingConfig(steps=30, seed=1),
    )


@pytest.fixture
def model(blob_scene: Scene, config: Config) -> AnchorModel:
    """With numbers as a training might leave them."""
    found = initial_anchors(AnchorModel, blob_scene, config)
    chance = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for parameter in (found.features, found.offsets):
            parameter.copy_(torch.randn(parameter.shape, generator=chance))
        found.log_scales.add_(0.3 * torch.randn(found.log_scales.shape, generator=chance))
    return found


def test_what_a_file_shows_is_what_training_drew(model: AnchorModel, blob_scene: Scene) -> None:
    scene, camera = model.as_hybrid_model(), blob_scene.test_views[0].camera
    assert isinstance(scene, Renderable)
    center = torch.from_numpy(camera.center.astype(np.float32))
    expected = predict_anchors(model.networks.weights(), model.values(), center, model.frame)
    found = scene.gaussians(camera)
    assert 0 < len(found) < model.anchors * K
    for name, value in vars(expected.gaussians).items():
        np.testing.assert_allclose(getattr(found, name), value.detach().numpy(), rtol=2e-4, atol=2e-5)


def test_masked_primitives_are_not_drawn_by_either(model: AnchorModel, blob_scene: Scene) -> None:
    camera = blob_scene.test_views[0].camera
    center = torch.from_numpy(camera.center.astype(np.float32))
    mask = torch.rand(model.anchors, K, generator=torch.Generator().manual_seed(1)) < 0.4
    values = replace(model.values(), mask=mask.float())
    drawn = predict_anchors(model.networks.weights(), values, center, model.frame)
    assert mask.view(-1)[drawn.index].all()
    scene = replace(model.as_hybrid_model(), mask=mask.numpy())
    assert len(scene.gaussians(camera)) == len(drawn.index) < 0.6 * model.anchors * K
    assert scene.most_gaussians == scene.counts["coupled_primitives"] == int(mask.sum())


def test_means_and_scales_are_those_of_the_equations(model: AnchorModel) -> None:
    values = model.values()
    n, k = 5, 2
    reach = model.log_scales[n, :3].exp() * model.voxel_size
    expected = model.coordinates[n] * model.voxel_size + model.offsets[n, 3 * k : 3 * k + 3] * reach
    torch.testing.assert_close(values.means(model.voxel_size)[n, k], expected)
    assert torch.equal(values.sizes[n], model.log_scales[n, 3:])


def test_the_spheres_hold_what_is_drawn_from_anywhere(model: AnchorModel, blob_scene: Scene) -> None:
    scene = model.as_hybrid_model()
    centers, radii = scene.bounds
    np.testing.assert_allclose(model.values().radii(model.voxel_size).numpy(), radii, rtol=1e-5)
    for view in blob_scene.train_views[:3]:
        one = np.zeros(len(radii), np.bool_)
        for anchor in range(0, len(radii), 17):
            one[:] = False
            one[anchor] = True
            seen = scene.gaussians(view.camera, one)
            if len(seen):
                reach = np.linalg.norm(seen.means - centers[anchor], axis=1)
                assert (reach + CUTOFF_SIGMAS * seen.scales.max(1) <= radii[anchor] * 1.0001).all()


def test_parts_together_are_the_whole(
    model: AnchorModel, blob_scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene, camera = model.as_hybrid_model(), blob_scene.test_views[0].camera
    whole = scene.gaussians(camera)
    monkeypatch.setattr("compgs.published.anchors.BLOCK", 50)
    assert len(list(scene.parts(camera))) == -(-model.anchors // 50)
    again = scene.gaussians(camera)
    for name, value in vars(whole).items():
        np.testing.assert_allclose(getattr(again, name), value, rtol=1e-5, atol=1e-6)
    nothing = scene.gaussians(camera, np.zeros(model.anchors, np.bool_))
    assert len(nothing) == 0 and nothing.colors.shape == (0, 3)


def test_networks_have_the_shapes_that_files_must_have(model: AnchorModel) -> None:
    found = {name: tuple(w.shape) for name, w in model.networks.weights().items()}
    assert found == network_shapes(6, K, 8)


def test_plain_anchors_learn_and_grow(blob_scene: Scene, config: Config) -> None:
    control = replace(
        config.control, start=0.2, stop=0.8, every=0.2, gradient_threshold=1e-6, minimum_views=1
    )
    config = replace(config, control=control, training=replace(config.training, steps=120))
    trainer = AnchorTrainer(blob_scene, config, torch.device("cpu"), "toy")
    before, losses = trainer.model.anchors, []
    trainer.carry_out(Run("toy", on_progress=lambda status: losses.append(status.loss), device="cpu"))
    assert trainer.model.anchors > before
    assert np.mean(losses[-3:]) < 0.5 * np.mean(losses[:2])
    assert trainer.estimated_bytes() == 4 * sum(p.numel() for p in trainer.model.parameters())


def test_a_profile_names_the_parts_of_a_step(blob_scene: Scene, config: Config) -> None:
    profile = StepProfile()
    train_anchors(AnchorTrainer, blob_scene, config, Run("toy", device="cpu", profile=profile))
    found = profile.milliseconds()
    assert found.keys() >= {
        *PARTS.values(),
        "loss, backward",
        "rasterization, backward",
        "projection, backward",
    }
    assert all(milliseconds > 0 for milliseconds in found.values())


def test_several_views_a_step_are_refused(blob_scene: Scene, config: Config) -> None:
    several = replace(config, training=replace(config.training, views_per_step=2))
    with pytest.raises(
        ConfigError, match="method anchors trains in one process, with one view a step; found 1 and 2"
    ):
        AnchorTrainer(blob_scene, several, torch.device("cpu"), "anchors")
