import itertools
from dataclasses import replace

import numpy as np
import pytest
import torch

from compgs.cameras import Camera
from compgs.config import SplatConfig
from compgs.tensors.reference import rotation_matrices
from compgs.tensors.splats import Splats
from compgs.training.splats.densification import (
    LOG_SHRINK,
    DensityControl,
    densify_schedule,
    rotate,
    split,
)
from compgs.training.splats.parameters import (
    SplatParameters,
    make_splat_optimizer,
    replace_splats,
    reset_opacities,
)

CPU = torch.device("cpu")
EXTENT = 4.0


def made(sizes: list[float], opacities: list[float]) -> SplatParameters:
    """Round splats on a line; sizes in scene extents."""
    n, g = len(sizes), torch.Generator().manual_seed(0)
    return SplatParameters(
        Splats(
            means=torch.arange(n).float()[:, None].repeat(1, 3),
            log_scales=(torch.tensor(sizes) * EXTENT).log()[:, None].repeat(1, 3),
            quaternions=torch.randn(n, 4, generator=g),
            opacity_logits=torch.logit(torch.tensor(opacities)),
            dc=torch.randn(n, 3, generator=g),
            rest=torch.randn(n, 3, 3, generator=g),
        )
    )


def after_one_step(parameters: SplatParameters, config: SplatConfig):
    """An optimizer with moments that say which splat they belong to."""
    optimizer = make_splat_optimizer(parameters, config, EXTENT)
    for p in parameters.parameters():
        p.grad = torch.arange(1.0, len(p) + 1).view(-1, *[1] * (p.dim() - 1)).expand_as(p).clone()
    for group in optimizer.param_groups:
        group["lr"] = 0.0
    optimizer.step()
    optimizer.zero_grad()
    return optimizer


def act(parameters, optimizer, gradient: list[float], config=None, *, remove_large=False):
    control = DensityControl(config or SplatConfig(), EXTENT, len(parameters), CPU)
    control.gradient[:] = torch.tensor(gradient) * 3
    control.seen[:] = 3
    splats, chance = parameters.trained(), torch.Generator().manual_seed(0)
    kept, added, origins = control.chosen(splats, splats, chance, remove_large=remove_large)
    assert torch.equal(added.dc, splats.dc[origins])
    replace_splats(parameters, optimizer, kept, added)
    control.forget(len(parameters))
    assert len(control.gradient) == len(control.seen) == len(parameters)
    assert not control.gradient.any() and not control.seen.any()


def test_small_splats_are_cloned_and_large_ones_split_where_the_image_pulls():
    parameters = made([0.001, 0.05, 0.001, 0.05], [0.5, 0.6, 0.7, 0.8])
    before = parameters.trained()
    optimizer = after_one_step(parameters, SplatConfig())
    act(parameters, optimizer, [1e-3, 1e-3, 1e-5, 1e-5])
    after = parameters.trained()
    assert len(after) == 6
    kept = torch.tensor([0, 2, 3])
    parents = torch.tensor([0, 1, 1])  # of the clone and of the two parts
    for name in ("dc", "rest", "quaternions", "opacity_logits"):
        old, new = getattr(before, name), getattr(after, name)
        assert torch.equal(new, torch.cat([old[kept], old[parents]])), name
    assert torch.equal(after.means[3], before.means[0])
    assert torch.equal(after.log_scales[3], before.log_scales[0])
    assert torch.allclose(after.log_scales[4:] + LOG_SHRINK, before.log_scales[1])
    assert not torch.equal(after.means[4], after.means[5])
    moments = optimizer.state[parameters.dc]["exp_avg"]
    assert torch.equal(moments[:3, 0], 0.1 * torch.tensor([1.0, 3.0, 4.0]))
    assert not moments[3:].any()


def test_a_view_adds_its_gradients_in_half_images_and_counts_what_it_draws():
    control = DensityControl(SplatConfig(), EXTENT, 3, CPU)
    camera = Camera(np.eye(4), 50.0, 50.0, 24.0, 18.0, 48, 36)
    gradient = torch.tensor([[3 / 24, -4 / 18], [0.0, 0.0], [0.5 / 24, 0.0]])
    for times in (1, 2):
        control.observe(gradient, torch.tensor([True, False, True]), camera)
        assert torch.allclose(control.gradient, times * torch.tensor([5.0, 0.0, 0.5]))
        assert control.seen.tolist() == [times, 0, times]


def test_splats_are_judged_by_their_mean_gradient_over_the_views_that_drew_them():
    parameters = made([0.001] * 4, [0.5] * 4)
    before = parameters.trained()
    control = DensityControl(SplatConfig(gradient_threshold=1.0), EXTENT, 4, CPU)
    control.gradient[:] = torch.tensor([9.0, 1.1, 0.9, 11.0])
    control.seen[:] = torch.tensor([10.0, 1.0, 0.0, 10.0])
    kept, added, origins = control.chosen(before, before, torch.Generator(), remove_large=False)
    assert kept.all() and origins.tolist() == [1, 3]
    assert torch.equal(added.dc, before.dc[[1, 3]])


def test_parts_are_spread_as_their_parent_is():
    parent = Splats(
        means=torch.tensor([[1.0, 2.0, 3.0]]),
        log_scales=torch.tensor([[0.5, 1.5, 0.1]]).log(),
        quaternions=torch.tensor([[0.3, -0.5, 0.2, 0.9]]),
        opacity_logits=torch.zeros(1),
        dc=torch.zeros(1, 3),
        rest=torch.zeros(1, 0, 3),
    )
    many = parent.rows(torch.zeros(40_000, dtype=torch.int64))
    parts = split(many, torch.Generator().manual_seed(0)).means
    rotation = rotation_matrices(parent.quaternions)[0]
    expected = rotation @ torch.diag(parent.log_scales[0].exp() ** 2) @ rotation.T
    assert torch.allclose(parts.mean(0), parent.means[0], atol=0.03)
    assert torch.allclose(torch.cov(parts.T), expected, atol=0.04)


def test_rotating_is_multiplying_by_the_matrix():
    g = torch.Generator().manual_seed(1)
    quaternions, vectors = torch.randn(30, 4, generator=g), torch.randn(30, 3, generator=g)
    expected = (rotation_matrices(quaternions) @ vectors[:, :, None])[:, :, 0]
    assert torch.allclose(rotate(quaternions, vectors), expected, atol=1e-5)


def test_transparent_splats_go_and_large_ones_once_opacities_were_reset():
    for remove_large, left in ((False, [0, 2]), (True, [0])):
        parameters = made([0.001, 0.001, 0.5], [0.5, 0.004, 0.5])
        before = parameters.trained()
        optimizer = after_one_step(parameters, SplatConfig())
        act(parameters, optimizer, [0.0, 0.0, 0.0], remove_large=remove_large)
        assert torch.equal(parameters.dc, before.dc[left])
        assert torch.equal(optimizer.state[parameters.dc]["exp_avg"][:, 0], 0.1 * (torch.tensor(left) + 1.0))


def test_the_limit_holds_and_the_strongest_pull_wins():
    parameters = made([0.001] * 5, [0.5] * 5)
    before = parameters.trained()
    config = SplatConfig(max_splats=7)
    act(parameters, after_one_step(parameters, config), [3e-4, 9e-4, 4e-4, 1e-4, 8e-4], config)
    assert len(parameters) == 7
    assert torch.equal(parameters.dc[5:], before.dc[[1, 4]])


def test_a_scene_whose_splats_are_all_transparent_keeps_them():
    parameters = made([0.001] * 3, [0.001] * 3)
    act(parameters, after_one_step(parameters, SplatConfig()), [0.0, 0.0, 0.0])
    assert len(parameters) == 3


def test_a_reset_lowers_opacities_and_forgets_their_moments_alone():
    parameters = made([0.001] * 3, [0.9, 0.004, 0.3])
    optimizer = after_one_step(parameters, SplatConfig())
    reset_opacities(parameters, optimizer, 0.01)
    expected = torch.tensor([0.01, 0.004, 0.01])
    assert torch.allclose(parameters.opacity_logits.sigmoid(), expected, atol=1e-6)
    assert not optimizer.state[parameters.opacity_logits]["exp_avg"].any()
    assert optimizer.state[parameters.dc]["exp_avg"].any()
    assert any(parameters.opacity_logits is p for group in optimizer.param_groups for p in group["params"])


@pytest.mark.parametrize("views", [20, 100, 400])
def test_a_run_of_the_published_length_goes_as_published(views):
    schedule = densify_schedule(SplatConfig(), 30_000, views)
    assert (schedule.start, schedule.stop, schedule.every) == (500, 15_000, 100)
    resets = [step for step in range(30_000) if schedule.reset_due(step)]
    assert resets == [3_000, 6_000, 9_000, 12_000]


@pytest.mark.parametrize("steps", [500, 2_000, 4_000, 10_000])
def test_in_short_runs_every_view_is_seen_before_a_splat_is_judged_or_reset(steps):
    views = 81
    schedule = densify_schedule(SplatConfig(), steps, views)
    controls = [step for step in range(steps) if schedule.due(step)]
    resets = [step for step in range(steps) if schedule.reset_due(step)]
    assert controls[0] >= views
    assert all(b - a >= views for a, b in itertools.pairwise(controls))
    assert all(step >= 5 * views and schedule.stop - step >= 2 * views for step in resets)


def test_fractions_of_the_schedule_are_settings():
    config = replace(SplatConfig(), densify_stop=0.8, reset_every=0.5)
    schedule = densify_schedule(config, 2_000, 10)
    assert schedule.stop == 1_600
    assert [step for step in range(2_000) if schedule.reset_due(step)] == [1_000]


def test_few_views_do_not_make_judgements_and_resets_frequent():
    schedule = densify_schedule(SplatConfig(), 2_000, 15)
    assert schedule.every == 100
    assert [step for step in range(2_000) if schedule.reset_due(step)] == [300, 600]
    assert densify_schedule(SplatConfig(), 400, 15).every == 20  # ten judgements
