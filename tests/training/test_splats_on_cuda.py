"""Plain 3DGS on CUDA: the same code, with torch's harmonics and gsplat's rasterizer."""

import pytest
import torch

from compgs.config import Config, TrainingConfig
from compgs.tensors.spherical_harmonics import view_colors
from compgs.training import SplatTrainer

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device"),
]
CUDA = torch.device("cuda")


def test_colors_are_those_of_the_cpu():
    g = torch.Generator().manual_seed(0)
    means, dc, rest = (torch.randn(*shape, generator=g) for shape in ((500, 3), (500, 3), (500, 15, 3)))
    center = torch.tensor([0.1, 0.2, 0.3])
    here = view_colors(means, dc, rest, center, 3)
    there = view_colors(means.cuda(), dc.cuda(), rest.cuda(), center.cuda(), 3)
    assert torch.allclose(here, there.cpu(), atol=1e-5)


def test_a_run_grows_lowers_its_loss_and_can_be_continued(blob_scene, tmp_path):
    config = Config(training=TrainingConfig(steps=200, seed=0))
    trainer = SplatTrainer(blob_scene, config, CUDA)
    losses = [trainer.train_step().loss for _ in range(100)]
    assert sum(losses[-10:]) < 0.5 * sum(losses[:10])
    trainer.save(tmp_path / "checkpoint.safetensors")
    second = SplatTrainer.resumed(blob_scene, tmp_path / "checkpoint.safetensors", config, CUDA)
    second.run(None, None)
    assert second.step == 200
    assert all(torch.isfinite(p).all() for p in second.parameters.parameters())
