"""What masks leave out is not learned: whatever stands there, a run ends in the same model."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from compgs.losses import Target
from compgs.scene.views import Scene
from compgs.training.run.status import TrainingStatus
from compgs.training.splats.trainer import SplatTrainer
from compgs.training.trainer import Trainer

CPU = torch.device("cpu")
BOX = (slice(8, 24), slice(12, 30))


def with_passer_by(scene: Scene, color: int) -> Scene:
    """In every second training view somebody stands in front, masked."""
    mask = np.ones((36, 48), dtype=bool)
    mask[BOX] = False
    views = []
    for i, view in enumerate(scene.train_views):
        if i % 2:
            image = view.image.copy()
            image[BOX] = color
            view = replace(view, pixels=image, counted=mask)
        views.append(view)
    return replace(scene, train_views=tuple(views))


@pytest.mark.parametrize("kind", [Trainer, SplatTrainer])
def test_masked_pixels_are_not_learned(blob_scene, tiny_config, kind):
    models, seen = [], []
    for color in (255, 7):
        trainer = kind(with_passer_by(blob_scene, color), tiny_config, CPU)
        statuses: list[TrainingStatus] = []
        trainer.run(None, statuses.append)
        model = trainer.model if kind is Trainer else trainer.parameters
        models.append(model.state_dict())
        seen.append([(status.loss, status.psnr) for status in statuses])
    assert seen[0] == seen[1]
    assert all(torch.equal(models[0][name], models[1][name]) for name in models[0])


def test_a_view_brings_its_mask_to_the_loss(blob_scene, tiny_config):
    trainer = Trainer(with_passer_by(blob_scene, 255), tiny_config, CPU)
    masks = [trainer.views.photograph(i).counted for i in range(len(trainer.views))]
    assert [mask is not None for mask in masks] == [False, True] * 4
    assert not masks[1][BOX].any() and masks[1].float().mean() > 0.8
    assert Target.from_image(blob_scene.train_views[0].image).counted is None
