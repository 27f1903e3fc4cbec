"""The frustum test must not lose anything that would be drawn."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from compgs.cameras import Camera
from compgs.gaussians import Gaussians
from compgs.render import RasterSettings, rasterize
from compgs.render import visible_mask as visible_mask_of_arrays
from compgs.tensors.visibility import visible_mask

SETTINGS = RasterSettings()
CUTOFF_SIGMAS = np.sqrt(2 * np.log(255))


def make_camera(seed: int) -> Camera:
    r = np.random.default_rng(seed)
    rotation, _ = np.linalg.qr(r.normal(size=(3, 3)))
    pose = np.eye(4)
    pose[:3, :3] = rotation * np.sign(np.linalg.det(rotation))
    pose[:3, 3] = r.normal(size=3)
    width, height = r.integers(8, 40, 2)
    focal = r.uniform(5, 80)
    return Camera(
        pose, focal, focal * 1.1, width * r.uniform(0.2, 0.8), height * 0.5, int(width), int(height)
    )


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 100_000))
def test_whatever_touches_a_pixel_is_visible(seed):
    r, camera = np.random.default_rng(seed), make_camera(seed)
    n = 300
    scales = np.exp(r.normal(-2, 1.5, (n, 3)))
    means = r.normal(0, 1.5, (n, 3))
    fields = (means, r.normal(size=(n, 4)), scales, np.ones(n), np.ones((n, 3)))
    drawn = rasterize(Gaussians(*(f.astype(np.float32) for f in fields)), camera).visible

    # Anchors some way off their Gaussian, with radii that reach to where it ends
    offsets = r.normal(0, 0.3, (n, 3))
    radii = np.linalg.norm(offsets, axis=1) + CUTOFF_SIGMAS * scales.max(1)
    positions = torch.tensor(means + offsets)
    for dtype in (torch.float32, torch.float64):
        mask = visible_mask(positions.to(dtype), torch.tensor(radii).to(dtype), camera, SETTINGS)
        assert torch.all(mask[drawn])


def test_the_compiled_test_is_the_plain_one():
    camera = make_camera(0)
    r = np.random.default_rng(1)
    positions, radii = torch.tensor(r.normal(0, 3, (20_000, 3))), torch.tensor(r.uniform(0, 0.3, 20_000))
    plain = visible_mask(positions, radii, camera, SETTINGS)
    compiled = visible_mask(positions.float(), radii.float(), camera, SETTINGS)
    arrays = positions.float().numpy(), radii.float().numpy()
    assert np.array_equal(compiled, visible_mask_of_arrays(*arrays, camera, SETTINGS))
    assert torch.sum(plain != compiled) <= 2  # rounding, exactly on the boundary
    assert 0 < plain.sum() < len(plain)


def test_anchors_behind_or_far_beside_the_camera_are_not_visible():
    camera = Camera(np.eye(4), 50.0, 50.0, 20.0, 15.0, 40, 30)
    positions = torch.tensor([[0.0, 0, 5], [0, 0, -5], [10, 0, 5], [-10, 0, 5], [0, 10, 5], [0, -10, 5]])
    mask = visible_mask(positions, torch.full((6,), 0.1), camera, SETTINGS)
    assert mask.tolist() == [True, False, False, False, False, False]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_anchors_that_do_not_reach_the_near_plane_are_not_visible(dtype):
    camera = Camera(np.eye(4), 50.0, 50.0, 20.0, 15.0, 40, 30)
    positions = torch.tensor([[0, 0, 0.3], [0, 0, 0.3], [0, 0, 0.6], [0, 0, -1.0]], dtype=dtype)
    radii = torch.tensor([0.19, 0.21, 0.0, 1.51], dtype=dtype)
    mask = visible_mask(positions, radii, camera, RasterSettings(near_plane=0.5))
    assert mask.tolist() == [False, True, True, True]


def test_no_anchors_give_an_empty_mask():
    mask = visible_mask(torch.zeros(0, 3), torch.zeros(0), make_camera(0), SETTINGS)
    assert mask.shape == (0,) and mask.dtype == torch.bool
