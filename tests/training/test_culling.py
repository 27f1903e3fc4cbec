"""A training step looks at every anchor of which a decoder would draw something."""

from types import SimpleNamespace

import pytest
import torch

from compgs.model.constants import CUTOFF_SIGMAS
from compgs.tensors.prediction import camera_center, predict
from compgs.tensors.rasterize import rasterize
from compgs.tensors.visibility import visible_mask
from compgs.training.survey import EVERY, MARGIN, AnchorBounds
from compgs.training.trainer import Trainer

CPU = torch.device("cpu")


@pytest.fixture
def trained(blob_scene, tiny_config):
    trainer = Trainer(blob_scene, tiny_config, CPU)
    for _ in range(25):
        trainer.train_step()
    return trainer


def made():
    """Three anchors of two primitives: means one and two units from the anchor, of sizes 0.1 and 0.3."""
    model = SimpleNamespace(
        anchors=3,
        device=CPU,
        voxel_size=0.5,
        log_scales=torch.tensor([[0.0] * 6, [0.0] * 5 + [1.0], [2.0] + [0.0] * 5]),
        positions=lambda rows: torch.arange(9.0).view(3, 3)[rows],
    )
    calls = []

    def geometry(rows):
        calls.append(rows)
        offsets = torch.tensor([[0.0, 1.0, 0.0], [2.0, 0.0, 0.0]]).repeat(len(rows), 1)
        scales = torch.tensor([[0.1, 0.05, 0.01], [0.1, 0.3, 0.2]]).repeat(len(rows), 1)
        return model.positions(rows).repeat_interleave(2, 0) + offsets, scales

    return model, AnchorBounds(model, geometry), calls


def test_a_radius_reaches_to_the_end_of_what_is_drawn_and_a_margin_beyond():
    _, bounds, _ = made()
    assert bounds.radii().tolist() == pytest.approx([MARGIN * (2.0 + 0.3 * CUTOFF_SIGMAS)] * 3)


def test_radii_follow_the_anchors_sizes_and_are_measured_again_when_forgotten():
    model, bounds, calls = made()
    before = bounds.radii()
    model.log_scales = model.log_scales + torch.tensor([[0.0], [1.0], [0.0]])
    grown = bounds.radii() / before
    assert grown.tolist() == pytest.approx([1.0, torch.e, 1.0]) and len(calls) == 1
    bounds.forget()
    assert torch.allclose(bounds.radii(), before) and len(calls) == 2


def test_measurements_are_frequent_at_first():
    _, bounds, _ = made()
    forgotten = []
    for step in range(1, 3 * EVERY + 2):
        bounds.radii()
        bounds.after_step(step)
        forgotten += [step] if bounds.measured is None else []
    assert forgotten == [1, 2, 4, 8, 16, EVERY, 2 * EVERY, 3 * EVERY]


def test_nothing_that_a_decoder_draws_is_left_out(trained):
    centers, radii = map(torch.from_numpy, trained.model.as_hybrid_model(stored_weights=False).bounds)
    for view in trained.scene.train_views:
        drawn = visible_mask(centers, radii, view.camera, trained.settings)
        looked_at = torch.zeros_like(drawn)
        looked_at[trained.survey.visible_anchors(view.camera)] = True
        assert drawn.any() and looked_at[drawn].all()


def test_an_anchor_far_outside_whose_primitives_reach_into_the_view_is_looked_at(trained):
    camera = trained.scene.train_views[0].camera
    with torch.no_grad():
        trained.model.heads.geometry.output_bias[:3] += 4.0  # reaches
    trained.survey.bounds.forget()
    rows = trained.survey.visible_anchors(camera)
    everything = torch.arange(trained.model.anchors)
    images = []
    for chosen in (rows, everything):
        p = trained.model.primitives(trained.model.quantized(chosen, stored_weights=False), chosen)
        prediction = predict(trained.model.heads, p, camera_center(camera, CPU), trained.model.distance_unit)
        images.append(rasterize(prediction.gaussians, camera, trained.settings).image)
    assert torch.equal(*images) and images[0].std() > 0.02


def test_what_was_measured_goes_on_with_a_run(trained, blob_scene, tiny_config, tmp_path):
    trained.survey.visible_anchors(blob_scene.train_views[0].camera)
    trained.save(tmp_path / "a")
    again = Trainer.resumed(blob_scene, tmp_path / "a", tiny_config, CPU)
    assert torch.equal(again.survey.bounds.measured, trained.survey.bounds.measured)
    with torch.no_grad():
        again.model.log_scales.add_(1.0)
    assert torch.allclose(again.survey.bounds.radii(), torch.e * trained.survey.bounds.radii())


def test_what_was_measured_is_forgotten_when_anchors_are_pruned(trained):
    trained.survey.bounds.radii()
    assert trained.survey.bounds.measured is not None
    trained.structure.act(min(trained.structure.pruned_at), trained.rate)
    assert trained.survey.bounds.measured is None
