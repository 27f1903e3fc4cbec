"""The `paper` preset is what docs/paper_map.md says the paper and the authors' release do."""

import dataclasses

import pytest
import torch

from compgs.config import Config, load_config
from compgs.entropy.models import OwnResidualsEntropyModel
from compgs.trained_model import TrainedModel
from compgs.training.optimizers import HEAD_RATES, make_optimizer
from compgs.training.structure.control import GROWTH_LEVELS, make_schedule
from compgs.training.structure.variants import VARIANTS, Variant

# As published; a comment where docs/paper_map.md gives a reason for another number here.
PUBLISHED = {
    "model.coupled_primitives": 10,
    "model.reference_dim": 32,
    "model.residual_dim": 8,
    "model.residuals": True,
    "model.width": 32,
    "model.dilation": 0.3,  # of 3DGS, whose rasterizer the paper uses
    "model.heads": "separate",
    "model.voxel_spacings": 1.0,  # (published: a number for each data set)
    "model.reference_context": "hyperprior",
    "model.row_context": False,
    "model.point_colors": False,
    "entropy.reference_hyper_dim": 4,
    "entropy.quantization_steps": (1.0, 1.0, 0.01),  # of references, residuals, log scales
    "entropy.decorrelate_at": (),
    "entropy.quantized": True,
    "entropy.network_blocks": 2,
    "control.stop": 0.5,
    "control.gradient_threshold": 1e-4,
    "control.growth_probabilities": (0.5, 0.75, 0.875),
    "control.variant": "published",
    "control.minimum_views": 41,  # more than 40
    "control.opacity_threshold": 5e-4,
    "control.prune_at": (),
    "control.idle_share": 0.0,
    "training.steps": 30_000,
    "training.views_per_step": 1,
    "training.lmbda": 0.001,
    "training.rate": "elements",
    "training.ssim_weight": 0.2,
    "training.scale_weight": 0.01,
    "training.embedding_lr": (0.05, 3e-4),  # (published: 0.0075 -> 5e-5 times the extent)
    "training.log_scale_lr": (0.007, 0.007),
    "training.entropy_lr": (2e-4, 1e-5),
    "training.head_lr": 1.0,
    "training.schedule": "cosine",
    # no warm-up, the rate from 3 000 of 30 000 steps on, noise to the end, no mean; how weights are stored
    "training.phases": (0.0, 0.1, 1.0, 0.8, 1.0),
    "training.rules": "none",
}


@pytest.fixture(scope="module")
def paper() -> Config:
    return load_config("paper")


@pytest.fixture(scope="module")
def model(paper: Config) -> TrainedModel:
    return TrainedModel(paper, torch.zeros(1, 3, dtype=torch.int32), 1.0, 1.0, (0.0, 0.0, 0.0))


def test_control_is_the_published_one(paper: Config) -> None:
    expected = Variant(
        start_passes=5.0, every_passes=2.0, observe_passes=3.0, minimum_share=0.2,  # (the last: bounds of short runs)
        opacity_views=1, opacity_share=0.0, reset_all=True, finer_needs_coarser=True, entropy_steps=30_000,
    )  # fmt: skip
    assert VARIANTS[paper.control.variant] == expected


def test_the_heads_learn_at_the_published_rates() -> None:
    assert HEAD_RATES == {
        "translation": (2e-3, 2e-5), "covariance": (4e-3, 4e-5), "opacity": (2e-3, 2e-5), "color": (8e-3, 8e-5),
        "geometry": (4e-3, 4e-5), "appearance": (8e-3, 8e-5),  # of two heads in place of four
    }  # fmt: skip


def test_every_setting_is_the_published_one(paper: Config) -> None:
    values = {
        f"{section}.{key}": value
        for section, settings in dataclasses.asdict(paper).items()
        for key, value in settings.items()
    }
    assert {name: values[name] for name in PUBLISHED} == PUBLISHED


def test_no_setting_of_the_default_preset_slips_in(paper: Config) -> None:
    """What neither the table above nor this list names could change the method unseen."""
    free = {
        "model.voxel_size": "none: from the points' spacing",
        "model.max_anchors": "a limit",
        "entropy.network_bits": "how weights are stored",
        "entropy.head_bits": "how weights are stored",
        "control.start": "bounds of short runs",
        "control.every": "bounds of short runs",
        "control.prune_worth": "nothing is pruned",
        "training.seed": "",
        "training.target_bytes": "",
        "training.exposure": "off",
        "training.poses": "no rule is applied",
        "training.robust": "off",
        "training.viewpoints": "what the file keeps beside the scene",
    }
    names = {
        f"{section}.{key}"
        for section, settings in dataclasses.asdict(paper).items()
        for key in settings
        if section != "splats"
    }
    assert names == PUBLISHED.keys() | free.keys()


def test_entropy_networks_have_two_residual_blocks_of_width_32_and_a_linear_skip(model: TrainedModel) -> None:
    networks = model.entropy.coded_networks
    assert [network.weights[0].shape[1] for network in networks] == [4, 32, 42]  # inputs
    assert [network.channels for network in networks] == [32, 6, 80]
    for network in networks:
        inputs = network.weights[0].shape[1]
        hidden = [(32, inputs), (32, 32), (32, 32), (32, 32), (32, 32)]
        assert [tuple(w.shape) for w in network.weights] == [*hidden, (2 * network.channels, 32 + inputs)]


def test_log_scales_have_six_learned_steps_of_one_hundredth(model: TrainedModel) -> None:
    assert model.entropy.covariance_step.tolist() == pytest.approx([0.01] * 6)
    assert model.entropy.log_covariance_step.requires_grad


@pytest.mark.parametrize("coupled", [5, 10, 15])
def test_an_anchors_residuals_have_one_hyperprior_channel_for_each(paper: Config, coupled: int) -> None:
    settings = dataclasses.replace(paper.model, coupled_primitives=coupled)
    config = dataclasses.replace(paper, model=settings)
    model = TrainedModel(config, torch.zeros(1, 3, dtype=torch.int32), 1.0, 1.0, (0.0, 0.0, 0.0))
    assert isinstance(model.entropy, OwnResidualsEntropyModel)
    assert model.entropy.residual_hyperprior.analysis.second.out_features == coupled


def test_a_run_of_the_published_length_is_controlled_as_published(paper: Config) -> None:
    views, steps = 260, 30_000
    schedule = make_schedule(paper.control, steps, views)
    acts = [step for step in range(steps) if schedule.due(step)]
    # After 5 V steps, every 2 V, until half of the run.
    assert acts == list(range(5 * views - 1, steps // 2, 2 * views)) and len(acts) == 27
    assert [schedule.active(step) for step in (3 * views - 1, 3 * views, 14_999, 15_000)] == [
        False, True, True, False,
    ]  # fmt: skip
    assert GROWTH_LEVELS == ((1.0, 16), (2.0, 4), (4.0, 1))
    # The shares of short runs are beyond the published minimum.
    assert int(VARIANTS[paper.control.variant].minimum_share * schedule.every) >= paper.control.minimum_views


@pytest.mark.parametrize(("steps", "factor"), [(30_000, 1.0), (60_000, 1.0), (1_500, 20.0)])
def test_entropy_models_learn_as_published_and_in_short_runs_get_as_far(
    paper: Config, model: TrainedModel, steps: int, factor: float
) -> None:
    optimizer = make_optimizer(model, dataclasses.replace(paper.training, steps=steps))
    (group,) = (g for g in optimizer.param_groups if g["name"] == "entropy")
    assert group["rates"] == pytest.approx((2e-4 * factor, 1e-5 * factor))
    assert optimizer.defaults["eps"] == 1e-15
