"""Several views a step: the gradients of each, added; and what scales with their number."""

import math
from dataclasses import replace

import pytest
import torch

from compgs.config import Config, ControlConfig, Phases, SplatConfig, TrainingConfig
from compgs.errors import ConfigError
from compgs.scene.views import Scene
from compgs.training.splats.densification import densify_schedule
from compgs.training.splats.trainer import SplatTrainer
from compgs.training.step.step_views import noise_of_some, seen_anchors
from compgs.training.step.views_in_turn import ViewsInTurn
from compgs.training.structure.control import make_schedule
from compgs.training.trainer import Trainer

from .rules import SIZES_AS_SET, without

CPU = torch.device("cpu")
# Nothing is left to chance: no primitive is left out, no anchor, and the likelihood sees symbols.
CERTAIN = {
    "steps": 20,
    "rules": without(SIZES_AS_SET, "dropout", "hidden_anchors"),
    "phases": Phases(rate=0.0, symbols=0.0),
}


def with_training(config: Config, **settings: object) -> Config:
    return replace(config, training=replace(config.training, **settings))


def half_unseen(scene: Scene) -> Scene:
    """Every second view looks through a long lens: no view shows all anchors, nor the same ones as another."""
    views = tuple(
        replace(v, camera=replace(v.camera, fx=200.0, fy=200.0, cx=10.0 * i)) if i % 2 else v
        for i, v in enumerate(scene.train_views)
    )
    return replace(scene, train_views=views)


def gradients(
    kind: type, scene: Scene, config: Config, order: list[int], monkeypatch: pytest.MonkeyPatch
) -> tuple[dict[str, torch.Tensor], float]:
    """What the first step would move the parameters by, and its loss."""
    trainer = kind(scene, config, CPU)
    if kind is Trainer:
        with torch.no_grad():
            trainer.model.log_scales -= 1.0
    trainer.views.order = order
    named = dict(trainer.model.named_parameters() if kind is Trainer else trainer.named_parameters())
    found: dict[str, torch.Tensor] = {}

    def keep(*_: object) -> None:
        found.update({name: p.grad.clone() for name, p in named.items() if p.grad is not None})

    monkeypatch.setattr(trainer, "update", keep)
    return found, float(trainer.train_step().loss)


@pytest.mark.parametrize("settings", [{}, {"lmbda": 0.0}, {"lmbda": 0.5, "rate": "elements"}], ids=str)
def test_a_step_of_several_views_has_the_gradients_of_a_step_of_each_together(
    blob_scene: Scene, tiny_config: Config, settings: dict[str, object], monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = half_unseen(blob_scene)
    config = with_training(tiny_config, **CERTAIN, **settings)
    together, _ = gradients(Trainer, scene, with_training(config, views_per_step=3), [1, 2, 3], monkeypatch)
    each = [gradients(Trainer, scene, config, [view], monkeypatch)[0] for view in (3, 1, 2)]
    assert together.keys() == each[0].keys() and len(together) > 10
    for name, gradient in together.items():
        expected = sum(one[name] for one in each)
        error = (gradient - expected).abs().max()
        assert error <= 2e-5 * expected.abs().max() + 1e-9, name
    unlike = each[0]["references"] - each[1]["references"]
    assert unlike.abs().max() > 0.1 * each[0]["references"].abs().max(), "the views do not show the same"


def test_of_splats_too(blob_scene: Scene, tiny_config: Config, monkeypatch: pytest.MonkeyPatch) -> None:
    several = with_training(tiny_config, views_per_step=2)
    together, loss = gradients(SplatTrainer, blob_scene, several, [0, 1], monkeypatch)
    each = [gradients(SplatTrainer, blob_scene, tiny_config, [view], monkeypatch) for view in (0, 1)]
    assert loss == pytest.approx((each[0][1] + each[1][1]) / 2, rel=1e-6), "the mean"
    for name, gradient in together.items():
        torch.testing.assert_close(gradient, each[0][0][name] + each[1][0][name], rtol=1e-4, atol=1e-9)


def test_latents_are_quantized_and_their_bits_counted_once_for_all_views(
    blob_scene: Scene, tiny_config: Config, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene, asked = half_unseen(blob_scene), []
    trainer = Trainer(scene, with_training(tiny_config, **CERTAIN, views_per_step=4), CPU)
    with torch.no_grad():
        trainer.model.log_scales -= 1.0
    trainer.views.order = [1, 3, 4, 6]
    quantized = trainer.model.quantized
    expected = set()
    for view in trainer.views.order:
        expected |= set(trainer.survey.visible_anchors(trainer.scene.train_views[view].camera).tolist())
    assert trainer.survey.bounds.measured is not None, "asking for it is over"
    monkeypatch.setattr(
        trainer.model, "quantized", lambda rows, **how: asked.append(rows.tolist()) or quantized(rows, **how)
    )
    trainer.train_step()
    assert asked == [sorted(expected)]


def test_growth_gathers_what_each_view_alone_would_have_shown(
    blob_scene: Scene, tiny_config: Config, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Gradients are those of a view's own loss, not of a mean over the step's: thresholds mean what they meant."""
    control = replace(tiny_config.control, start=0.9, stop=1.0, every=0.9)
    config = with_training(replace(tiny_config, control=control), **CERTAIN)
    several = Trainer(blob_scene, with_training(config, views_per_step=2), CPU)
    several.views.order = [0, 1]
    several.train_step()
    one = Trainer(blob_scene, config, CPU)
    monkeypatch.setattr(one, "update", lambda *_: one.optimizer.zero_grad(set_to_none=True))
    for view in (0, 1):
        one.views.order = [view]
        one.train_step()
    for name in ("gradient", "drawn", "opacity", "seen"):
        found, expected = getattr(several.control, name), getattr(one.control, name)
        torch.testing.assert_close(found, expected, rtol=1e-3, atol=1e-9)
    assert several.control.seen.max() == 2


@pytest.mark.parametrize("kind", [Trainer, SplatTrainer])
def test_learning_rates_go_with_the_root_of_the_views_and_betas_with_their_power(
    blob_scene: Scene, tiny_config: Config, kind: type
) -> None:
    one = kind(blob_scene, tiny_config, CPU)
    four = kind(blob_scene, with_training(tiny_config, views_per_step=4), CPU)
    for trainer in (one, four):
        trainer.train_step()
    for before, after in zip(one.optimizer.param_groups, four.optimizer.param_groups, strict=True):
        assert after["lr"] == pytest.approx(2 * before["lr"]), after["name"]
        assert before["betas"] == (0.9, 0.999)
        assert after["betas"] == pytest.approx((0.6561, 0.999**4))


def test_moments_of_independent_gradients_move_as_far_in_fewer_steps() -> None:
    """Where the rule comes from: gradients of views that have nothing in common, and a small common part."""
    from compgs.training.optimizers import betas_for, rates_for

    chance = torch.Generator().manual_seed(0)
    noise = torch.randn(4096, 64, generator=chance) + 0.05
    moved = {}
    for views in (1, 8):
        parameter = torch.nn.Parameter(torch.zeros(64))
        (rate, _), betas = rates_for(views, (1e-3, 1e-3)), betas_for(views)
        optimizer = torch.optim.Adam([parameter], lr=rate, betas=betas)
        for batch in noise.split(views):
            parameter.grad = batch.sum(0)
            optimizer.step()
        moved[views] = float(parameter.detach().mean())
    assert moved[8] == pytest.approx(moved[1], rel=0.1)


def test_a_pass_takes_fewer_steps_of_more_views() -> None:
    passes = ControlConfig(start=1.0, every=1.0, variant="published")
    one, four = make_schedule(passes, 30_000, 200), make_schedule(passes, 30_000, 200, 4)
    assert (one.start, one.every, one.observe) == (999, 400, 600)
    assert (four.start, four.every, four.observe) == (249, 100, 150)
    assert one.between == four.between == 400
    assert make_schedule(ControlConfig(every=0.001), 1_000, 81, 8).every == 11
    assert densify_schedule(SplatConfig(densify_every=1e-3), 1_000, 81, 8).every == 50
    assert densify_schedule(SplatConfig(), 1_000, 81, 1).every == 81


def test_each_step_takes_a_view_of_each_lane_and_a_pass_takes_all(blob_scene: Scene) -> None:
    views = ViewsInTurn(blob_scene, CPU, 0, TrainingConfig(views_per_step=4))
    for _ in range(3):
        steps = [views.next() for _ in range(2)]
        assert all([view % 4 for view in step] == [0, 1, 2, 3] for step in steps)
        assert sorted(steps[0] + steps[1]) == list(range(8))
    three = ViewsInTurn(blob_scene, CPU, 0, TrainingConfig(views_per_step=3))
    seen = [three.next() for _ in range(6)]
    assert sorted(step[0] for step in seen) == [0, 0, 3, 3, 6, 6]
    assert sorted(step[2] for step in seen) == [2, 2, 2, 5, 5, 5], "a shorter lane comes round earlier"


def test_a_step_needs_as_many_training_views(blob_scene: Scene, tiny_config: Config) -> None:
    with pytest.raises(ConfigError, match=r"views_per_step = 9: blobs has 8 training views"):
        Trainer(blob_scene, with_training(tiny_config, views_per_step=9), CPU)


@pytest.mark.parametrize("kind", [Trainer, SplatTrainer])
def test_a_run_of_several_views_a_step_continues_exactly(
    blob_scene: Scene, tiny_config: Config, tmp_path, kind: type
) -> None:
    config = with_training(tiny_config, steps=24, views_per_step=3, exposure=True)
    whole = kind(blob_scene, config, CPU)
    whole.run(None, None)
    first = kind(blob_scene, config, CPU)
    for _ in range(7):
        first.train_step()
    first.save(tmp_path / "run.safetensors")
    second = kind.resumed(blob_scene, tmp_path / "run.safetensors", config, CPU)
    second.run(None, None)
    module = (lambda t: t.model.state_dict()) if kind is Trainer else (lambda t: t.named_parameters())
    for name, value in module(whole).items():
        assert torch.equal(value, module(second)[name]), name
    assert whole.views.photometry.photographs.steps.sum() == 24 * 3


def test_views_that_show_nothing_do_not_stop_those_that_do(blob_scene: Scene, tiny_config: Config) -> None:
    away = blob_scene.train_views[0].camera
    turned = away.world_to_camera.copy()
    turned[:3] *= [[-1], [1], [-1]]  # half a turn around the image's vertical
    views = (
        replace(blob_scene.train_views[0], camera=replace(away, world_to_camera=turned)),
        *blob_scene.train_views[1:],
    )
    config = with_training(tiny_config, **CERTAIN, views_per_step=2)
    trainer = Trainer(replace(blob_scene, train_views=views), config, CPU)
    trainer.views.order = [0, 1]
    before = trainer.model.references.detach().clone()
    assert math.isfinite(float(trainer.train_step().loss))
    assert not torch.equal(trainer.model.references, before)
    assert trainer.control.seen.max() <= 1


def test_noise_for_some_rows_is_what_they_have_among_all() -> None:
    asked = []

    def noise(like: torch.Tensor) -> torch.Tensor:
        asked.append(tuple(like.shape))
        return torch.arange(like.numel()).view(like.shape).float()

    some = torch.tensor([1, 4])
    found = noise_of_some(noise, some, 6)(torch.zeros(2, 3))
    assert asked == [(6, 3)] and torch.equal(found, noise(torch.zeros(6, 3))[some])


def test_anchors_seen_by_any_view_and_where_each_views_own_are_among_them() -> None:
    rows = {2: torch.tensor([0, 3, 7]), 5: torch.tensor([3, 4]), 6: torch.tensor([], dtype=torch.int64)}
    seen = seen_anchors(rows, 9)
    assert seen.rows.tolist() == [0, 3, 4, 7] and seen.numbers == [2, 5]
    for number, expected in rows.items():
        assert torch.equal(seen.rows_of(number), expected)
