"""Photometry is learned beside the scene: what cameras are known to have done is found again, but for one change of all
colors.
"""

from dataclasses import replace

import numpy as np
import pytest
import torch

from compgs.losses import Target, as_taken, photometric_loss
from compgs.metrics import psnr, to_8bit
from compgs.model.splats import SplatModel
from compgs.render import render
from compgs.scene.views import Points, Scene
from compgs.training.splats.trainer import SplatTrainer
from compgs.training.step.photometry import Photometry, color_matrix, falloff, lenses, response
from compgs.training.step.photometry_start import starting_gains
from compgs.training.trainer import Trainer

CPU = torch.device("cpu")


def known_gains(views: int, seed: int = 0) -> np.ndarray:
    """[V, 3]: brightness and white balance of each; nothing gets brighter than white."""
    rng = np.random.default_rng(seed)
    return rng.uniform(0.5, 0.95, (views, 1)) * rng.uniform(0.85, 1.0, (views, 3))


def photographed(scene: Scene, gains: np.ndarray) -> Scene:
    views = []
    for view, gain in zip((*scene.train_views, *scene.test_views), gains, strict=True):
        views.append(replace(view, pixels=np.rint(view.image * gain).astype(np.uint8)))
    count = len(scene.train_views)
    return replace(scene, train_views=tuple(views[:count]), test_views=tuple(views[count:]))


def without_points(scene: Scene) -> Scene:
    """One whose photographs say nothing of one another before training."""
    return replace(scene, points=Points(np.zeros((0, 3)), np.zeros((0, 3), np.uint8)))


def learned_on(
    images: torch.Tensor, photometry: Photometry, photographs: list[torch.Tensor], steps: int
) -> None:
    """Compare known images [V, H, W, 3] with photographs of them, over and over."""
    for step in range(steps):
        view = step % len(photographs)
        loss = photometric_loss(
            images[view], Target(photographs[view], taken=photometry.taken(view)), ssim_weight=0.0
        )
        loss.backward()
        photometry.learn(step / steps, [view], photometry.gradients([view]))


def test_the_gains_that_were_put_in_are_found_again(blob_scene) -> None:
    chance = np.random.default_rng(1)
    images = torch.from_numpy(chance.uniform(0.1, 0.9, (8, 36, 48, 3))).float()
    gains = known_gains(8)
    photographs = [
        (image * torch.from_numpy(gain) * 255).round().to(torch.uint8)
        for image, gain in zip(images, gains, strict=True)
    ]
    photometry = Photometry(without_points(blob_scene), CPU)
    usual = np.exp(np.log(gains).mean(0))  # of the scene: what the gains have in common
    learned_on(images * torch.from_numpy(usual).float(), photometry, photographs, 1200)
    for view in range(8):
        found = color_matrix(photometry.photographs.values()[view]).numpy()
        np.testing.assert_allclose(found, np.diag(gains[view] / usual), atol=0.05)


def test_the_vignetting_that_was_put_in_is_found_again(blob_scene) -> None:
    chance = np.random.default_rng(1)
    images = torch.from_numpy(chance.uniform(0.2, 0.9, (8, 36, 48, 3))).float()
    down, across = np.mgrid[0:36, 0:48] + 0.5
    squares = ((across - 24) ** 2 + (down - 18) ** 2) / 30**2
    darker = torch.from_numpy(1 - 0.4 * squares**1.5)[..., None]
    photographs = [(image * darker * 255).round().to(torch.uint8) for image in images]
    photometry = Photometry(without_points(blob_scene), CPU)
    learned_on(images, photometry, photographs, 1200)
    (found,) = photometry.lenses.values()
    radius = torch.from_numpy(squares).float()[..., None]
    assert (falloff(found[:9], radius) - darker).abs().max() < 0.04
    assert (photometry.photographs.values().abs() < 0.03).all()


def test_two_lenses_of_other_response_are_told_apart(blob_scene) -> None:
    chance = np.random.default_rng(1)
    images = torch.from_numpy(chance.uniform(0.05, 0.95, (8, 36, 48, 3))).float()
    views = [
        replace(view, camera=replace(view.camera, fx=50.0 + number % 2))
        for number, view in enumerate(blob_scene.train_views)
    ]
    gammas = [0.85, 1.2]
    photographs = [
        (image ** gammas[number % 2] * 255).round().to(torch.uint8) for number, image in enumerate(images)
    ]
    photometry = Photometry(replace(without_points(blob_scene), train_views=tuple(views)), CPU)
    assert photometry.lens_of == [0, 1] * 4
    learned_on(images, photometry, photographs, 1200)
    for number, gamma in enumerate(gammas):
        taken = as_taken(images[number], Target(photographs[number], taken=photometry.taken(number))).detach()
        assert (taken - images[number] ** gamma).abs().mean() < 0.2 * (
            images[number] - images[number] ** gamma
        ).abs().mean()


def test_a_response_keeps_black_and_white() -> None:
    numbers = torch.tensor([0.3, -0.2, 0.1, 0.2, 0.1, -0.1])
    ends = torch.tensor([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0], [-0.1, 1.1, 2.0]])
    torch.testing.assert_close(response(ends, numbers), ends)


def test_before_the_first_step_a_camera_changes_nothing(blob_scene) -> None:
    image = torch.rand(36, 48, 3)
    photometry = Photometry(without_points(blob_scene), CPU)
    torch.testing.assert_close(photometry.taken(0)(image), image)
    assert as_taken(image, Target(image)) is image


def test_means_are_held_at_zero_whatever_is_learned(blob_scene) -> None:
    photometry = Photometry(without_points(blob_scene), CPU)
    image = torch.rand(36, 48, 3)
    for step in range(20):
        photometry.taken(step % 3)(image).sum().backward()
        photometry.learn(0.0, [step % 3], photometry.gradients([step % 3]))
    numbers = photometry.photographs.numbers
    assert numbers.abs().max() > 0.01
    torch.testing.assert_close(numbers.mean(0), torch.zeros(9), atol=1e-6, rtol=0)
    assert not photometry.lenses.values()[:, 9:].any(), "a single lens has no response"
    assert photometry.lenses.values()[:, :9].max() <= 0.0


def test_points_say_how_bright_each_photograph_is(blob_scene) -> None:
    gains = known_gains(9)
    found = starting_gains(photographed(blob_scene, gains))
    assert found is not None
    known = np.log2(gains[:8]) - np.log2(gains[:8]).mean(0)
    assert np.abs(found - known).max() < 0.25
    assert np.corrcoef(found.ravel(), known.ravel())[0, 1] > 0.95


def test_where_points_say_nothing_headers_do(blob_scene) -> None:
    views = [replace(view, light=float(stops)) for stops, view in enumerate(blob_scene.train_views)]
    found = starting_gains(replace(without_points(blob_scene), train_views=tuple(views)))
    np.testing.assert_allclose(found[:, 1], (np.arange(8) - 3.5).clip(-6.6, 6.6) / 2.2)
    assert starting_gains(without_points(blob_scene)) is None


def test_views_of_equal_cameras_share_a_lens_and_where_none_are_equal_those_of_one_size(blob_scene) -> None:
    views = blob_scene.train_views
    assert set(lenses(views)) == {0}
    own = [replace(v, camera=replace(v.camera, fx=50.0 + i)) for i, v in enumerate(views)]
    assert set(lenses(own)) == {0}
    turned = [*own[:4], *(replace(v, camera=replace(v.camera, width=36, height=48)) for v in own[4:])]
    assert lenses(turned) == [0] * 4 + [1] * 4


def trained(kind: type, scene: Scene, config) -> tuple:
    trainer = kind(scene, config, CPU)
    trainer.run(None, None)
    if kind is Trainer:
        return trainer, trainer.model.as_hybrid_model()
    return trainer, SplatModel(trainer.parameters.trained().arrays(), scene.background)


@pytest.mark.parametrize(("kind", "steps"), [(Trainer, 200), (SplatTrainer, 240)])
@pytest.mark.slow
def test_known_gains_are_recovered_beside_a_scene_and_photographs_are_met_better(
    blob_scene, tiny_config, kind, steps
) -> None:
    truth = known_gains(9, seed=2)
    scene = photographed(blob_scene, truth)
    quality = {}
    for exposure in (False, True):
        training = replace(tiny_config.training, steps=steps, lmbda=0.0, exposure=exposure)
        trainer, model = trained(kind, scene, replace(tiny_config, training=training))
        quality[exposure] = np.mean([met(trainer, model, i) for i in range(8)])
    assert quality[True] > quality[False] + 1.0
    # Gains of the views relative to one another: all of them together belong to the scene's colors. Eight views leave
    # some of each view's gain to colors that change with the direction.
    found = color_matrix_of_all(trainer.views.photometry)
    learned = np.log(found @ (0.5, 0.5, 0.5)).mean(1)
    known = np.log(truth[:8]).mean(1)
    assert np.corrcoef(learned, known)[0, 1] > 0.9
    assert 0.3 < np.polyfit(known, learned, 1)[0] < 1.2


def color_matrix_of_all(photometry: Photometry) -> np.ndarray:
    """[V, 3, 3]."""
    return np.stack([color_matrix(row).numpy() for row in photometry.photographs.values()])


def met(trainer, model, index: int) -> float:
    """PSNR of a training view, as its camera takes it."""
    view = trainer.views.views[index]
    image = torch.from_numpy(np.array(render(model, view.camera).image))
    taken = as_taken(image, trainer.views.photograph(index)).detach().numpy()
    return psnr(to_8bit(taken), view.image)


@pytest.mark.parametrize("kind", [Trainer, SplatTrainer])
def test_a_run_with_photometry_continues_exactly(blob_scene, tiny_config, tmp_path, kind) -> None:
    scene = photographed(blob_scene, known_gains(9))
    config = replace(tiny_config, training=replace(tiny_config.training, exposure=True))
    whole, _ = trained(kind, scene, config)
    first = kind(scene, config, CPU)
    for _ in range(17):
        first.train_step()
    first.save(tmp_path / "checkpoint.safetensors")
    second = kind.resumed(scene, tmp_path / "checkpoint.safetensors", config, CPU)
    second.run(None, None)
    for name, value in whole.views.tensors().items():
        assert torch.equal(value, second.views.tensors()[name])
    assert whole.views.tensors()["photometry/photographs/numbers"].any()
