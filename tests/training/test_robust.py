"""A robust training leaves out what is in one photograph alone, and nothing where nothing moves."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from compgs.losses import Target
from compgs.metrics import psnr, to_8bit
from compgs.render import render
from compgs.scene.views import Scene
from compgs.tensors import where
from compgs.training.splats.trainer import SplatTrainer
from compgs.training.step.robust import GRID, Robust, cells, pixels
from compgs.training.trainer import Trainer

CPU = torch.device("cpu")


def visited(scene: Scene) -> Scene:
    """Something green stands in every third training view, elsewhere in each."""
    views = []
    for number, view in enumerate(scene.train_views):
        image = view.image.copy()
        if number % 3 == 0:
            image[10:26, 8 + 3 * number : 20 + 3 * number] = (20, 230, 40)
        views.append(replace(view, pixels=image))
    return replace(scene, train_views=tuple(views))


def looks(robust: Robust, image: torch.Tensor, photograph: torch.Tensor, times: int) -> Target:
    target = Target(photograph)
    for _ in range(times):
        target = robust.trusted(0, image, Target(photograph))
        robust.learn(0.5, [0], robust.gradients([0]))
    return target


def test_what_differs_again_and_again_is_left_out_and_comes_back_when_it_does_not() -> None:
    chance = np.random.default_rng(0)
    image = torch.from_numpy(chance.uniform(0.2, 0.8, (96, 96, 3))).float()
    photograph = (image * 255).round().to(torch.uint8)
    there = photograph.clone()
    there[30:60, 40:70] = torch.tensor([255, 0, 255], dtype=torch.uint8)
    robust = Robust(3, CPU)
    counted = looks(robust, image, there, 4).counted
    assert counted is not None
    assert not counted[34:56, 44:66].any(), "all but its edge"
    assert counted[:26].all() and counted[64:].all() and counted[:, :36].all() and counted[:, 74:].all()
    assert looks(robust, image, photograph, 12).counted is None


def test_a_difference_that_is_everywhere_leaves_nothing_out() -> None:
    chance = np.random.default_rng(0)
    image = torch.from_numpy(chance.uniform(0.2, 0.8, (96, 96, 3))).float()
    other = torch.from_numpy(chance.integers(0, 255, (96, 96, 3), dtype=np.uint8))
    assert looks(Robust(3, CPU), image, other, 6).counted is None


@pytest.mark.parametrize("counts", ["all", "the left half", "what differs"])
def test_the_same_is_left_out_where_the_device_is_not_asked(
    monkeypatch: pytest.MonkeyPatch, counts: str
) -> None:
    chance = np.random.default_rng(0)
    image = torch.from_numpy(chance.uniform(0.2, 0.8, (96, 96, 3))).float()
    photograph = (image * 255).round().to(torch.uint8)
    photograph[30:60, 40:70] = torch.tensor([255, 0, 255], dtype=torch.uint8)
    mask = torch.zeros(96, 96, dtype=torch.bool)
    mask[:, :48], mask[34:56, 44:66] = counts == "the left half", counts == "what differs"
    target = Target(photograph, None if counts == "all" else mask)

    def counted(pays: bool) -> list[torch.Tensor]:
        monkeypatch.setattr(where, "choosing_pays", lambda device: pays)
        robust, found = Robust(3, CPU), []
        for _ in range(6):
            chosen = robust.trusted(0, image, target).counted
            found.append(torch.ones(96, 96, dtype=torch.bool) if chosen is None else chosen)
            robust.learn(0.5, [0], robust.gradients([0]))
        return found

    asked, not_asked = counted(True), counted(False)
    assert all(torch.equal(a, b) for a, b in zip(asked, not_asked, strict=True))
    # Where nothing else counts, what differs stays.
    assert asked[-1][34:56, 44:48].any() == (counts == "what differs")


def test_masked_pixels_say_nothing_of_their_cell() -> None:
    difference, counted = torch.full((96, 96), 0.1), torch.ones(96, 96, dtype=torch.bool)
    difference[:, :49], counted[:, :49] = 9.0, False
    found = cells(difference, counted)
    torch.testing.assert_close(found[:, 25:], torch.full((GRID, GRID - 25), 0.1))
    assert found[:, :24].abs().max() == 0


def test_pixels_are_those_of_their_cells() -> None:
    chosen = torch.zeros(GRID, GRID, dtype=torch.bool)
    chosen[0, -1] = True
    found = pixels(chosen, 2 * GRID, 3 * GRID)
    assert found[:2, -3:].all() and found.sum() == 6


@pytest.mark.parametrize("kind", [Trainer, SplatTrainer])
def test_a_run_that_is_robust_continues_exactly(blob_scene, tiny_config, tmp_path, kind) -> None:
    scene = visited(blob_scene)
    config = replace(tiny_config, training=replace(tiny_config.training, robust=True))
    whole = kind(scene, config, CPU)
    whole.run(None, None)
    first = kind(scene, config, CPU)
    for _ in range(17):
        first.train_step()
    first.save(tmp_path / "checkpoint.safetensors")
    second = kind.resumed(scene, tmp_path / "checkpoint.safetensors", config, CPU)
    second.run(None, None)
    for name, value in whole.views.tensors().items():
        assert torch.equal(value, second.views.tensors()[name])
    assert whole.views.tensors()["robust/looks"].sum() == 40


def test_held_out_views_are_better_where_something_stood_in_the_way(
    blob_scene, blob_view, tiny_config
) -> None:
    scene = visited(replace(blob_scene, test_views=tuple(blob_view(i + 0.5) for i in range(1, 8))))
    quality = {}
    for robust in (False, True):
        training = replace(tiny_config.training, steps=200, lmbda=0.0, robust=robust)
        trainer = Trainer(scene, replace(tiny_config, training=training), CPU)
        trainer.run(None, None)
        model = trainer.model.as_hybrid_model()
        pairs = [(to_8bit(render(model, view.camera).image), view.image) for view in scene.test_views]
        quality[robust] = np.mean([psnr(rendering, photograph) for rendering, photograph in pairs])
    assert quality[True] > quality[False] + 0.3
