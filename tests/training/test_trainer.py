from dataclasses import replace

import numpy as np
import pytest
import torch

from compgs.config import Phases
from compgs.entropy import EntropyModel
from compgs.errors import ConfigError, TrainingError
from compgs.gaussians import Gaussians
from compgs.metrics import psnr, to_8bit
from compgs.render import RasterSettings, render
from compgs.scene.views import View
from compgs.tensors.rasterize import rasterize
from compgs.training import train
from compgs.training.structure.importance import worth_keeping
from compgs.training.trainer import Trainer

CPU = torch.device("cpu")


def test_the_same_seed_gives_the_same_model_and_another_seed_another(blob_scene, tiny_config):
    short = replace(tiny_config, training=replace(tiny_config.training, steps=12))
    first, second = train(blob_scene, short), train(blob_scene, short)
    for name, value in first.state_dict().items():
        assert torch.equal(value, second.state_dict()[name]), name
    other = train(blob_scene, replace(short, training=replace(short.training, seed=4)))
    assert not torch.equal(first.references, other.references[: len(first.references)])


def test_training_lowers_the_loss(blob_scene, tiny_config):
    longer = replace(tiny_config, training=replace(tiny_config.training, steps=120))
    trainer = Trainer(blob_scene, longer, CPU)
    losses = [trainer.train_step().loss for _ in range(120)]
    assert sum(losses[-10:]) < 0.6 * sum(losses[:10])


@pytest.mark.parametrize(
    ("layout", "normalization", "residuals", "blocks"),
    [
        ("paired", "bits", True, 0),
        ("paired", "bits", False, 0),
        ("paired", "bits", False, 1),
        ("separate", "elements", True, 2),
        ("separate", "bits", True, 0),
    ],
)
def test_every_layout_and_rate_trains_all_parameters(
    blob_scene, tiny_config, layout, normalization, residuals, blocks
):
    config = replace(
        tiny_config,
        model=replace(tiny_config.model, heads=layout, residuals=residuals),
        entropy=replace(tiny_config.entropy, network_blocks=blocks),
        training=replace(tiny_config.training, steps=20, rate=normalization),
    )
    trainer = Trainer(blob_scene, config, CPU)
    with torch.no_grad():  # references start at zero, where their hyperprior says nothing
        trainer.model.references.normal_(0, 5, generator=torch.Generator().manual_seed(0))
    before = {name: p.detach().clone() for name, p in trainer.model.named_parameters()}
    for _ in range(6):
        trainer.train_step()
    still = [
        name
        for name, p in trainer.model.named_parameters()
        if p.shape == before[name].shape and torch.equal(p, before[name])
    ]
    # With so few anchors there is one range, and no neighbour is known.
    assert still == ["entropy.neighbour_network.follow", "entropy.neighbour_network.weights.0"]


def test_a_higher_lambda_spends_fewer_bits(blob_scene, tiny_config):
    bits = []
    for lmbda in (0.0, 0.02):
        config = replace(tiny_config, training=replace(tiny_config.training, steps=120, lmbda=lmbda))
        bits.append(sum(train(blob_scene, config).estimated_bits().values()))
    assert bits[1] < 0.8 * bits[0]


def test_primitives_that_no_view_sees_are_dropped_at_the_end(blob_scene, tiny_config):
    config = replace(
        tiny_config,
        control=replace(tiny_config.control, prune_at=()),
        training=replace(tiny_config.training, steps=2),
    )
    trainer = Trainer(blob_scene, config, CPU)
    hidden = torch.zeros(trainer.model.anchors, dtype=torch.bool)
    hidden[::5] = True
    trainer.model.coordinates[hidden, 2] += 10_000  # far above all cameras
    trainer.run(None, None)
    mask = trainer.model.mask
    assert not mask[hidden].any()
    assert mask[~hidden].any(1).float().mean() > 0.7
    hybrid = trainer.model.as_hybrid_model()
    assert hybrid.coupled == int(mask.sum())
    assert hybrid.primitives.positions.shape == (trainer.model.anchors, 3)


def test_one_object_on_white_does_not_vanish(blob_scene, tiny_config):
    """Most pixels ask for less: without care all opacities fall, or all colors turn white, and nothing comes back."""
    g = torch.Generator().manual_seed(0)
    ball = torch.nn.functional.normalize(torch.randn(60, 3, generator=g), dim=1) * 0.35
    gaussians = Gaussians(
        ball, torch.tensor([[1.0, 0, 0, 0]]).repeat(60, 1), torch.full((60, 3), 0.1), torch.full((60,), 0.95),
        torch.tensor([0.1, 0.3, 0.8]).repeat(60, 1),
    )  # fmt: skip
    white = RasterSettings(background=(1.0, 1.0, 1.0))
    views = tuple(
        replace(
            v, pixels=(rasterize(gaussians, v.camera, white).image.clamp(0, 1) * 255).to(torch.uint8).numpy()
        )
        for v in blob_scene.train_views
    )
    scene = replace(blob_scene, train_views=views, background=(1.0, 1.0, 1.0))
    config = replace(tiny_config, training=replace(tiny_config.training, steps=200))
    trainer = Trainer(scene, config, CPU)
    trainer.run(None, None)
    model = trainer.model.as_hybrid_model()
    for view in views[:3]:
        assert psnr(to_8bit(render(model, view.camera).image), view.image) > 3 + psnr(
            np.full_like(view.image, 255), view.image
        )


def away(view: View) -> View:
    """The same view from a camera far off that has turned its back on the scene."""
    turned = np.diag([-1.0, 1.0, -1.0, 1.0]) @ view.camera.world_to_camera
    turned[2, 3] -= 100.0
    return replace(view, camera=replace(view.camera, world_to_camera=turned))


def test_a_view_that_no_anchor_is_in_is_passed_over(blob_scene, tiny_config):
    first, *rest = blob_scene.train_views
    model = train(replace(blob_scene, train_views=(away(first), *rest)), tiny_config)
    assert torch.isfinite(model.references).all()


def test_views_that_all_look_elsewhere_are_an_error_before_any_step(blob_scene, tiny_config):
    scene = replace(blob_scene, train_views=tuple(away(view) for view in blob_scene.train_views))
    with pytest.raises(TrainingError, match="poses"):
        train(scene, tiny_config)


def test_progress_tells_the_quality_of_the_view_that_was_trained_on(blob_scene, tiny_config, monkeypatch):
    trainer = Trainer(blob_scene, tiny_config, CPU)
    results, step, told = [], trainer.train_step, []
    monkeypatch.setattr(trainer, "train_step", lambda: results.append(step()) or results[-1])

    def tell(status):
        result = results[-1]
        error = result.image.clamp(0, 1).double() - result.photograph.image.double() / 255
        told.append((status.psnr, -10 * float(error.square().mean().log10())))
        assert status.loss == pytest.approx(float(result.loss))

    trainer.run(None, tell)
    assert len(told) == 4
    for found, expected in told:
        assert found == pytest.approx(expected, abs=1e-3)


def test_no_training_views_is_a_settings_error(blob_scene, tiny_config):
    with pytest.raises(ConfigError, match="no training views"):
        train(replace(blob_scene, train_views=()), tiny_config)


def test_without_a_rate_term_only_the_statistics_learn_from_the_rate(blob_scene, tiny_config):
    """Latents go the same way whether the rate is counted or not; the entropy networks do not stand still."""
    config = replace(tiny_config, training=replace(tiny_config.training, steps=40, lmbda=0.0))
    never = replace(config, training=replace(config.training, phases=Phases(rate=1.0)))
    counted, not_counted = Trainer(blob_scene, config, CPU), Trainer(blob_scene, never, CPU)
    for trainer in (counted, not_counted):
        trainer.noise = torch.zeros_like  # drawing noise would change the order of the views
        before = trainer.model.entropy.covariance_network.weights[0].detach().clone()
        for _ in range(
            5
        ):  # the first steps: later, the means that are learned move the places of the rounding
            trainer.train_step()
        learned = not torch.equal(before, trainer.model.entropy.covariance_network.weights[0])
        assert learned == (trainer is counted)
    assert torch.equal(counted.model.references, not_counted.model.references)
    assert torch.equal(counted.model.residuals, not_counted.model.residuals)


def test_without_residual_embeddings_all_anchors_have_the_same_and_the_file_has_none(
    blob_scene, tiny_config, tmp_path
):
    from compgs.codec import decode, encode
    from compgs.codec.reader import file_info

    config = replace(
        tiny_config,
        model=replace(tiny_config.model, residuals=False),
        training=replace(tiny_config.training, steps=60),
    )
    trainer = Trainer(blob_scene, config, CPU)
    start = trainer.model.shared_residuals().detach().clone()
    trainer.run(None, None)
    shared = trainer.model.shared_residuals().detach()
    assert shared.shape == (config.model.coupled_primitives, config.model.residual_dim)
    assert not torch.equal(shared, start), "they learn"
    assert type(trainer.model.entropy) is EntropyModel
    encode(trainer.model, tmp_path / "a.cgs")
    names = [s.name for s in file_info((tmp_path / "a.cgs").read_bytes()).sections]
    assert not [name for name in names if name.startswith("residual")]
    # Each coupled primitive has the row of its slot: those of an anchor that are left keep their order.
    slots = torch.nonzero(trainer.model.mask[trainer.model.mask.any(1)])[:, 1]
    decoded = decode(tmp_path / "a.cgs").primitives.residuals
    assert len(decoded) == len(slots)
    assert len(np.unique(decoded, axis=0)) == len(slots.unique())
    assert all(np.abs(row - shared.numpy()).max(1).min() < 0.02 for row in decoded[:50])


def test_unquantized_latents_are_rendered_as_they_are(blob_scene, tiny_config):
    config = replace(tiny_config, entropy=replace(tiny_config.entropy, quantized=False))
    trainer = Trainer(blob_scene, config, CPU)
    trainer.run(None, None)
    model = trainer.model
    shown = model.as_hybrid_model(stored_weights=False).primitives
    kept = model.mask.view(-1)
    step = config.entropy.steps.reference
    assert np.array_equal(shown.references, model.references.detach() * step)
    flat = model.residuals.detach().view(len(kept), -1)
    assert np.array_equal(shown.residuals, flat[kept] * config.entropy.steps.residual)


def test_primitives_that_add_least_are_left_out_up_to_their_share():
    """Against a sum in exact order, on random contributions, some of them zero."""
    g = np.random.default_rng(0)
    for share in (0.0, 0.002, 0.3):
        contributions = g.exponential(1.0, 200) * (g.random(200) > 0.2)
        kept = worth_keeping(torch.from_numpy(contributions), share).numpy()
        assert contributions[~kept].sum() <= share * contributions.sum() + 1e-9
        smallest = contributions[kept].min()
        assert (contributions[~kept] <= smallest).all()
        assert contributions[~kept].sum() + smallest > share * contributions.sum()
        assert not kept[contributions == 0].any()
