import itertools
from dataclasses import replace

import numpy as np
import pytest
import torch

from compgs.cameras import Camera
from compgs.config import Config, ControlConfig, ModelConfig, Phases, TrainingConfig, load_config
from compgs.gaussians import Gaussians
from compgs.tensors.prediction import Prediction
from compgs.trained_model import TrainedModel
from compgs.training.optimizers import make_optimizer
from compgs.training.plan import growth_factor
from compgs.training.rate import target_size
from compgs.training.rate.rate_control import RateState
from compgs.training.start import initial_model
from compgs.training.structure.control import AdaptiveControl, ControlSchedule, make_schedule, new_cells
from compgs.training.trainer import Trainer

CPU = torch.device("cpu")
PAPER = load_config("paper").control
# Training views of the published scenes, seven of eight of their photographs: stump has the fewest, room the most.
PUBLISHED_VIEWS = (109, 196, 219, 260, 272)


def ready(scene, config):
    trainer = Trainer(scene, config, CPU)
    for _ in range(3):
        trainer.train_step()
    return trainer


def test_growth_never_duplicates_a_position_and_keeps_to_the_limit(blob_scene, tiny_config):
    trainer = ready(blob_scene, tiny_config)
    control, model = trainer.control, trainer.model
    generator = torch.Generator().manual_seed(0)
    before = model.anchors
    control.drawn[:] = 1000
    control.gradient[:] = 1e6
    control.act(model, trainer.optimizer, trainer.survey.coupled_means() * 1.7 + 0.13, generator, 0.004)
    assert model.anchors > before
    assert len(torch.unique(model.coordinates, dim=0)) == model.anchors


def test_the_number_of_anchors_has_a_limit_that_holds(blob_scene, tiny_config):
    trainer = ready(blob_scene, tiny_config)
    limit = trainer.model.anchors + 7
    trainer.control.config = replace(tiny_config, model=replace(tiny_config.model, max_anchors=limit))
    trainer.control.drawn[:] = 1000
    trainer.control.gradient[:] = 1e6
    trainer.control.act(
        trainer.model,
        trainer.optimizer,
        trainer.survey.coupled_means() * 2,
        torch.Generator().manual_seed(0),
        0.004,
    )
    assert trainer.model.anchors == limit


def test_transparent_anchors_are_removed_with_their_moments(blob_scene, tiny_config):
    trainer = ready(blob_scene, tiny_config)
    control, model = trainer.control, trainer.model
    gone = torch.zeros(model.anchors, dtype=torch.bool)
    gone[::3] = True
    control.seen[:] = 100
    control.opacity[:] = torch.where(gone, 0.0, 50.0)
    control.drawn[:] = 0
    expected = {name: getattr(model, name).detach()[~gone] for name in model.anchor_parameters}
    moments = {
        name: trainer.optimizer.state[getattr(model, name)]["exp_avg"][~gone]
        for name in model.anchor_parameters
    }
    means = trainer.survey.coupled_means()
    control.act(model, trainer.optimizer, means, torch.Generator().manual_seed(0), 0.004)
    for name in model.anchor_parameters:
        parameter = getattr(model, name)
        assert torch.equal(parameter.detach(), expected[name])
        assert torch.equal(trainer.optimizer.state[parameter]["exp_avg"], moments[name])
        assert any(parameter is p for group in trainer.optimizer.param_groups for p in group["params"])
    trainer.train_step()


def test_new_anchors_have_no_momentum_and_the_others_keep_theirs(blob_scene, tiny_config):
    trainer = ready(blob_scene, tiny_config)
    control, model = trainer.control, trainer.model
    n = model.anchors
    before = trainer.optimizer.state[model.references]["exp_avg"].clone()
    control.drawn[:] = 1000
    control.gradient[:] = 1e6
    control.act(model, trainer.optimizer, trainer.survey.coupled_means() * 1.7, torch.Generator(), 0.004)
    assert model.anchors > n
    for name in model.anchor_parameters:
        state = trainer.optimizer.state[getattr(model, name)]
        assert not state["exp_avg"][n:].any() and not state["exp_avg_sq"][n:].any()
    assert torch.equal(trainer.optimizer.state[model.references]["exp_avg"][:n], before)


def test_a_scene_whose_anchors_are_all_transparent_keeps_them(blob_scene, tiny_config):
    trainer = ready(blob_scene, tiny_config)
    before = trainer.model.anchors
    trainer.control.seen[:] = 100
    trainer.control.opacity[:] = 0
    trainer.control.drawn[:] = 0
    trainer.control.act(
        trainer.model, trainer.optimizer, trainer.survey.coupled_means(), torch.Generator(), 0.004
    )
    assert trainer.model.anchors == before


def test_an_anchor_has_to_add_more_where_bits_weigh_more(tiny_config):
    """With the cube root of lambda."""
    config = tiny_config
    assert growth_factor(config, 0.002) == pytest.approx(1)
    assert growth_factor(config, 0.016) == pytest.approx(2)
    assert growth_factor(config, 0.0) == growth_factor(config, 1e-6) < 0.1  # without a rate, too, growth ends
    flat = replace(config, training=replace(config.training, rules="all but growth"))
    assert growth_factor(flat, 0.016) == 1


def test_the_schedule_scales_with_the_run(tiny_config):
    short = make_schedule(tiny_config.control, 1_000, 20)
    long = make_schedule(tiny_config.control, 10_000, 20)
    assert (long.start, long.stop, long.every) == (10 * short.start, 10 * short.stop, 10 * short.every)
    assert make_schedule(tiny_config.control, 100, 300).every == 300


def test_statistics_follow_the_anchors(blob_scene, tiny_config):
    """Through pruning: those that stay keep theirs, row by row."""
    model = initial_model(blob_scene, tiny_config)
    n, k = model.anchors, 4
    control = AdaptiveControl(tiny_config, make_schedule(tiny_config.control, 40, 8), (n, k), CPU)
    filled = {
        "gradient": torch.arange(n * k, dtype=torch.float32).view(n, k),
        "drawn": torch.arange(n * k, dtype=torch.float32).view(n, k) + 0.25,
        "opacity": torch.arange(n, dtype=torch.float32) + 0.5,
        "seen": torch.arange(n, dtype=torch.float32) + 0.75,
    }
    for name, values in filled.items():
        setattr(control, name, values.clone())
    kept = torch.rand(n, generator=torch.Generator().manual_seed(0)) < 0.6
    control.keep(model, make_optimizer(model, tiny_config.training), kept)
    assert model.anchors == int(kept.sum()) < n
    for name, values in filled.items():
        assert torch.equal(getattr(control, name), values[kept]), name


# the schedule ------------------------------------------------------------------------------------------------------


def controls(schedule: ControlSchedule, steps: int) -> list[int]:
    """Numbers of steps that are complete when control acts."""
    return [step + 1 for step in range(steps) if schedule.due(step)]


def test_the_default_preset_goes_by_fractions_of_the_run():
    schedule = make_schedule(ControlConfig(), 30_000, 260)
    assert [step for step in range(30_000) if schedule.due(step)] == list(range(4_500, 15_000, 1_500))
    assert schedule.active(0) and schedule.active(14_999) and not schedule.active(15_000)
    assert make_schedule(ControlConfig(), 1_500, 81) == ControlSchedule(start=225, stop=750, every=81)


def test_the_paper_preset_controls_27_times_as_published_with_260_views():
    schedule = make_schedule(PAPER, 30_000, 260)
    at = controls(schedule, 30_000)
    assert at == [1_300 + 520 * i for i in range(27)]
    assert at[-1] == 14_820


@pytest.mark.parametrize("views", PUBLISHED_VIEWS)
def test_a_run_of_the_published_length_goes_as_published(views):
    schedule = make_schedule(PAPER, 30_000, views)
    assert controls(schedule, 30_000) == list(range(5 * views, 15_000, 2 * views))
    assert [step for step in range(30_000) if schedule.active(step)] == list(range(3 * views, 15_000))


@pytest.mark.parametrize("views", PUBLISHED_VIEWS)
def test_a_run_of_the_published_length_judges_from_41_sightings_on(views):
    schedule = make_schedule(PAPER, 30_000, views)
    assert not judges(PAPER, schedule, 40)
    assert judges(PAPER, schedule, 41)


@pytest.mark.parametrize(
    ("steps", "views"), [(1_500, 81), (1_500, 20), (4_000, 81), (4_000, 200), (2_000, 12)]
)
def test_short_runs_of_the_paper_preset_control_seven_times_after_whole_passes(steps, views):
    schedule = make_schedule(PAPER, steps, views)
    at = controls(schedule, steps)
    assert len(at) >= 7
    assert at[0] <= 0.15 * steps + 1
    assert at[0] - schedule.observe >= views
    assert all(b - a >= views for a, b in itertools.pairwise(at))
    assert at[-1] <= steps / 2


def test_in_a_short_run_what_a_fifth_of_the_steps_saw_is_judged():
    schedule = make_schedule(PAPER, 1_500, 81)
    assert (schedule.start, schedule.every, schedule.observe) == (225, 81, 145)
    assert not judges(PAPER, schedule, 15)
    assert judges(PAPER, schedule, 16)


def test_few_views_do_not_make_controls_frequent():
    schedule = make_schedule(PAPER, 30_000, 12)
    assert controls(schedule, 30_000)[:3] == [500, 700, 900]


def test_control_has_not_ended_before_it_begins():
    schedule = ControlSchedule(start=20, stop=30, every=5, observe=10)
    assert [schedule.active(step) for step in (9, 10, 29, 30)] == [False, True, True, False]
    assert [schedule.ended(step) for step in (0, 9, 29, 30)] == [False, False, False, True]


def test_a_run_gathers_statistics_only_when_the_schedule_says_so(blob_scene, tiny_config):
    trainer = Trainer(blob_scene, tiny_config, CPU)
    trainer.schedule = ControlSchedule(start=20, stop=30, every=8, observe=2)
    for gathered in (False, False, True):
        trainer.train_step()
        assert bool(trainer.control.seen.any()) == gathered


def test_a_short_run_of_the_paper_preset_grows_and_prunes(blob_scene, tiny_config):
    control = replace(PAPER, gradient_threshold=1e-6, opacity_threshold=0.2)
    config = replace(tiny_config, control=control, training=replace(tiny_config.training, steps=100))
    trainer = Trainer(blob_scene, config, CPU)
    grown, gone = 0, 0
    while not trainer.schedule.ended(trainer.step):
        before = trainer.model.coordinates
        trainer.train_step()
        after = trainer.model.coordinates
        if len(after) != len(before):
            lost = len(torch.unique(torch.cat([before, after]), dim=0)) - len(after)
            gone, grown = gone + lost, grown + len(after) - (len(before) - lost)
    assert grown > 0 and gone > 0


def test_a_run_grows_by_the_lambda_that_it_has_come_to(blob_scene, tiny_config):
    """At fifty times the usual lambda the threshold is 3.7 times as high."""
    control = replace(tiny_config.control, growth_probabilities=(1.0, 1.0, 1.0))
    anchors = {}
    for lmbda in (0.002, 0.1):
        trainer = Trainer(blob_scene, replace(tiny_config, control=control), CPU)
        with torch.no_grad():
            trainer.model.residuals += 5 * torch.randn(
                trainer.model.residuals.shape, generator=torch.Generator().manual_seed(0)
            )
        trainer.control.drawn[:] = 1000
        trainer.control.gradient[:] = 3 * 1000 * control.gradient_threshold
        trainer.rate = RateState(lmbda)
        before = trainer.model.anchors
        trainer.structure.grow(trainer.step, trainer.rate)
        anchors[lmbda] = trainer.model.anchors - before
    assert anchors[0.002] > anchors[0.1] == 0


def test_a_size_is_followed_gently_before_statistics_are_gathered(blob_scene, tiny_config, monkeypatch):
    """Anchors are still to come then: `grown` is false."""
    config = replace(
        tiny_config, training=replace(tiny_config.training, target_bytes=10**6, phases=Phases(rate=0.0))
    )
    trainer = Trainer(blob_scene, config, CPU)
    trainer.structure.target_size.schedule = ControlSchedule(start=20, stop=30, every=8, observe=15)
    asked = []
    monkeypatch.setattr(target_size, "follow", lambda state, *_, grown, **__: asked.append(grown) or state)
    for step in (10, 20, 29, 30):
        trainer.structure.target_size.follow(trainer.rate, step)
    assert asked == [False, False, False, True]


# statistics by hand ------------------------------------------------------------------------------------------------


VOXEL = 0.5  # world units
K = 2


def made_model(coordinates, references, control: ControlConfig, max_anchors: int = 1_000_000) -> TrainedModel:
    """Anchors at given voxels, with K primitives each."""
    config = Config(
        model=ModelConfig(coupled_primitives=K, reference_dim=3, width=8, max_anchors=max_anchors),
        control=control,
        training=TrainingConfig(steps=100),
    )
    model = TrainedModel(config, torch.tensor(coordinates), VOXEL, 1.0, (0.0, 0.0, 0.0))
    with torch.no_grad():
        model.references.copy_(torch.tensor(references))
    return model


def judges(control: ControlConfig, schedule: ControlSchedule, sightings: int) -> bool:
    """Whether a primitive seen so often is judged: with so large a gradient, it then asks for an anchor."""
    certain = replace(control, growth_probabilities=(1.0, 1.0, 1.0))
    model = made_model([[0, 0, 0], [500, 0, 0]], [[0.0] * 3] * 2, certain)
    statistics = AdaptiveControl(model.config, schedule, (2, K), CPU)
    statistics.drawn[0, 0], statistics.gradient[0, 0] = sightings, 1e3
    act(statistics, model, means=[[[100.0] * 3] * K, [[250.0, 0.0, 0.0]] * K])
    return model.anchors > 2


def act(control: AdaptiveControl, model: TrainedModel, means, lmbda: float = 0.002, seed: int = 0) -> None:
    """Means in world units, [N, K, 3]."""
    optimizer = make_optimizer(model, model.config.training)
    noise = torch.Generator().manual_seed(seed)
    control.act(model, optimizer, torch.as_tensor(means, dtype=torch.float32), noise, lmbda)
    assert all(len(getattr(control, name)) == model.anchors for name in control.STATISTICS)


CERTAIN = ControlConfig(gradient_threshold=1.0, growth_probabilities=(1.0, 1.0, 1.0), minimum_views=10)
LONG = ControlSchedule(start=100, stop=1_000, every=100)


def with_gradients(model: TrainedModel, means: list[list[float]], views: float = 10.0) -> AdaptiveControl:
    """Control that has seen every primitive in so many views, with these mean gradients [N][K]."""
    control = AdaptiveControl(model.config, LONG, (model.anchors, K), CPU)
    control.drawn[:] = views
    control.gradient[:] = torch.tensor(means) * views
    return control


def grown_rows(model: TrainedModel, before: int) -> list[tuple[list[int], list[float], float]]:
    """Of the new anchors: voxel, reference, cell in voxels (all six log scales are its logarithm)."""
    rows = []
    for i in range(before, model.anchors):
        size = float(model.log_scales[i].detach().exp().mean())
        assert torch.allclose(model.log_scales[i], torch.tensor(size).log().expand(6), atol=1e-6)
        rows.append((model.coordinates[i].tolist(), model.references[i].tolist(), round(size, 4)))
    return rows


def test_a_view_adds_its_gradients_sightings_and_opacities_to_the_right_primitives():
    control = AdaptiveControl(Config(), LONG, (3, K), CPU)
    camera = Camera(np.eye(4), 50.0, 50.0, 24.0, 18.0, 48, 36)
    none = torch.zeros(3, 3)
    prediction = Prediction(
        Gaussians(none, torch.zeros(3, 4), none, torch.zeros(3), none),
        index=torch.tensor([0, 2, 3]),
        opacities=torch.tensor([0.5, -0.25, 0.125, 0.25]),
    )
    visible = torch.tensor([0, 2])
    # in half images (24 and 18 pixels): norms 5, 0 and 10
    gradient = torch.tensor([[3 / 24, 4 / 18], [0.0, 0.0], [6 / 24, -8 / 18]])
    for times in (1, 2):
        control.observe(visible, prediction, gradient, camera)
        assert torch.allclose(control.gradient, times * torch.tensor([[5.0, 0], [0, 0], [0, 10.0]]))
        assert torch.equal(control.drawn, times * torch.tensor([[1.0, 0], [0, 0], [0, 1.0]]))
        assert torch.equal(control.opacity, times * torch.tensor([0.5, 0.0, 0.375]))
        assert torch.equal(control.seen, times * torch.tensor([1.0, 0.0, 1.0]))


def test_each_grid_grows_from_the_primitives_that_pass_its_threshold():
    """lambda 0.016 is eight times the usual one, so the threshold is twice as large: 2, 4 and 8."""
    model = made_model(
        [[0, 0, 0], [400, 0, 0], [0, 400, 0]],
        [[1.0, 5.0, 2.0], [3.0, 4.0, -2.0], [9.0, 9.0, 9.0]],
        CERTAIN,
    )
    control = with_gradients(model, [[1.9, 2.1], [4.1, 8.1], [50.0, 3.9]])
    control.drawn[2, 0] = 9  # not judged
    voxels = [
        [[200, 200, 200], [97, 103, 101]],  # 1.9: too little; 2.1: grid of 16
        [[101, 102, 98], [301, 302, 303]],  # 4.1: grids of 16 (with the one above) and 4; 8.1: all three
        [[700, 700, 700], [-90, -70, 0]],  # not judged; 3.9: grid of 16
    ]
    act(control, model, torch.tensor(voxels) * VOXEL, lmbda=0.016)
    assert grown_rows(model, 3) == [
        ([-96, -64, 0], [9.0, 9.0, 9.0], 16.0),
        ([96, 96, 96], [3.0, 5.0, 2.0], 16.0),  # the largest of either parent
        ([304, 304, 304], [3.0, 4.0, -2.0], 16.0),
        ([100, 104, 100], [3.0, 4.0, -2.0], 4.0),
        ([300, 304, 304], [3.0, 4.0, -2.0], 4.0),
        ([301, 302, 303], [3.0, 4.0, -2.0], 1.0),
    ]
    assert torch.equal(model.mask[3:], torch.ones(6, K, dtype=torch.bool))


@pytest.mark.parametrize(
    ("config", "expected"), [(ControlConfig(), (0.5, 0.25, 0.125)), (PAPER, (0.5, 0.75, 0.875))]
)
def test_candidates_are_kept_as_often_as_the_preset_says(config, expected):
    n = 2_000
    control_config = replace(CERTAIN, growth_probabilities=config.growth_probabilities)
    coordinates = [[64 * i, 0, 0] for i in range(n)]
    model = made_model(coordinates, [[0.0] * 3] * n, control_config)
    control = with_gradients(model, [[100.0, 0.0]] * n)
    # 21 voxels beside each anchor: cells of its own at 16, 20 and 21
    beside = (torch.tensor(coordinates) + torch.tensor([21, 21, 21]))[:, None].repeat(1, K, 1)
    act(control, model, beside * VOXEL)
    sizes = [size for _, _, size in grown_rows(model, n)]
    for cell, probability in zip((16.0, 4.0, 1.0), expected, strict=True):
        deviation = (n * probability * (1 - probability)) ** 0.5
        assert abs(sizes.count(cell) - n * probability) < 4 * deviation, cell


# With an anchor at 0, a primitive at voxel 5 finds its cell of 16 taken, those of 4 and 1 free.
NEAR = [[5, 0, 0], [5, 0, 0]]
FAR = [[203, 0, 0], [203, 0, 0]]


@pytest.mark.parametrize(
    ("preset", "gradients", "expected"),
    [
        (ControlConfig(), [[100.0, 0.0], [0.0, 0.0]], [([4, 0, 0], 4.0), ([5, 0, 0], 1.0)]),
        (PAPER, [[100.0, 0.0], [0.0, 0.0]], []),
        (PAPER, [[100.0, 0.0], [1.5, 0.0]], [([208, 0, 0], 16.0), ([4, 0, 0], 4.0), ([5, 0, 0], 1.0)]),
    ],
)
def test_finer_grids_wait_for_a_coarser_one_that_has_grown(preset, gradients, expected):
    """As published; in the default preset they do not."""
    config = replace(CERTAIN, variant=preset.variant)
    model = made_model([[0, 0, 0], [400, 0, 0]], [[0.0] * 3] * 2, config)
    act(with_gradients(model, gradients), model, torch.tensor([NEAR, FAR]) * VOXEL)
    assert [(voxel, size) for voxel, _, size in grown_rows(model, 2)] == expected


def test_the_finest_grid_grows_after_the_coarsest_where_the_one_between_has_not():
    """A primitive at voxel 1: its cells of 16 and 4 are the anchor's, that of 1 is free."""
    model = made_model([[0, 0, 0], [400, 0, 0]], [[0.0] * 3] * 2, replace(CERTAIN, variant="published"))
    control = with_gradients(model, [[100.0, 0.0], [1.5, 0.0]])
    act(control, model, torch.tensor([[[1, 0, 0]] * K, FAR]) * VOXEL)
    assert [(v, size) for v, _, size in grown_rows(model, 2)] == [([208, 0, 0], 16.0), ([1, 0, 0], 1.0)]


def test_at_the_limit_the_cells_with_the_largest_gradients_grow():
    """Two of four cells: not those with the smallest x, the largest sum or mean, or the largest first candidate."""
    n = 3
    model = made_model(
        [[0, 0, 0], [400, 0, 0], [0, 400, 0]],
        [[1.0] * 3, [2.0] * 3, [3.0] * 3],
        CERTAIN,
        max_anchors=n + 2,
    )
    control = with_gradients(model, [[1.9, 1.5], [1.2, 1.3], [1.7, 1.4]])
    voxels = [[[320, 0, 0], [-160, 0, 0]], [[160, 0, 0], [-80, 0, 0]], [[160, 0, 0], [-80, 0, 0]]]
    act(control, model, torch.tensor(voxels) * VOXEL)
    assert grown_rows(model, n) == [([160, 0, 0], [3.0] * 3, 16.0), ([320, 0, 0], [1.0] * 3, 16.0)]


def test_candidates_know_which_new_cell_they_asked_for():
    target = torch.tensor([[33, 0, 0], [0, 0, 0], [-30, 1, 2], [30, 0, 0], [64, 0, 0]])
    taken = torch.tensor([[3, 3, 3]])
    cells, asked = new_cells(target, torch.tensor([1.0, 9.0, 3.0, 2.0, 1.5]), taken, 16, room=2)
    assert cells.tolist() == [[-32, 0, 0], [32, 0, 0]]
    assert asked.tolist() == [1, -1, 0, 1, -1]
    cells, asked = new_cells(target, torch.ones(5), taken, 16, room=0)
    assert cells.shape == (0, 3) and asked.tolist() == [-1] * 5


def filled(config: ControlConfig) -> tuple[AdaptiveControl, TrainedModel]:
    """Two anchors that ask for nothing and stay: one often seen, with a primitive judged and one not; one seen once."""
    model = made_model([[0, 0, 0], [400, 0, 0]], [[0.0] * 3] * 2, config)
    control = AdaptiveControl(model.config, LONG, (2, K), CPU)
    control.gradient[:] = torch.tensor([[0.1, 0.2], [0.3, 0.4]])
    control.drawn[:] = torch.tensor([[10.0, 9.0], [1.0, 10.0]])
    control.opacity[:] = torch.tensor([20.0, 1.0])
    control.seen[:] = torch.tensor([20.0, 1.0])
    return control, model


def test_what_was_judged_is_counted_anew_and_the_rest_goes_on():
    control, model = filled(CERTAIN)
    act(control, model, torch.zeros(2, K, 3))
    assert torch.equal(control.gradient, torch.tensor([[0.0, 0.2], [0.3, 0.0]]))
    assert torch.equal(control.drawn, torch.tensor([[0.0, 9.0], [1.0, 0.0]]))
    assert torch.equal(control.opacity, torch.tensor([0.0, 1.0]))
    assert torch.equal(control.seen, torch.tensor([0.0, 1.0]))


def test_as_published_everything_is_counted_anew():
    control, model = filled(replace(CERTAIN, variant=PAPER.variant))
    act(control, model, torch.zeros(2, K, 3))
    assert model.anchors == 2
    assert not any(getattr(control, name).any() for name in control.STATISTICS)


@pytest.mark.parametrize(
    ("config", "left"),
    [
        (ControlConfig(), [0, 1, 3, 4]),  # in view in a tenth of the hundred steps
        (PAPER, [0, 1, 3]),  # in view at all
    ],
)
def test_anchors_below_the_mean_opacity_go_if_they_were_in_view_often_enough(config, left):
    n = 5
    references = [[float(i)] * 3 for i in range(n)]
    model = made_model([[100 * i, 0, 0] for i in range(n)], references, config)
    control = AdaptiveControl(model.config, LONG, (n, K), CPU)
    control.seen[:] = torch.tensor([20.0, 10.0, 10.0, 0.0, 9.0])
    control.opacity[:] = control.seen * torch.tensor([6e-4, 6e-4, 4e-4, 0.0, 4e-4])
    act(control, model, torch.zeros(n, K, 3))
    assert model.references[:, 0].tolist() == left
