"""What training starts from."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
import torch

from compgs.config import Config, load_config
from compgs.entropy.gaussian import scale_from_index
from compgs.model import HeadDimensions
from compgs.render import RasterSettings
from compgs.scene.points import colors_at
from compgs.scene.views import Scene
from compgs.tensors.heads import make_heads
from compgs.tensors.prediction import predict
from compgs.training import plan as plan_module
from compgs.training.plan import grid_spacings
from compgs.training.start import initial_model


@pytest.mark.parametrize("layout", ["paired", "separate", "shallow"])
def test_before_anything_is_learned_references_pass_as_color_logits(layout: str) -> None:
    heads = make_heads(layout, HeadDimensions(8, 4, 16))
    mean = torch.tensor([0.5, -1.0, 0.25])
    heads.pass_colors(mean)
    network = heads.color if layout == "separate" else heads.appearance
    features = torch.randn(7, 12)
    with torch.no_grad():
        network.output_weight.zero_()  # the hidden layers; only the skip is left
        network.skip_weight[8:].zero_()  # of view and residual
        network.skip_weight[3:8].zero_()  # of the other reference channels
        raw = network(features, torch.randn(7, 4), torch.arange(7))
    torch.testing.assert_close(raw[:, -3:], features[:, :3] + mean)


def test_the_first_image_has_the_colors_of_the_points(blob_scene: Scene, tiny_config: Config) -> None:
    """Random networks add to them; on average over anchors little."""
    errors = {}
    seed = replace(
        tiny_config.training, seed=1
    )  # of others, random networks make every primitive transparent
    for point_colors in (False, True):
        model_config = replace(tiny_config.model, point_colors=point_colors)
        model = initial_model(blob_scene, replace(tiny_config, model=model_config, training=seed))
        latents = model.quantized()
        camera = torch.tensor([0.0, -4.0, 0.5])
        with torch.no_grad():
            prediction = predict(model.heads, model.primitives(latents), camera, model.distance_unit)
        anchors = prediction.index // model_config.coupled_primitives
        wanted = colors_at(blob_scene.points, model.positions().numpy())[anchors.numpy()]
        errors[point_colors] = float(np.abs(prediction.gaussians.colors.numpy() - wanted).mean())
    assert errors[True] < 0.5 * errors[False]


def test_colors_of_anchors_at_points_are_the_points_and_between_them_lie_between(blob_scene: Scene) -> None:
    points = blob_scene.points
    exact = colors_at(points, points.positions.astype(np.float64))
    np.testing.assert_allclose(exact, points.colors / 255.0, atol=0.02)
    between = colors_at(points, np.random.default_rng(0).uniform(-1, 1, (50, 3)))
    assert between.min() >= points.colors.min() / 255.0 and between.max() <= points.colors.max() / 255.0


def test_anchors_are_as_large_as_the_distance_to_their_three_neighbours(
    blob_scene: Scene, tiny_config: Config
) -> None:
    model = initial_model(blob_scene, tiny_config)
    places = model.coordinates.double().numpy()
    distances = np.sort(np.linalg.norm(places[:, None] - places, axis=2), axis=1)[:, 1:4]
    expected = np.log(np.sqrt((distances**2).mean(1)))
    np.testing.assert_allclose(model.log_scales.detach().numpy(), expected[:, None].repeat(6, 1), rtol=1e-5)


def test_the_entropy_model_expects_the_sizes_that_anchors_start_with(
    blob_scene: Scene, tiny_config: Config
) -> None:
    model = initial_model(blob_scene, tiny_config)
    with torch.no_grad():
        mean, scale = model.entropy.covariance_network(torch.zeros(1, model.reference_dim))
    step, sizes = model.entropy.covariance_step.detach(), model.log_scales.detach()
    assert mean[0] * step == pytest.approx(sizes.mean().expand(6), rel=1e-4)
    assert scale_from_index(scale[0]) * step == pytest.approx(sizes.std().expand(6), rel=1e-3)


def test_networks_are_random_by_the_seed_and_leave_other_chance_alone(
    blob_scene: Scene, tiny_config: Config
) -> None:
    def first(seed: int) -> torch.Tensor:
        training = replace(tiny_config.training, seed=seed)
        model = initial_model(blob_scene, replace(tiny_config, training=training))
        return torch.cat([p.detach().flatten() for p in model.heads.parameters()])

    state = torch.get_rng_state()
    assert torch.equal(first(3), first(3))
    assert not torch.equal(first(3), first(4))
    assert torch.equal(torch.get_rng_state(), state)


def test_the_dilation_is_an_angle_in_which_most_cameras_have_the_pixels_that_were_asked_for(
    blob_scene: Scene, tiny_config: Config
) -> None:
    config = replace(tiny_config, model=replace(tiny_config.model, dilation=0.5))
    camera = blob_scene.train_views[0].camera
    odd = replace(blob_scene.train_views[0], camera=replace(camera, fx=7 * camera.fx))
    scene = replace(blob_scene, train_views=(odd, *blob_scene.train_views[1:]))
    model = initial_model(scene, config)
    settings = RasterSettings(angular_dilation=model.angular_dilation)
    assert settings.dilation_of(scene.train_views[1].camera) == pytest.approx(0.5)
    assert model.angular_dilation == float(np.float32(model.angular_dilation))  # as the file has it
    assert model.as_hybrid_model().angular_dilation == model.angular_dilation


def test_the_paper_preset_starts_from_references_of_zero(blob_scene: Scene) -> None:
    model = initial_model(blob_scene, load_config("paper"))
    assert not model.references.any()


@pytest.mark.parametrize(
    ("lmbda", "spacings"), [(1e-6, 1.5), (0.002, 1.5), (0.016, 2.1213), (0.1, 2.8789), (10.0, 2.8789)]
)
def test_voxels_are_larger_where_bits_are_dear(lmbda: float, spacings: float) -> None:
    """By the sixth root of lambda / 0.002, as far as growth follows lambda."""
    config = replace(Config(), training=replace(Config().training, lmbda=lmbda))
    assert grid_spacings(config) == pytest.approx(spacings, rel=1e-4)
    assert (
        grid_spacings(replace(config, training=replace(config.training, rules="all but coarser_grid"))) == 1.5
    )


def test_a_run_starts_on_the_grid_that_its_lambda_asks_for(blob_scene: Scene, tiny_config: Config) -> None:
    """But a voxel size that is given stays as it is."""
    free = replace(tiny_config, model=replace(tiny_config.model, voxel_size=None))
    sizes = []
    for config in (free, tiny_config):
        for lmbda in (0.002, 0.1):
            dear = replace(config, training=replace(config.training, lmbda=lmbda))
            sizes.append(initial_model(blob_scene, dear).voxel_size)
    assert sizes[1] == pytest.approx(50 ** (1 / 6) * sizes[0]) and sizes[2:] == [0.1, 0.1]


def test_a_large_capture_starts_on_a_finer_grid(
    blob_scene: Scene, tiny_config: Config, monkeypatch: pytest.MonkeyPatch
) -> None:
    free = replace(tiny_config, model=replace(tiny_config.model, voxel_size=None))
    usual = initial_model(blob_scene, free)
    views = tuple(itertools.islice(itertools.cycle(blob_scene.train_views), 23))
    monkeypatch.setattr(plan_module, "MANY_ANCHORS", usual.anchors)
    without = replace(free, training=replace(free.training, rules="all but dense_points"))
    fine = initial_model(replace(blob_scene, train_views=views), without)
    assert fine.voxel_size == pytest.approx(0.7 / 1.5 * usual.voxel_size)
    assert fine.anchors >= usual.anchors and fine.plan.coupled_primitives == 3
