from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from compgs.cameras import Camera
from compgs.errors import UnsupportedCamera
from compgs.scene.undistort import (
    MODELS,
    Distortion,
    distort,
    sample_bicubic,
    undistorted_camera,
    undistortion_map,
)

CAMERA = Camera(np.eye(4), 300.0, 310.0, 322.0, 235.0, 640, 480)
COEFFICIENTS = {
    "SIMPLE_RADIAL": 1,
    "RADIAL": 2,
    "OPENCV": 4,
    "FULL_OPENCV": 8,
    "BROWN": 6,
    "OPENCV_FISHEYE": 4,
    "SIMPLE_RADIAL_FISHEYE": 1,
    "RADIAL_FISHEYE": 2,
    "FOV": 1,
}
LENSES = [
    Distortion("SIMPLE_RADIAL", (-0.12,)),
    Distortion("SIMPLE_RADIAL", (0.1,)),
    Distortion("RADIAL", (-0.15, 0.03)),
    Distortion("OPENCV", (-0.2, 0.04, 0.002, -0.003)),
    Distortion("FULL_OPENCV", (0.1, -0.05, 0.001, 0.002, 0.01, 0.12, -0.02, 0.005)),
    Distortion("BROWN", (-0.15, 0.03, 0.001, 0.002, 0.02, -0.01)),
    Distortion("OPENCV_FISHEYE", (0.02, -0.01, 0.003, -0.001)),
    Distortion("SIMPLE_RADIAL_FISHEYE", (0.05,)),
    Distortion("FOV", (0.9,)),
]
COORDINATE = st.floats(-1.0, 1.0)
SMALL = st.floats(-0.2, 0.2)


def by_hand(x: float, y: float, lens: Distortion) -> tuple[float, float]:
    """The models in scalar form, written out as COLMAP's and OpenCV's documentation have them."""
    c = dict(enumerate(lens.coefficients))
    r = (x**2 + y**2) ** 0.5
    if lens.model == "FOV":
        if r < 1e-9 or abs(c[0]) < 1e-8:
            scale = 2 * np.tan(c[0] / 2) / c[0] if abs(c[0]) > 1e-8 else 1.0
        else:
            scale = np.arctan(2 * r * np.tan(c[0] / 2)) / (c[0] * r)
        return x * scale, y * scale
    if "FISHEYE" in lens.model:
        if r < 1e-9:
            return x, y
        theta = np.arctan(r)
        bent = theta * (1 + sum(c.get(i, 0.0) * theta ** (2 * i + 2) for i in range(4)))
        return x * bent / r, y * bent / r
    k4 = 0.0
    if lens.model == "BROWN":
        k, p1, p2, k4, q = [c[0], c[1], c[4]], c[2], c[3], c[5], [0.0, 0.0, 0.0]
    elif "OPENCV" in lens.model:
        k, p1, p2 = [c[0], c[1], c.get(4, 0.0)], c[2], c[3]
        q = [c.get(5, 0.0), c.get(6, 0.0), c.get(7, 0.0)]
    else:
        k, p1, p2, q = [c[0], c.get(1, 0.0), 0.0], 0.0, 0.0, [0.0, 0.0, 0.0]
    above = 1 + k[0] * r**2 + k[1] * r**4 + k[2] * r**6 + k4 * r**8
    below = 1 + q[0] * r**2 + q[1] * r**4 + q[2] * r**6
    bent_x = x * above / below + 2 * p1 * x * y + p2 * (r**2 + 2 * x**2)
    bent_y = y * above / below + p1 * (r**2 + 2 * y**2) + 2 * p2 * x * y
    return bent_x, bent_y


def test_every_model_has_its_number_of_coefficients() -> None:
    assert set(COEFFICIENTS) == set(MODELS)


@given(st.sampled_from(MODELS), st.lists(SMALL, min_size=8, max_size=8), COORDINATE, COORDINATE)
def test_forward_models_agree_with_their_closed_form(
    model: str, numbers: list[float], x: float, y: float
) -> None:
    lens = Distortion(model, tuple(numbers[: COEFFICIENTS[model]]))
    np.testing.assert_allclose(distort(np.array(x), np.array(y), lens), by_hand(x, y, lens), atol=1e-9)


@given(COORDINATE, COORDINATE, st.sampled_from(MODELS))
def test_zero_coefficients_are_the_identity_of_perspective_lenses(x: float, y: float, model: str) -> None:
    lens = Distortion(model, (0.0,) * COEFFICIENTS[model])
    assert lens.is_identity == ("FISHEYE" not in model)
    if lens.is_identity:
        np.testing.assert_allclose(distort(np.array(x), np.array(y), lens), (x, y), atol=1e-15)


@pytest.mark.parametrize("lens", LENSES, ids=lambda lens: f"{lens.model}_{lens.coefficients[0]}")
def test_undistorted_images_see_only_what_was_photographed_and_touch_its_edges(lens: Distortion) -> None:
    target = undistorted_camera(CAMERA, lens)
    positions = undistortion_map(CAMERA, target, lens)
    assert positions.shape == (target.height, target.width, 2)
    low, high = positions.reshape(-1, 2).min(axis=0), positions.reshape(-1, 2).max(axis=0)
    assert (low >= 0).all()
    assert (high <= (CAMERA.width, CAMERA.height)).all()
    # at least two of the four edges could not grow by more than a pixel or two
    room = np.concatenate([low, np.array([CAMERA.width, CAMERA.height]) - high])
    assert (room < 2.5).sum() >= 2
    assert (target.fx, target.fy) == (CAMERA.fx, CAMERA.fy)


def test_a_lens_without_distortion_keeps_the_camera_nearly_whole() -> None:
    target = undistorted_camera(CAMERA, Distortion("RADIAL", (1e-12, 0.0)))
    assert target.width >= CAMERA.width
    assert target.height >= CAMERA.height
    assert abs(target.cx - CAMERA.cx) < 0.01


def test_barrel_distortion_widens_the_view_and_pincushion_narrows_it() -> None:
    barrel = undistorted_camera(CAMERA, Distortion("SIMPLE_RADIAL", (-0.1,)))
    pincushion = undistorted_camera(CAMERA, Distortion("SIMPLE_RADIAL", (0.1,)))
    assert barrel.width > CAMERA.width > pincushion.width


@pytest.mark.parametrize("lens", LENSES, ids=lambda lens: f"{lens.model}_{lens.coefficients[0]}")
def test_undistorted_photographs_equal_pinhole_photographs(lens: Distortion) -> None:
    """A smooth picture in front of the camera, photographed through the lens and through a pinhole."""

    def picture(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        waves = [np.sin(4 * x + y), np.cos(3 * y - x), np.sin(3 * x * y)]
        return np.round(127.5 + 100 * np.stack(waves, axis=-1)).astype(np.uint8)

    # the photograph: for each pixel the undistorted direction, found by Newton's method on the closed form
    u, v = np.meshgrid(np.arange(CAMERA.width) + 0.5, np.arange(CAMERA.height) + 0.5)
    goal = np.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy])
    guess = goal.copy()
    for _ in range(25):
        here = np.stack(distort(guess[0], guess[1], lens))
        step = 1e-6
        by_x = (np.stack(distort(guess[0] + step, guess[1], lens)) - here) / step
        by_y = (np.stack(distort(guess[0], guess[1] + step, lens)) - here) / step
        error = here - goal
        determinant = by_x[0] * by_y[1] - by_x[1] * by_y[0]
        guess[0] -= np.clip((error[0] * by_y[1] - error[1] * by_y[0]) / determinant, -0.2, 0.2)
        guess[1] -= np.clip((error[1] * by_x[0] - error[0] * by_x[1]) / determinant, -0.2, 0.2)
    photograph = picture(guess[0], guess[1])

    target = undistorted_camera(CAMERA, lens)
    found = sample_bicubic(photograph, undistortion_map(CAMERA, target, lens))
    u, v = np.meshgrid(np.arange(target.width) + 0.5, np.arange(target.height) + 0.5)
    expected = picture((u - target.cx) / target.fx, (v - target.cy) / target.fy)
    difference = np.abs(found.astype(int) - expected)[2:-2, 2:-2]
    assert np.percentile(difference, 99.9) <= 2


def test_bicubic_sampling_is_exact_at_pixel_centres_and_for_straight_ramps() -> None:
    rng = np.random.default_rng(0)
    image = rng.integers(0, 256, size=(9, 11, 3), dtype=np.uint8)
    u, v = np.meshgrid(np.arange(11) + 0.5, np.arange(9) + 0.5)
    centres = np.stack([u, v], axis=-1).astype(np.float32)
    np.testing.assert_array_equal(sample_bicubic(image, centres), image)

    ramp = np.broadcast_to((np.arange(11) * 20)[None, :, None], (9, 11, 3)).astype(np.uint8)
    between = np.array([[[3.0, 4.5], [4.25, 4.5], [5.75, 5.0]]], dtype=np.float32)
    expected = (between[0, :, 0] - 0.5) * 20
    np.testing.assert_allclose(sample_bicubic(ramp, between)[0, :, 0], expected, atol=0.51)


def test_impossible_lenses_are_refused() -> None:
    with pytest.raises(UnsupportedCamera, match="principal point"):
        undistorted_camera(replace(CAMERA, cx=-3.0), LENSES[0])
    with pytest.raises(UnsupportedCamera, match="leaves"):
        undistorted_camera(CAMERA, Distortion("SIMPLE_RADIAL", (-1000.0,)))
