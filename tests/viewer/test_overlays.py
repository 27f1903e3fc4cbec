"""What is drawn over the picture is where it should be."""

from pathlib import Path

import numpy as np
import pytest
import torch

import compgs
from compgs.formats import write_ply
from compgs.model.splats import SplatModel
from compgs.tensors.splats import Splats
from compgs.viewer.overlays import MOST_POINTS, anchor_points, ellipsoids, shown_cameras, sphere
from compgs.viewer.shown import FileShown, focus, radius

from .test_picture import looking


def splat_scene(means: np.ndarray, scales: np.ndarray, opacities: np.ndarray) -> SplatModel:
    n = len(means)
    numbers = torch.from_numpy(means).float(), torch.from_numpy(np.log(scales)).float()
    turned = torch.tensor([2.0, 0.0, 0.0, 2.0]).repeat(n, 1)  # a quarter turn about z, not of unit length
    logits = torch.logit(torch.from_numpy(opacities).float())
    return SplatModel(
        Splats(*numbers, turned, logits, torch.full((n, 3), 0.5), torch.zeros(n, 0, 3)).arrays(), (0, 0, 0)
    )


def test_a_sphere_is_one_and_looks_outwards() -> None:
    for level, faces in ((0, 8), (1, 32), (2, 128)):
        vertices, index = sphere(level)
        assert len(index) == faces and len(vertices) == faces / 2 + 2  # Euler
        np.testing.assert_allclose(np.linalg.norm(vertices, axis=1), 1, atol=1e-6)
        a, b, c = (vertices[index[:, i]] for i in range(3))
        outwards = (np.cross(b - a, c - a) * (a + b + c)).sum(1)
        assert (outwards > 0).all()


def test_ellipsoids_are_what_the_image_consists_of() -> None:
    """A wall before the camera, something behind the wall, something behind the camera, something hardly there."""
    means = np.array([(0, 0, 4.0), (0, 0, 8.0), (0, 0, -4.0), (0.5, 0, 3.0)])
    scales = np.array([(3, 2, 0.1), (0.5, 0.5, 0.5), (0.5, 0.5, 0.5), (0.1, 0.1, 0.1)])
    model = splat_scene(means, scales, np.array([0.998, 0.9, 0.9, 0.02]))
    camera = looking(np.zeros(3), np.array([0.0, 0.0, 1.0]))
    found = ellipsoids(model, camera, 1)
    np.testing.assert_allclose(found.means, means[:1])
    np.testing.assert_allclose(found.radii, scales[:1], rtol=1e-5)
    np.testing.assert_allclose(found.quaternions, [[0.5**0.5, 0, 0, 0.5**0.5]], rtol=1e-5)
    assert found.colors.dtype == np.uint8 and found.colors.shape == (1, 3)
    behind = ellipsoids(model, camera, 10).means[:, 2]
    assert -4.0 not in behind and 1 <= len(behind) <= 3


def test_there_are_never_more_points_than_a_page_can_show() -> None:
    n = MOST_POINTS + 1
    many = splat_scene(np.random.default_rng(0).normal(size=(n, 3)), np.ones((n, 3)), np.full(n, 0.5))
    assert MOST_POINTS / 3 < len(anchor_points(many)) <= MOST_POINTS


def test_points_are_the_anchors_of_a_file(tiny_cgs: Path) -> None:
    model = compgs.decode(tiny_cgs)
    np.testing.assert_array_equal(anchor_points(model), model.primitives.positions)


def test_no_more_frustums_than_can_be_told_apart() -> None:
    cameras = [(str(i), looking(np.array([i, 0.0, 0.0]), np.ones(3))) for i in range(500)]
    assert [name for name, _ in shown_cameras(cameras)][:2] == ["0", "3"]
    assert len(shown_cameras(cameras[:7])) == 7


def test_a_camera_looks_at_what_is_in_the_middle_of_its_image() -> None:
    camera = looking(np.array([1.0, 2.0, 3.0]), np.array([1.0, 2.0, 13.0]))
    ahead, aside, behind = (np.array([1.0, 2.0, z]) for z in (8.0, 4.0, -90.0))
    step = np.array([0.0, 0.0, 1.0])
    positions = np.stack([ahead, ahead + step, ahead - step, aside + (3.0 * step[::-1]), behind, behind])
    assert focus(positions, camera) == pytest.approx(5.0)
    assert focus(behind[None], camera) == pytest.approx(93.0)


def test_far_background_does_not_count_for_the_size_of_a_scene() -> None:
    rng = np.random.default_rng(0)
    near = rng.normal(size=(900, 3))
    far = 1000 * rng.normal(size=(100, 3))
    assert 1.5 < radius(np.concatenate([near, far])) < 3.5


def test_a_file_without_cameras_is_looked_at_from_beside(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    model = splat_scene(rng.normal(size=(50, 3)), np.full((50, 3), 0.1), np.full(50, 0.9))
    write_ply(model.splats, tmp_path / "a.ply")
    shown = FileShown(tmp_path / "a.ply", "cpu", (1.0, 1.0, 1.0))
    ((_, camera),) = shown.cameras
    image = compgs.render(shown.whole, camera).image
    assert shown.background == (1.0, 1.0, 1.0) and float(image.min()) < 0.9
    assert shown.levels == (f"all of it: {(tmp_path / 'a.ply').stat().st_size / 1e3:.1f} kB",)
