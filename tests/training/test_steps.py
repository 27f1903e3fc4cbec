"""What one step of training computes and moves, against formulas written out here."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from compgs.config import Config, Phases
from compgs.render import render
from compgs.scene.views import Scene, View
from compgs.tensors.ssim import ssim
from compgs.training.rate.rate_control import RateState
from compgs.training.step.moment import moment
from compgs.training.trainer import Trainer

from .rules import SIZES_AS_SET, without

CPU = torch.device("cpu")
STEPS = 20
# Nothing is left to chance: no primitive is left out, and from the first step on the likelihood sees symbols.
CERTAIN = {
    "steps": STEPS,
    "rules": without(SIZES_AS_SET, "dropout", "hidden_anchors", "rate_every"),
    "phases": Phases(rate=0.0, symbols=0.0),
}


def distortion_of(trainer: Trainer, l1: float, similarity: float) -> float:
    """What the image adds to the loss."""
    w = trainer.config.training.ssim_weight
    return (1 - w) * l1 + w * (1 - similarity)


def with_training(config: Config, **settings: object) -> Config:
    return replace(config, training=replace(config.training, **settings))


def started(scene: Scene, config: Config, step: int = 0, view: int = 2) -> Trainer:
    """A run that has come to a step, on latents that say something, with a view to come."""
    trainer = Trainer(scene, config, CPU)
    chance = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for latents in (trainer.model.references, trainer.model.residuals):
            latents += torch.randn(latents.shape, generator=chance)
    trainer.step = step
    trainer.views.order = [view]
    return trainer


def parts_of_loss(trainer: Trainer, view: View) -> tuple[float, float, float, dict[str, float]]:
    """L1, SSIM, mean volume of what is drawn in fifths of the larger of extent and distance, mean bits by stream."""
    hybrid = trainer.model.as_hybrid_model(stored_weights=False)
    image = torch.as_tensor(render(hybrid, view.camera).image).double()
    photograph = torch.from_numpy(view.image.copy()).double() / 255
    drawn = hybrid.gaussians(view.camera)
    distances = np.linalg.norm(np.asarray(drawn.means, np.float64) - view.camera.center, axis=1)
    units = np.maximum(distances, trainer.scene.extent) / 5
    volumes = np.asarray(drawn.scales, np.float64).prod(1) / units**3
    bits = trainer.model.quantized(rate=True, stored_weights=False).bits
    return (
        float((image - photograph).abs().mean()),
        float(ssim(image, photograph)),
        float(volumes.mean()),
        {name: float(b.detach().double().mean()) for name, b in bits.items()},
    )


@pytest.mark.parametrize(
    "settings",
    [
        {},
        {"ssim_weight": 0.0},
        {"ssim_weight": 1.0},
        {"scale_weight": 2e4},
        {"lmbda": 0.5},
        {"lmbda": 0.5, "rate": "elements"},
        {"lmbda": 0.5, "phases": Phases(symbols=0.0)},
    ],
    ids=str,
)
def test_the_loss_of_a_step_is_its_formula(
    blob_scene: Scene, tiny_config: Config, settings: dict[str, object]
) -> None:
    config = with_training(tiny_config, **{**CERTAIN, **settings})
    trainer = started(blob_scene, config)
    t = config.training
    l1, similarity, volume, bits = parts_of_loss(trainer, trainer.scene.train_views[2])
    # of this model's streams: one hyperprior channel a primitive, 4 primitives of 8 residual channels
    elements = {"reference_hyper": config.entropy.reference_hyper_dim, "reference": 8, "covariance": 6}
    elements |= {"residual_hyper": 4, "residual": 32}
    if t.rate == "elements":
        rate = sum(bits[name] / elements[name] for name in elements)
    else:
        rate = 5 / 132 * sum(bits.values())
    distortion = (1 - t.ssim_weight) * l1 + t.ssim_weight * (1 - similarity) + t.scale_weight * volume
    counted = t.lmbda * rate if t.borders.rate == 0 else 0.0
    assert float(trainer.train_step().loss) == pytest.approx(distortion + counted, rel=1e-3)
    if "scale_weight" in settings:
        assert t.scale_weight * volume > 0.1 * distortion
    if "lmbda" in settings:
        assert counted == 0 or counted > distortion


def test_the_rate_joins_the_loss_and_symbols_take_the_place_of_noise_at_their_shares_of_the_run(
    blob_scene: Scene, tiny_config: Config
) -> None:
    config = with_training(
        tiny_config, **{**CERTAIN, "phases": Phases(rate=0.25, symbols=0.5), "lmbda": 10.0}
    )
    found = {}
    for step in (4, 5, 9, 10):
        trainer = started(blob_scene, config, step)
        l1, similarity, _, bits = parts_of_loss(trainer, trainer.scene.train_views[2])
        symbols = 10.0 * 5 / 132 * sum(bits.values())
        rate = float(trainer.train_step().loss) - distortion_of(trainer, l1, similarity)
        found[step] = rate / symbols
    assert abs(found[4]) < 0.01
    assert found[10] == pytest.approx(1, abs=1e-3)
    for step in (5, 9):
        assert abs(found[step] - 1) > 0.002, "noise is not the symbols"
        assert found[step] == pytest.approx(1, abs=0.3), "but costs about as much"


def test_the_rate_pulls_at_references_in_proportion_to_lambda(blob_scene: Scene, tiny_config: Config) -> None:
    pulls = []
    for lmbda in (0.0, 1.0, 3.0):
        trainer = started(blob_scene, with_training(tiny_config, **CERTAIN))
        trainer.rate = RateState(lmbda)
        seen: list[torch.Tensor] = []

        def keep(trainer: Trainer = trainer, seen: list[torch.Tensor] = seen) -> None:
            assert trainer.model.references.grad is not None
            seen.append(trainer.model.references.grad.clone())

        trainer.move = keep  # type: ignore[method-assign]
        trainer.train_step()
        pulls += seen
    one, three = pulls[1] - pulls[0], pulls[2] - pulls[0]
    assert one.abs().max() > 0.1 * pulls[0].abs().max()
    assert torch.allclose(three, 3 * one, rtol=1e-3, atol=1e-4 * float(three.abs().max()))


def test_hidden_anchors_are_passed_over_once_the_rate_has_joined_where_it_is_not_counted(
    tiny_config: Config, blob_scene: Scene
) -> None:
    config = with_training(tiny_config, **{**CERTAIN, "phases": Phases(rate=0.5)})
    trainer = started(blob_scene, config)
    plan, t = replace(trainer.plan, rate_every=4), config.training
    moments = [moment(step, 1.0, t, plan, watched=False) for step in range(t.steps)]
    half = t.steps // 2
    assert not any(each.passes_over for each in moments[:half])
    assert all(each.passes_over == (each.rate_weight == 0) for each in moments[half:])
    assert any(each.passes_over for each in moments[half:])


def test_lambda_that_follows_a_size_is_the_one_that_weighs(blob_scene: Scene, tiny_config: Config) -> None:
    losses = []
    for lmbda in (0.0, 1.0, 3.0):
        trainer = started(blob_scene, with_training(tiny_config, **CERTAIN))
        trainer.rate = RateState(lmbda)
        losses.append(float(trainer.train_step().loss))
    assert losses[2] - losses[0] == pytest.approx(3 * (losses[1] - losses[0]), rel=1e-4)


@pytest.mark.parametrize(("schedule", "variant"), [("cosine", "default"), ("exponential", "published")])
@pytest.mark.parametrize(("step", "warm_up"), [(0, 0.5), (5, 0.5), (15, 0.5), (5, 0.0)])
def test_learning_rates_are_those_of_the_settings_at_this_step(
    blob_scene: Scene, tiny_config: Config, schedule: str, variant: str, step: int, warm_up: float
) -> None:
    phases = CERTAIN["phases"]._replace(warm=warm_up)
    changes = {"schedule": schedule, "phases": phases, "head_lr": 0.5}
    config = with_training(tiny_config, **{**CERTAIN, **changes})
    config = replace(config, control=replace(config.control, variant=variant))
    longer = 30_000 / STEPS if variant == "published" else 1
    t, progress = config.training, step / STEPS
    trainer = started(blob_scene, config, step)
    trainer.train_step()
    rising = min(1.0, 0.01 + progress / warm_up) if warm_up else 1.0
    of_group = {
        "log_scales": (t.log_scale_lr, 1.0),
        "references": (t.embedding_lr, 1.0),
        "residuals": (t.embedding_lr, 1.0),
        "entropy": (tuple(longer * rate for rate in t.entropy_lr), 1.0),
        "geometry": ((2e-3, 2e-5), rising),
        "appearance": ((4e-3, 4e-5), rising),
    }
    assert {group["name"] for group in trainer.optimizer.param_groups} == set(of_group)
    for group in trainer.optimizer.param_groups:
        (first, last), factor = of_group[group["name"]]
        if schedule == "cosine":
            expected = last + (first - last) * (1 + math.cos(math.pi * progress)) / 2
        else:
            expected = first ** (1 - progress) * last**progress
        assert group["lr"] == pytest.approx(factor * expected), group["name"]


def test_adam_moves_anchors_out_of_view_on(blob_scene: Scene, tiny_config: Config) -> None:
    """After a view of everything comes one of its middle, through a long lens."""
    whole, other = blob_scene.train_views[:2]
    narrow = replace(other, camera=replace(other.camera, fx=400.0, fy=400.0))
    scene = replace(blob_scene, train_views=(whole, narrow))
    trainer = started(scene, with_training(tiny_config, **CERTAIN))
    trainer.views.order = [1, 0]
    model = trainer.model
    with torch.no_grad():
        model.log_scales -= 2.0  # so that they reach less far
    trainer.train_step()
    unseen = torch.ones(model.anchors, dtype=torch.bool)
    unseen[trainer.survey.visible_anchors(narrow.camera)] = False
    assert 0 < unseen.sum() < model.anchors
    before = {name: getattr(model, name).detach().clone() for name in model.anchor_parameters}
    trainer.train_step()
    for name, old in before.items():
        new = getattr(model, name).detach()
        assert not torch.equal(new[unseen], old[unseen]), name
        assert not torch.equal(new[~unseen], old[~unseen]), name


def test_in_the_last_steps_the_image_is_that_of_the_weights_as_they_will_be_stored(
    blob_scene: Scene, tiny_config: Config
) -> None:
    config = with_training(tiny_config, **{**CERTAIN, "phases": CERTAIN["phases"]._replace(weights=0.5)})
    config = replace(config, entropy=replace(config.entropy, head_bits=6))
    for step, stored in ((9, False), (10, True)):
        trainer = started(blob_scene, config, step)
        camera = trainer.scene.train_views[2].camera
        expected = {
            kind: torch.as_tensor(render(trainer.model.as_hybrid_model(stored_weights=kind), camera).image)
            for kind in (False, True)
        }
        image = trainer.train_step().image
        assert (image - expected[stored]).abs().mean() < 1e-4
        assert (image - expected[not stored]).abs().mean() > 1e-3


def test_where_views_are_few_a_step_does_without_some_primitives(
    blob_scene: Scene, tiny_config: Config
) -> None:
    images = {}
    for share in (0.0, 0.4):
        trainer = started(blob_scene, with_training(tiny_config, **CERTAIN))
        trainer.gradients.plan = replace(trainer.plan, dropout=share)
        view = trainer.scene.train_views[2]
        complete = torch.as_tensor(
            render(trainer.model.as_hybrid_model(stored_weights=False), view.camera).image
        )
        images[share] = float((trainer.train_step().image - complete).abs().mean())
    assert images[0.0] < 1e-4 < 1e-2 < images[0.4]


def test_views_come_once_each_before_any_comes_again(blob_scene: Scene, tiny_config: Config) -> None:
    trainer = Trainer(blob_scene, with_training(tiny_config, steps=16), CPU)
    shown = []
    for _ in range(16):
        photograph = trainer.train_step().photograph.image.numpy()
        shown += [i for i, v in enumerate(blob_scene.train_views) if (v.image == photograph).all()]
    assert sorted(shown[:8]) == sorted(shown[8:]) == list(range(8))
    assert shown[:8] != shown[8:]


def test_the_rate_is_in_the_loss_of_every_few_steps_as_many_times(
    blob_scene: Scene, tiny_config: Config
) -> None:
    found = {}
    for every in (1, 3):
        config = with_training(tiny_config, **{**CERTAIN, "lmbda": 10.0})
        for step in (2, 3, 4):
            trainer = started(blob_scene, config, step)
            trainer.plan = replace(trainer.plan, rate_every=every)
            l1, similarity, _, _ = parts_of_loss(trainer, trainer.scene.train_views[2])
            found[every, step] = float(trainer.train_step().loss) - distortion_of(trainer, l1, similarity)
    assert found[3, 3] == pytest.approx(3 * found[1, 3], rel=1e-3)
    assert found[1, 3] > 1
    for step in (2, 4):
        assert abs(found[3, step]) < 0.01 * found[1, step]
