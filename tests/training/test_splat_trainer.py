from dataclasses import replace

import numpy as np
import pytest
import torch

from compgs.config import Config, SplatConfig, TrainingConfig
from compgs.errors import CheckpointError, ConfigError, TrainingError
from compgs.formats import encoded
from compgs.gaussians import Gaussians
from compgs.metrics import psnr, to_8bit
from compgs.model.splats import SplatModel
from compgs.render import RasterSettings, render
from compgs.scene.views import Points
from compgs.tensors.rasterize import rasterize
from compgs.tensors.splats import Splats
from compgs.tensors.ssim import ssim
from compgs.training import SplatTrainer, Trainer, train_splats
from compgs.training.run.model_checkpoint import load_checkpoint
from compgs.training.splats.densification import DensifySchedule
from compgs.training.splats.parameters import initial_splats

CPU = torch.device("cpu")


@pytest.fixture
def config() -> Config:
    """Fifty steps that go through growth and all degrees."""
    return Config(
        splats=SplatConfig(harmonics_every=0.1, densify_every=0.2, densify_stop=0.9, gradient_threshold=1e-5),
        training=TrainingConfig(steps=50, seed=3),
    )


# Growth after steps 8, 18, 28, 38; resets after 15 and 30: short runs have none of their own accord.
SCHEDULE = DensifySchedule(start=8, stop=45, every=10, reset_every=15)


def ply_bytes(splats: Splats) -> bytes:
    return encoded(splats.arrays(), "ply")


def file_of(model) -> bytes:
    return encoded(model.splats, "ply")


def test_the_same_seed_gives_the_same_file_and_another_seed_another(blob_scene, config):
    first, second = train_splats(blob_scene, config), train_splats(blob_scene, config)
    assert len(first.splats) != len(blob_scene.points), "nothing grew: the test is too weak"
    assert file_of(first) == file_of(second)
    other = train_splats(blob_scene, replace(config, training=replace(config.training, seed=4)))
    assert file_of(first) != file_of(other)


def test_a_run_stopped_anywhere_continues_exactly(blob_scene, config, tmp_path):
    whole = SplatTrainer(blob_scene, config, CPU)
    whole.schedule = SCHEDULE
    whole.run(None, None)
    for stop in (1, 15, 28, 44):
        path = tmp_path / f"{stop}.safetensors"
        first = SplatTrainer(blob_scene, config, CPU)
        first.schedule = SCHEDULE
        for _ in range(stop):
            first.train_step()
        first.save(path)
        second = SplatTrainer.resumed(blob_scene, path, config, CPU)
        second.schedule = SCHEDULE
        assert second.step == stop
        second.run(None, None)
        assert ply_bytes(whole.parameters.trained()) == ply_bytes(second.parameters.trained()), stop


def test_an_interrupt_leaves_a_checkpoint_of_the_last_whole_step(blob_scene, config, tmp_path):
    def stop(status):
        assert (status.kind, status.primitives > 0) == ("splats", True)
        if status.step == 20:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train_splats(blob_scene, config, output=tmp_path, progress=stop)
    continued = train_splats(blob_scene, config, output=tmp_path, resume=True)
    assert file_of(continued) == file_of(train_splats(blob_scene, config))


def test_a_run_of_another_method_settings_or_scene_is_not_continued(
    blob_scene, tiny_config, config, tmp_path
):
    path = tmp_path / "checkpoint.safetensors"
    SplatTrainer(blob_scene, config, CPU).save(path)
    with pytest.raises(CheckpointError, match="method 3dgs"):
        load_checkpoint(path)
    other = replace(config, splats=replace(config.splats, opacity_lr=0.1))
    with pytest.raises(CheckpointError, match="opacity_lr"):
        SplatTrainer.resumed(blob_scene, path, other, CPU)
    fewer = replace(blob_scene, train_views=blob_scene.train_views[1:])
    with pytest.raises(CheckpointError, match="other views"):
        SplatTrainer.resumed(fewer, path, config, CPU)
    Trainer(blob_scene, tiny_config, CPU).save(path)
    with pytest.raises(CheckpointError, match="method compgs"):
        SplatTrainer.resumed(blob_scene, path, config, CPU)


def test_training_shows_the_held_out_view_and_a_late_reset_does_not_spoil_it(blob_scene):
    config = Config(training=TrainingConfig(steps=400, seed=0))
    trainer = SplatTrainer(blob_scene, config, CPU)
    trainer.schedule = replace(trainer.schedule, stop=300, reset_every=200)
    assert [s for s in range(400) if trainer.schedule.reset_due(s)] == [200]
    (view,) = blob_scene.test_views
    flat = np.broadcast_to(view.image.mean((0, 1)).round().astype(np.uint8), view.image.shape)
    trainer.run(None, None)
    model = SplatModel(trainer.parameters.trained().arrays(), blob_scene.background)
    assert psnr(to_8bit(render(model, view.camera).image), view.image) > 8 + psnr(flat, view.image)


def test_harmonics_come_one_degree_after_the_other(blob_scene):
    trainer = SplatTrainer(blob_scene, Config(training=TrainingConfig(steps=300)), CPU)
    degrees = []
    for trainer.step in (0, 9, 10, 19, 20, 30, 299):
        degrees.append(trainer.degree())
    assert degrees == [0, 0, 1, 1, 2, 3, 3]
    lower = Config(training=TrainingConfig(steps=300), splats=SplatConfig(harmonics=1))
    trainer = SplatTrainer(blob_scene, lower, CPU)
    trainer.step = 299
    assert trainer.degree() == 1 and trainer.parameters.rest.shape[1] == 3


def test_all_parameters_are_trained(blob_scene, config):
    trainer = SplatTrainer(blob_scene, replace(config, training=replace(config.training, steps=40)), CPU)
    trainer.step = 30  # all degrees are in use
    before = trainer.parameters.trained()
    trainer.train_step()
    trainer.train_step()
    after = trainer.parameters.trained()
    assert [name for name in vars(before) if torch.equal(getattr(before, name), getattr(after, name))] == []


def test_each_parameter_moves_by_its_own_rate_and_positions_by_the_extent(blob_scene):
    config = Config(
        training=TrainingConfig(steps=100),
        splats=SplatConfig(
            position_lr=(1e-3, 1e-5), color_lr=2e-3, harmonics_lr=3e-3, opacity_lr=4e-3, log_scale_lr=5e-3,
            rotation_lr=6e-3,
        ),
    )  # fmt: skip
    trainer = SplatTrainer(replace(blob_scene, extent=7.0), config, CPU)
    trainer.step = 50
    before = trainer.parameters.trained()
    trainer.train_step()
    after = trainer.parameters.trained()
    # The first step of Adam is as long as the rate, whatever the gradient.
    rates = {"means": 7e-4, "dc": 2e-3, "rest": 3e-3, "opacity_logits": 4e-3, "log_scales": 5e-3}
    for name, rate in (rates | {"quaternions": 6e-3}).items():
        moved = (getattr(after, name) - getattr(before, name)).abs()
        assert float(moved.max()) == pytest.approx(rate, rel=0.01), name


def test_a_run_resets_opacities_and_removes_what_is_large_only_afterwards(blob_scene):
    """Splats as large as the scene, in a run that acts after steps 2, 4 and 6 and resets after 3."""
    for remove in (False, True):
        config = Config(training=TrainingConfig(steps=100), splats=SplatConfig(gradient_threshold=1e3))
        trainer = SplatTrainer(blob_scene, config, CPU)
        trainer.schedule = DensifySchedule(start=2, stop=50, every=2, reset_every=3 if remove else 40)
        with torch.no_grad():
            trainer.parameters.log_scales[:5] = np.log(0.2 * blob_scene.extent)
            trainer.parameters.opacity_logits[:] = 3.0
        sizes, opacities = [], []
        for _ in range(4):
            trainer.train_step()
            sizes.append(float(trainer.parameters.log_scales.detach().amax().exp()) / blob_scene.extent)
            opacities.append(float(trainer.parameters.opacity_logits.detach().max().sigmoid()))
        assert min(sizes[:3]) > 0.1
        assert (sizes[3] < 0.1) == remove
        assert (opacities[2] < 0.011) == remove and opacities[1] > 0.9


def test_the_loss_of_a_step_is_the_published_formula(blob_scene):
    trainer = SplatTrainer(blob_scene, Config(training=TrainingConfig(steps=100, ssim_weight=1.0)), CPU)
    trainer.views.order = [2]
    result = trainer.train_step()
    photograph = torch.from_numpy(blob_scene.train_views[2].image.copy()).double() / 255
    image = result.image.double()
    expected = 0.8 * (image - photograph).abs().mean() + 0.2 * (1 - ssim(image, photograph))
    assert float(result.loss) == pytest.approx(float(expected), rel=1e-4)


def test_points_become_round_splats_of_their_color_as_large_as_their_distance():
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [9, 9, 9]], np.float32)
    points = Points(corners, np.array([[0, 128, 255]] * 5, np.uint8))
    splats = initial_splats(points, SplatConfig())
    assert torch.allclose(splats.log_scales[0].exp(), torch.ones(3))
    assert torch.allclose(splats.opacity_logits.sigmoid(), torch.full((5,), 0.1))
    colors = 0.5 + splats.dc / (2 * np.sqrt(np.pi))
    assert torch.allclose(colors, torch.tensor([0, 128 / 255, 1]).expand(5, 3), atol=1e-6)
    assert not splats.rest.any() and splats.degree == 3


@pytest.mark.parametrize("count", [1, 2, 3])
def test_few_points_or_points_in_one_place_are_enough_to_begin(count):
    points = Points(np.ones((count, 3), np.float32), np.zeros((count, 3), np.uint8))
    splats = initial_splats(points, SplatConfig())
    assert torch.isfinite(splats.log_scales).all()


def test_one_object_on_white_does_not_vanish(blob_scene):
    g = torch.Generator().manual_seed(0)
    ball = torch.nn.functional.normalize(torch.randn(60, 3, generator=g), dim=1) * 0.35
    gaussians = Gaussians(
        ball, torch.tensor([[1.0, 0, 0, 0]]).repeat(60, 1), torch.full((60, 3), 0.1), torch.full((60,), 0.95),
        torch.tensor([0.1, 0.3, 0.8]).repeat(60, 1),
    )  # fmt: skip
    white = RasterSettings(background=(1.0, 1.0, 1.0))
    views = tuple(
        replace(v, pixels=to_8bit(rasterize(gaussians, v.camera, white).image))
        for v in blob_scene.train_views
    )
    scene = replace(blob_scene, train_views=views, background=(1.0, 1.0, 1.0))
    model = train_splats(scene, Config(training=TrainingConfig(steps=300)))
    assert model.background == (1.0, 1.0, 1.0)
    for view in views[:3]:
        blank = psnr(np.full_like(view.image, 255), view.image)
        assert psnr(to_8bit(render(model, view.camera).image), view.image) > 8 + blank


def test_scenes_that_cannot_be_trained_are_refused_before_any_step(blob_scene, config):
    with pytest.raises(ConfigError, match="no training views"):
        train_splats(replace(blob_scene, train_views=()), config)
    far = Points(blob_scene.points.positions + 1e6, blob_scene.points.colors)
    with pytest.raises(TrainingError, match="poses"):
        train_splats(replace(blob_scene, points=far), config)
