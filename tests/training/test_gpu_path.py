"""The GPU's path on a machine without one: a whole run by plain torch and a stand-in for gsplat's operators."""

from dataclasses import replace

import numpy as np
import pytest
import torch

import compgs
from compgs.cameras import Camera
from compgs.gaussians import Gaussians
from compgs.render.settings import DEFAULT_SETTINGS
from compgs.scene.views import View
from compgs.tensors import gsplat_backend, where
from compgs.tensors.reference import Splats, composite, project
from compgs.training.hybrid import train

from .rules import without


class StandIn:
    """gsplat's four operators with the shapes of version 1.5, by the reference renderer."""

    def __init__(self) -> None:
        self.drawings = 0
        self.depths = torch.empty(0)
        self.camera: Camera | None = None

    def fully_fused_projection(
        self, means, covariances, quaternions, scales, view, intrinsics, width, height, **o
    ):
        assert covariances is None and view.shape == (1, 4, 4) and intrinsics.shape == (1, 3, 3)
        k = intrinsics[0].double().numpy()
        pose = view[0].double().numpy()
        self.camera = Camera(pose, k[0, 0], k[1, 1], k[0, 2], k[1, 2], width, height)
        settings = replace(DEFAULT_SETTINGS, dilation=o["eps2d"], near_plane=o["near_plane"])
        opacities = o["opacities"]
        gaussians = Gaussians(means, quaternions, scales, opacities, means)
        splats = project(gaussians, self.camera, settings)
        spread = torch.sqrt(splats.covariances.diagonal(dim1=-2, dim2=-1).detach())
        radii = torch.where(splats.drawn[:, None], torch.ceil(3.33 * spread), 0.0).to(torch.int32)
        precisions = torch.linalg.inv(splats.covariances)
        conics = torch.stack([precisions[:, 0, 0], precisions[:, 0, 1], precisions[:, 1, 1]], 1)
        kept = splats.kept[None] if o["calc_compensations"] else None
        return radii[None], splats.means2d[None], splats.depths[None], conics[None], kept

    def isect_tiles(self, means2d, radii, depths, tile_size, columns, rows, packed):
        assert means2d.shape[:2] == radii.shape[:2] == depths.shape and tile_size == 16 and not packed
        self.depths, self.radii = depths[0], radii[0]
        return None, torch.zeros(1, dtype=torch.int64), torch.zeros(1, dtype=torch.int32)

    def isect_offset_encode(self, tiles, images, columns, rows):
        return torch.zeros(images, rows, columns, dtype=torch.int32)

    def rasterize_to_pixels(
        self, means2d, conics, colors, opacities, width, height, *rest, backgrounds, packed
    ):
        self.drawings += 1
        xx, xy, yy = conics[0].unbind(-1)
        covariances = torch.linalg.inv(torch.stack([xx, xy, xy, yy], -1).view(-1, 2, 2))
        drawn = (self.radii > 0).all(1)
        splats = Splats(means2d[0], covariances, torch.ones_like(xx), self.depths, drawn)
        gaussians = Gaussians(colors[0], conics[0], conics[0], opacities[0], colors[0])
        background = tuple(float(c) for c in backgrounds[0])
        settings = replace(DEFAULT_SETTINGS, background=background)
        image, through = composite(splats, gaussians, drawn, self.camera, settings)
        return image[None], (1 - through)[None, ..., None]


@pytest.fixture
def gpu_path(monkeypatch) -> StandIn:
    stand_in = StandIn()
    monkeypatch.setattr(where, "in_kernels", lambda *tensors: False)
    monkeypatch.setattr(where, "runs_in_kernels", lambda device, *dtypes: False)
    monkeypatch.setattr(where, "choosing_pays", lambda device: False)
    monkeypatch.setattr(where, "on_gpu", lambda tensor: True)
    monkeypatch.setattr(gsplat_backend, "load_gsplat", lambda: stand_in)
    return stand_in


@pytest.fixture(scope="module")
def few_pixels(blob_scene):
    """Half of the views, at half the width and height: plain torch draws slowly."""

    def smaller(view):
        return View(view.name, view.camera.resized(24, 18), np.ascontiguousarray(view.image[::2, ::2]))

    return replace(
        blob_scene,
        train_views=tuple(map(smaller, blob_scene.train_views[::2])),
        test_views=tuple(map(smaller, blob_scene.test_views)),
    )


def small(config, **training):
    return replace(config, training=replace(config.training, steps=10, **training))


def test_a_whole_run_on_the_gpus_path_writes_a_file_that_the_cpu_draws_alike(
    gpu_path, few_pixels, tiny_config, tmp_path, monkeypatch
):
    model = train(few_pixels, small(tiny_config), output=tmp_path / "run", device="cpu")
    drawn_there = np.asarray(compgs.render(model, few_pixels.test_views[0].camera).image)
    assert gpu_path.drawings > 10  # each step, and each view of growth and the end
    monkeypatch.undo()
    compgs.encode(model, tmp_path / "scene.cgs")
    decoded = compgs.decode(tmp_path / "scene.cgs")
    here = np.asarray(compgs.render(decoded, few_pixels.test_views[0].camera).image)
    assert np.sqrt(((here - drawn_there) ** 2).mean()) < 1e-3


def test_a_run_on_the_gpus_path_goes_on_as_if_it_had_not_stopped(gpu_path, few_pixels, tiny_config, tmp_path):
    config = replace(tiny_config, training=replace(tiny_config.training, steps=20))
    whole = train(few_pixels, config, device="cpu")

    def stop(status):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):  # after ten steps, the first report
        train(few_pixels, config, output=tmp_path / "run", device="cpu", progress=stop)
    resumed = train(few_pixels, config, output=tmp_path / "run", resume=True, device="cpu")
    assert torch.equal(resumed.references, whole.references)


@pytest.mark.parametrize("change", [{"exposure": True}, {"robust": True}, {"views_per_step": 4}])
def test_each_option_takes_its_steps_on_the_gpus_path(gpu_path, few_pixels, tiny_config, change):
    losses = []
    train(few_pixels, small(tiny_config, **change), device="cpu", progress=lambda s: losses.append(s.loss))
    assert losses and np.isfinite(losses).all() and gpu_path.drawings >= 10


def test_the_gpus_path_learns_as_the_kernels_do(few_pixels, tiny_config, gpu_path, monkeypatch):
    config = small(tiny_config, rules=without(tiny_config.training.rules, "hidden_anchors"))
    losses = []
    for _ in range(2):  # first by torch, then by kernels
        seen: list[float] = []
        train(few_pixels, config, device="cpu", progress=lambda s, seen=seen: seen.append(s.loss))
        losses.append(seen)
        monkeypatch.undo()
    assert losses[0] == pytest.approx(losses[1], rel=0.02)
