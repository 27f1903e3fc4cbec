"""Exposures of views are learned beside the scene: known ones are found again, but for one change of all colors."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from compgs.evaluation.exposure import exposed_by_left_half, right_half
from compgs.losses import Target, exposed, photometric_loss
from compgs.metrics import psnr, to_8bit
from compgs.model.splats import SplatModel
from compgs.render import render
from compgs.scene.views import Scene, View
from compgs.training.splats.trainer import SplatTrainer
from compgs.training.step.exposures import Exposures
from compgs.training.trainer import Trainer

CPU = torch.device("cpu")


def known_exposures(views: int, seed: int = 0) -> np.ndarray:
    """[V, 3, 4]: brightness and white balance of each, and a little haze; nothing gets brighter than white."""
    rng = np.random.default_rng(seed)
    gains = rng.uniform(0.5, 0.95, (views, 1)) * rng.uniform(0.85, 1.0, (views, 3))
    exposures = np.zeros((views, 3, 4))
    exposures[:, range(3), range(3)] = gains
    exposures[:, :, 3] = rng.uniform(0.0, 0.05, (views, 1))
    return exposures


def photographed(scene: Scene, exposures: np.ndarray) -> Scene:
    views = []
    for view, exposure in zip((*scene.train_views, *scene.test_views), exposures, strict=True):
        colors = view.image / 255.0 @ exposure[:, :3].T + exposure[:, 3]
        views.append(replace(view, pixels=np.rint(255 * np.clip(colors, 0, 1)).astype(np.uint8)))
    count = len(scene.train_views)
    return replace(scene, train_views=tuple(views[:count]), test_views=tuple(views[count:]))


def test_a_known_exposure_of_a_known_image_is_found() -> None:
    rng = np.random.default_rng(1)
    image = torch.from_numpy(rng.uniform(0.1, 0.9, (12, 16, 3))).float()
    truth = torch.from_numpy(known_exposures(2)).float()
    photographs = [(exposed(image, exposure) * 255).round().to(torch.uint8) for exposure in truth]
    exposures = Exposures(3, CPU)
    for step in range(300):
        view = step % 2
        photometric_loss(image, Target(photographs[view], exposure=exposures.of(view))).backward()
        exposures.learn(step / 300, [view], exposures.gradients([view]))
    found = exposures.neutral + exposures.change
    for view in range(2):
        difference = exposed(image, found[view]) - exposed(image, truth[view])
        assert difference.abs().mean() < 0.01
    assert not exposures.change[2].any()


def test_a_neutral_exposure_changes_nothing() -> None:
    image = torch.rand(4, 5, 3)
    torch.testing.assert_close(exposed(image, Exposures(1, CPU).of(0)), image)
    assert exposed(image, None) is image


def trained(kind: type, scene: Scene, config) -> tuple:
    trainer = kind(scene, config, CPU)
    trainer.run(None, None)
    if kind is Trainer:
        return trainer, trainer.model.as_hybrid_model()
    return trainer, SplatModel(trainer.parameters.trained().arrays(), scene.background)


@pytest.mark.parametrize(("kind", "steps"), [(Trainer, 200), (SplatTrainer, 240)])
def test_known_exposures_are_recovered_and_pay_on_held_out_views(
    blob_scene, blob_view, tiny_config, kind, steps
) -> None:
    # Halfway between the training views: one alone says little, differently on each processor.
    between = tuple(blob_view(i + 0.5) for i in range(1, 8))
    truth = known_exposures(15, seed=2)
    scene = photographed(replace(blob_scene, test_views=between), truth)
    quality = {}
    for exposure in (False, True):
        training = replace(tiny_config.training, steps=steps, lmbda=0.0, exposure=exposure)
        trainer, model = trained(kind, scene, replace(tiny_config, training=training))
        quality[exposure] = np.mean([of_right_half(model, view) for view in scene.test_views])
    assert quality[True] > quality[False] + 0.5  # 0.9 to 1.8 dB, as the processor rounds
    # Gains of the views relative to one another: all of them together belong to the scene's colors. Eight views leave
    # some of each view's gain to colors that change with the direction.
    found = (trainer.views.exposures.neutral + trainer.views.exposures.change).numpy()
    learned, known = (relative_gains(exposures) for exposures in (found, truth[:8]))
    assert np.corrcoef(learned, known)[0, 1] > 0.9
    assert 0.3 < np.polyfit(known, learned, 1)[0] < 1.2


def of_right_half(model, view: View) -> float:
    """PSNR, with the exposure that fits the left half."""
    rendering = exposed_by_left_half(to_8bit(render(model, view.camera).image), view.image, None)
    return psnr(right_half(rendering), right_half(view.image))


def relative_gains(exposures: np.ndarray) -> np.ndarray:
    """[V] logarithms of what views [V, 3, 4] make of middle gray, against their mean."""
    brightness = np.log((exposures @ (0.5, 0.5, 0.5, 1.0)).mean(1))
    return brightness - brightness.mean()


@pytest.mark.parametrize("kind", [Trainer, SplatTrainer])
def test_a_run_with_exposures_continues_exactly(blob_scene, tiny_config, tmp_path, kind) -> None:
    scene = photographed(blob_scene, known_exposures(9))
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
    assert whole.views.tensors()["exposure/change"].any()
