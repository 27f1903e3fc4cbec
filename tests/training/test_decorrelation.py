"""References in their principal axes: the same scene, fewer bits."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from compgs.codec import decode, encode
from compgs.config import Config, load_config
from compgs.scene.views import Scene
from compgs.training.structure import events
from compgs.training.structure.decorrelation import (
    channel_rates,
    decorrelate,
    drop_silent_channels,
    keep_channels,
    principal_axes,
)
from compgs.training.survey import predict_view
from compgs.training.trainer import Trainer

CPU = torch.device("cpu")
MOMENTS = ("exp_avg", "exp_avg_sq")


def trained(
    scene: Scene, config: Config, steps: int = 12, context: str = "hyperprior", **entropy: object
) -> Trainer:
    """A short run without turns and prunings, on latents whose channels have much in common."""
    config = replace(
        config,
        model=replace(config.model, reference_context=context),
        entropy=replace(config.entropy, decorrelate_at=(), **entropy),
        control=replace(config.control, prune_at=()),
    )
    trainer = Trainer(scene, config, CPU)
    references = trainer.model.references
    generator = torch.Generator().manual_seed(5)
    channels = references.shape[1]
    mixing = torch.randn(3, channels, generator=generator)
    with torch.no_grad():
        references += torch.randn(len(references), 3, generator=generator) @ mixing * 3
    for _ in range(steps):
        trainer.train_step()
    return trainer


def predicted(trainer: Trainer) -> tuple[torch.Tensor, ...]:
    view = trainer.scene.train_views[2]
    rows = trainer.survey.visible_anchors(view.camera)
    latents = trainer.model.quantized(rows, stored_weights=False)
    prediction = predict_view(trainer.model, latents, rows, view.camera, stored=False)
    g = prediction.gaussians
    return g.means, g.scales, g.opacities, g.colors


@pytest.mark.parametrize("heads", ["paired", "separate", "shallow"])
@pytest.mark.parametrize(("residuals", "context"), [(True, "hyperprior"), (False, "neighbours")])
def test_without_rounding_the_scene_stays_the_same(
    blob_scene: Scene, tiny_config: Config, heads: str, residuals: bool, context: str
) -> None:
    model = replace(tiny_config.model, heads=heads, residuals=residuals)
    trainer = trained(blob_scene, replace(tiny_config, model=model), context=context, quantized=False)
    before = predicted(trainer)
    was = trainer.model.references.detach().clone()
    decorrelate(trainer.model, trainer.optimizer)
    assert not torch.allclose(trainer.model.references, was, atol=0.1)
    for old, new in zip(before, predicted(trainer), strict=True):
        torch.testing.assert_close(new, old, atol=2e-4, rtol=2e-4)


def test_what_the_entropy_model_expects_turns_with_the_references(
    blob_scene: Scene, tiny_config: Config
) -> None:
    """Means of references, covariances and residuals from unrounded contexts: of covariances and residuals the same
    numbers, of references the same vectors in other axes.
    """
    trainer = trained(blob_scene, tiny_config)
    model, entropy = trainer.model, trainer.model.entropy

    def expected() -> tuple[torch.Tensor, ...]:
        z = entropy.reference_context.analysis(model.references)
        hyper = torch.ones(model.anchors, trainer.config.model.coupled_primitives)
        return (
            entropy.reference_network(z)[0],
            z,
            *entropy.covariance_network(model.references),
            *entropy.residual_network(torch.cat([model.references, hyper], 1)),
        )

    with torch.no_grad():
        before = expected()
        axes = principal_axes(model.references)
        decorrelate(model, trainer.optimizer)
        after = expected()
    torch.testing.assert_close(after[0], before[0] @ axes, atol=1e-3, rtol=1e-3)
    for old, new in zip(before[1:], after[1:], strict=True):
        torch.testing.assert_close(new, old, atol=1e-3, rtol=1e-3)


def test_channels_are_uncorrelated_afterwards_and_the_largest_come_first(
    blob_scene: Scene, tiny_config: Config
) -> None:
    trainer = trained(blob_scene, tiny_config)
    before = np.cov(trainer.model.references.detach().double().numpy().T)
    decorrelate(trainer.model, trainer.optimizer)
    after = np.cov(trainer.model.references.detach().double().numpy().T)
    variances = np.diag(after)
    assert np.abs(before - np.diag(np.diag(before))).max() > 1
    assert np.abs(after - np.diag(variances)).max() < 1e-4 * variances.max()
    assert (np.diff(variances) <= 1e-6).all()
    np.testing.assert_allclose(variances.sum(), np.trace(before), rtol=1e-5)


@pytest.mark.parametrize("context", ["hyperprior", "neighbours", "none"])
def test_correlated_references_take_fewer_bits_in_their_axes(
    blob_scene: Scene, tiny_config: Config, context: str
) -> None:
    trainer = trained(blob_scene, tiny_config, context=context)
    model = trainer.model
    model.entropy.restart_reference_scales(model.references, model.around)
    before = model.estimated_bits()
    decorrelate(model, trainer.optimizer)
    after = model.estimated_bits()
    assert after["reference"] < 0.85 * before["reference"]
    assert after["covariance"] == pytest.approx(before["covariance"], rel=0.02)


def uncorrelated(trainer: Trainer, spreads: torch.Tensor) -> None:
    """Gives the references channels that have nothing in common, with these standard deviations [C]."""
    references = trainer.model.references
    chance = torch.Generator().manual_seed(2)
    columns = torch.randn(references.shape, generator=chance, dtype=torch.float64)
    columns = torch.linalg.qr(columns - columns.mean(0))[0] * len(references) ** 0.5
    with torch.no_grad():
        references.copy_(columns * spreads)


def test_where_axes_only_change_places_moments_go_along(blob_scene: Scene, tiny_config: Config) -> None:
    trainer = trained(blob_scene, tiny_config)
    spreads = torch.tensor([2.0, 9.0, 1.0, 5.0, 7.0, 3.0, 8.0, 4.0])
    uncorrelated(trainer, spreads)
    order = spreads.argsort(descending=True)
    before = {name: trainer.optimizer.state[trainer.model.references][name] for name in MOMENTS}
    expected = {name: value[:, order].clone() for name, value in before.items()}
    decorrelate(trainer.model, trainer.optimizer)
    after = trainer.optimizer.state[trainer.model.references]
    for name in MOMENTS:
        assert expected[name].any()
        largest = float(expected[name].abs().max())
        torch.testing.assert_close(after[name].abs(), expected[name].abs(), atol=1e-3 * largest, rtol=1e-3)


def test_scales_that_start_anew_have_no_momentum(blob_scene: Scene, tiny_config: Config) -> None:
    trainer = trained(blob_scene, tiny_config)
    network, c = trainer.model.entropy.reference_network, trainer.model.reference_dim
    for parameter in (network.weights[-1], network.biases[-1]):
        assert trainer.optimizer.state[parameter]["exp_avg"][c:].any()
    decorrelate(trainer.model, trainer.optimizer)
    for parameter in (network.weights[-1], network.biases[-1]):
        moment = trainer.optimizer.state[parameter]["exp_avg"]
        assert not moment[c:].any()
        assert moment[:c].any()


def test_channels_go_that_spread_over_less_than_three_tenths_of_a_step(
    blob_scene: Scene, tiny_config: Config
) -> None:
    trainer = trained(blob_scene, tiny_config, steps=1)
    uncorrelated(trainer, torch.tensor([0.29, 9.0, 1.0, 0.31, 0.1, 3.0, 8.0, 4.0]))
    left = trainer.model.references.detach()[:, [1, 2, 3, 5, 6, 7]].clone()
    drop_silent_channels(trainer.model, trainer.optimizer)
    assert torch.equal(trainer.model.references.detach(), left)


def test_channels_go_at_the_last_turn_alone_and_rates_follow_at_each(
    blob_scene: Scene, tiny_config: Config
) -> None:
    config = replace(tiny_config, entropy=replace(tiny_config.entropy, decorrelate_at=(0.2, 0.5)))
    for step, channels in ((8, 8), (20, 6)):
        trainer = Trainer(blob_scene, config, CPU)
        uncorrelated(trainer, torch.tensor([0.1, 9.0, 1.0, 0.2, 5.0, 3.0, 8.0, 4.0]))
        trainer.step = step
        trainer.structure.turn_references(trainer.step, trainer.rate)
        assert trainer.model.reference_dim == channels
        assert torch.equal(trainer.structure.channel_rates.values, channel_rates(trainer.model.references))


def test_a_step_with_momentum_does_not_care_when_the_axes_turn(
    blob_scene: Scene, tiny_config: Config
) -> None:
    trainer = trained(blob_scene, tiny_config)
    model, optimizer = trainer.model, trainer.optimizer
    axes = principal_axes(model.references)
    momentum = optimizer.state[model.references]["exp_avg"].clone()
    moved = (model.references - 0.1 * momentum) @ axes
    second = optimizer.state[model.references]["exp_avg_sq"].clone()
    decorrelate(model, optimizer)
    state = optimizer.state[model.references]
    torch.testing.assert_close(model.references - 0.1 * state["exp_avg"], moved, atol=1e-4, rtol=1e-4)
    assert (state["exp_avg_sq"] >= 0).all()
    torch.testing.assert_close(state["exp_avg_sq"].sum(1), second.sum(1), atol=1e-12, rtol=1e-4)


def test_learning_rates_follow_the_root_of_the_spread_down_to_a_limit() -> None:
    references = torch.randn(4000, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    references = references / references.std(0, correction=0) * torch.tensor([4.0, 1.0, 0.1])
    torch.testing.assert_close(channel_rates(references), torch.tensor([3.5, 1.75, 0.6]).double())


def test_each_channel_moves_as_far_as_its_rate_says(blob_scene: Scene, tiny_config: Config) -> None:
    plain, other = trained(blob_scene, tiny_config), trained(blob_scene, tiny_config)
    assert torch.equal(plain.model.references, other.model.references)
    before = plain.model.references.detach().clone()
    rates = torch.linspace(0.0, 3.5, before.shape[1])
    other.structure.channel_rates.values = rates
    plain.train_step()
    other.train_step()
    moved = plain.model.references.detach() - before
    assert moved.abs().max() > 1e-3
    torch.testing.assert_close(other.model.references.detach() - before, moved * rates, atol=2e-5, rtol=1e-4)


def test_fewer_anchors_than_channels_are_no_trouble(blob_scene: Scene, tiny_config: Config) -> None:
    trainer = trained(blob_scene, tiny_config)
    kept = torch.zeros(trainer.model.anchors, dtype=torch.bool)
    for anchors in (3, 1):
        kept[:] = False
        kept[:anchors] = True
        trainer.control.keep(trainer.model, trainer.optimizer, kept)
        decorrelate(trainer.model, trainer.optimizer)
        kept = kept[:anchors]
        assert torch.isfinite(trainer.model.references).all()
        assert np.isfinite(sum(trainer.model.estimated_bits().values()))


@pytest.mark.parametrize("heads", ["paired", "separate", "shallow"])
@pytest.mark.parametrize("residuals", [True, False])
def test_a_channel_that_is_the_same_everywhere_can_go_without_a_change(
    blob_scene: Scene, tiny_config: Config, heads: str, residuals: bool
) -> None:
    model = replace(tiny_config.model, heads=heads, residuals=residuals)
    trainer = trained(blob_scene, replace(tiny_config, model=model), quantized=False)
    with torch.no_grad():
        trainer.model.references[:, [2, 7]] = torch.tensor([1.7, -0.4])
    before = predicted(trainer)
    covariances = trainer.model.entropy.covariance_network(trainer.model.references)
    drop_silent_channels(trainer.model, trainer.optimizer)
    assert trainer.model.reference_dim == tiny_config.model.reference_dim - 2
    for old, new in zip(before, predicted(trainer), strict=True):
        torch.testing.assert_close(new, old, atol=2e-4, rtol=2e-4)
    for old, new in zip(
        covariances, trainer.model.entropy.covariance_network(trainer.model.references), strict=True
    ):
        torch.testing.assert_close(new, old, atol=1e-3, rtol=1e-3)
    trainer.train_step()  # Adam's moments fit, too, while graphs of the old shapes are still there


def test_a_file_of_fewer_channels_decodes_to_the_trained_latents(
    blob_scene: Scene, tiny_config: Config, tmp_path: Path
) -> None:
    trainer = trained(blob_scene, tiny_config, steps=20)
    with torch.no_grad():
        trainer.model.references[:, :3] = 0.2
    drop_silent_channels(trainer.model, trainer.optimizer)
    encode(trainer.model, tmp_path / "scene.cgs")
    decoded = decode(tmp_path / "scene.cgs").primitives.references
    expected = trainer.model.primitives(trainer.model.quantized()).references
    assert decoded.shape == expected.shape == (trainer.model.anchors, tiny_config.model.reference_dim - 3)
    np.testing.assert_allclose(np.sort(decoded, 0), np.sort(expected.detach(), 0), atol=1e-3, rtol=0)


def test_the_channels_that_stay_keep_their_means_and_scales(blob_scene: Scene, tiny_config: Config) -> None:
    """Of the references themselves: their network has the means of all channels, then all scales."""
    trainer = trained(blob_scene, tiny_config, steps=8)
    model, network = trainer.model, trainer.model.entropy.reference_network
    kept = torch.tensor([False, True, False, True, True, True, True, True])
    inputs = model.entropy.reference_context.outputs
    z = torch.randn(20, inputs, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        before = network(z)
        references = model.references.detach().clone()
        moments = trainer.optimizer.state[network.weights[-1]]["exp_avg"].clone()
        keep_channels(model, kept, trainer.optimizer)
        after = network(z)
    for old, new in zip(before, after, strict=True):
        torch.testing.assert_close(new, old[:, kept])
    assert torch.equal(model.references.detach(), references[:, kept])
    rows = torch.cat([kept, kept])
    assert torch.equal(trainer.optimizer.state[network.weights[-1]]["exp_avg"], moments[rows])


@pytest.mark.parametrize("heads", ["paired", "separate", "shallow"])
def test_with_fewer_channels_a_model_looks_in_memory_as_it_does_from_its_file(
    blob_scene: Scene, tiny_config: Config, tmp_path: Path, heads: str
) -> None:
    config = replace(tiny_config, model=replace(tiny_config.model, heads=heads))
    trainer = trained(blob_scene, config, steps=8)
    kept = torch.tensor([False, True, False, True, True, True, True, True])
    keep_channels(trainer.model, kept, trainer.optimizer)
    model = trainer.model.as_hybrid_model()
    assert model.heads.dimensions.reference == 6
    encode(trainer.model, tmp_path / "a.cgs")
    for mine, decoded in zip(model.geometry, decode(tmp_path / "a.cgs").geometry, strict=True):
        np.testing.assert_allclose(np.sort(mine, axis=0), np.sort(decoded, axis=0), rtol=1e-3, atol=1e-3)


def test_one_channel_stays_when_none_says_anything(blob_scene: Scene, tiny_config: Config) -> None:
    trainer = trained(blob_scene, tiny_config, steps=1)
    with torch.no_grad():
        trainer.model.references[:] = torch.linspace(0, 0.1, trainer.model.anchors)[:, None]
        trainer.model.references[:, 1] *= 2
    drop_silent_channels(trainer.model, trainer.optimizer)
    assert trainer.model.reference_dim == 1


def test_a_run_with_fewer_channels_continues_exactly(
    blob_scene: Scene, tiny_config: Config, tmp_path: Path
) -> None:
    config = replace(tiny_config, entropy=replace(tiny_config.entropy, decorrelate_at=(0.2, 0.4)))

    def started() -> Trainer:
        trainer = Trainer(blob_scene, config, CPU)
        with torch.no_grad():
            trainer.model.references[:, 3:] = 0.0
        for group in trainer.optimizer.param_groups:
            if group["name"] == "references":
                group["rates"] = (1e-3, 1e-3)  # so that they stay nearly there
        return trainer

    whole = started()
    while whole.step < 24:
        whole.train_step()
    assert whole.model.reference_dim < config.model.reference_dim
    first = started()
    while first.step < 20:
        first.train_step()
    first.save(tmp_path / "checkpoint.safetensors")
    second = Trainer.resumed(blob_scene, tmp_path / "checkpoint.safetensors", config, CPU)
    for group in second.optimizer.param_groups:
        if group["name"] == "references":
            group["rates"] = (1e-3, 1e-3)
    while second.step < 24:
        second.train_step()
    for (name, old), new in zip(
        whole.model.state_dict().items(), second.model.state_dict().values(), strict=True
    ):
        assert torch.equal(old, new), name


def test_it_happens_at_the_steps_that_the_settings_name(
    blob_scene: Scene, tiny_config: Config, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = replace(tiny_config, entropy=replace(tiny_config.entropy, decorrelate_at=(0.2, 0.5)))
    trainer = Trainer(blob_scene, config, CPU)
    turned: list[int] = []
    monkeypatch.setattr(events, "decorrelate", lambda *_: turned.append(trainer.step))
    for _ in range(config.training.steps):
        trainer.train_step()
    assert turned == [8, 20]


def test_a_run_that_has_diverged_is_left_as_it_is(blob_scene: Scene, tiny_config: Config) -> None:
    trainer = Trainer(blob_scene, tiny_config, CPU)
    trainer.step = max(trainer.structure.decorrelated_at)
    with torch.no_grad():
        trainer.model.references[0, 0] = float("nan")
    before = trainer.model.references.detach().clone()
    trainer.structure.turn_references(trainer.step, trainer.rate)
    assert trainer.model.reference_dim == tiny_config.model.reference_dim
    assert torch.equal(trainer.model.references.nan_to_num(), before.nan_to_num())


def test_the_paper_preset_does_without() -> None:
    assert load_config("paper").entropy.decorrelate_at == ()
    assert load_config().entropy.decorrelate_at
