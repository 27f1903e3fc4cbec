"""A held-out view is aligned to where the scene looks like its photograph."""

from dataclasses import replace

import numpy as np
import pytest

from compgs.cameras import Camera
from compgs.evaluation.alignment import aligned_camera, moved
from compgs.evaluation.camera_path import look_at
from compgs.metrics import to_8bit
from compgs.model.splats import SplatArrays, SplatModel
from compgs.render import render
from compgs.scene.views import View

TRUE = Camera(
    look_at(np.array([4.0, 0.0, 1.5]), np.zeros(3), np.array([0.0, 0.0, 1.0])), 60.0, 60.0, 32.0, 24.0, 64, 48
)


@pytest.fixture(scope="module")
def model() -> SplatModel:
    chance = np.random.default_rng(0)
    n = 200
    return SplatModel(
        SplatArrays(
            means=chance.uniform(-1, 1, (n, 3)),
            log_scales=np.full((n, 3), -2.0),
            quaternions=np.tile([1.0, 0, 0, 0], (n, 1)),
            opacity_logits=np.full(n, 2.0),
            dc=chance.normal(size=(n, 3)),
            rest=np.zeros((n, 0, 3)),
        ).each(np.float32),
        (0.0, 0.0, 0.0),
    )


def photograph(model: SplatModel) -> np.ndarray:
    return to_8bit(render(model, TRUE).image)


def distance(camera: Camera) -> float:
    """Pixels, root mean square, of corners of the scene from where they are truly seen."""
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=float)

    def seen(c: Camera) -> np.ndarray:
        x, y, z = (corners @ c.rotation.T + c.translation).T
        return np.stack([c.fx * x / z, c.fy * y / z], axis=1)

    return float(np.sqrt(((seen(camera) - seen(TRUE)) ** 2).sum(1).mean()))


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_camera_that_is_off_by_pixels_finds_its_place(model: SplatModel, seed: int) -> None:
    change = np.random.default_rng(seed).normal(0, 1, 6) * ([0.02] * 3 + [0.06] * 3)
    given = moved(TRUE, change)
    found = aligned_camera(model, View("view", given, photograph(model)))
    assert distance(given) > 0.5
    assert distance(found) < 0.1 * distance(given) + 0.02


def test_another_exposure_and_a_mask_do_not_mislead_it(model: SplatModel) -> None:
    image = np.rint(photograph(model) * [0.7, 0.6, 0.8] + 10).astype(np.uint8)
    mask = np.ones(image.shape[:2], dtype=bool)
    mask[10:25, 20:40] = False
    image[~mask] = 255
    given = moved(TRUE, np.array([0.02, -0.015, 0.01, 0.04, 0.05, -0.05]))
    assert distance(aligned_camera(model, View("view", given, image, mask))) < 0.15


def test_a_camera_in_its_place_stays(model: SplatModel) -> None:
    assert distance(aligned_camera(model, View("view", TRUE, photograph(model)))) < 0.02


def test_a_view_that_shows_nothing_is_left_where_it_is(model: SplatModel) -> None:
    away = replace(TRUE, world_to_camera=np.diag([1.0, -1.0, -1.0, 1.0]) @ TRUE.world_to_camera)
    found = aligned_camera(model, View("view", away, photograph(model)))
    np.testing.assert_allclose(found.world_to_camera, away.world_to_camera)
