"""The last adjustment of a reconstruction, beside the cameras that a synthetic capture was made with."""

from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from compgs.reconstruct.last_fit import MOST_ERROR, fit_again

pycolmap = pytest.importorskip("pycolmap", reason="the extra `reconstruct` is not installed")

WIDTH, HEIGHT, FOCAL = 1024, 768, 900.0
NOISE = 0.3  # pixels, of the features
WRONG, WRONG_BY = 0.1, 3.0  # share of the matches that are wrong, and by how many pixels, in one direction


def synthetic() -> Any:
    pycolmap.set_random_seed(0)
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_frames_per_rig, options.num_points3D = 1, 12, 400
    options.camera_width, options.camera_height = WIDTH, HEIGHT
    options.camera_model_id = pycolmap.CameraModelId.SIMPLE_RADIAL
    options.camera_params = [FOCAL, WIDTH / 2, HEIGHT / 2, 0.02]
    return pycolmap.synthesize_dataset(options)


def reconstructed(model: Any, models: Path) -> None:
    """Write the model as COLMAP ends with it: fitted by least squares to features of which some are wrong."""
    noise = pycolmap.SyntheticNoiseOptions()
    noise.point2D_stddev = NOISE
    pycolmap.synthesize_noise(noise, model)
    chance = np.random.default_rng(1)
    for image in model.images.values():
        toward = chance.normal(size=2)
        toward *= WRONG_BY / np.hypot(*toward)
        for point in image.points2D:
            if point.has_point3D() and chance.random() < WRONG:
                point.xy = point.xy + toward
    usual = pycolmap.BundleAdjustmentOptions()
    usual.print_summary = False
    pycolmap.bundle_adjustment(model, usual)
    model.update_point_3d_errors()
    (models / "0").mkdir(parents=True)
    model.write(models / "0")


def turned(model: Any, true: Any) -> float:
    """Degrees by which the turn from a photograph to the next is wrong, the mean: it needs no common frame."""

    def turns(of: Any) -> list[Any]:
        poses = [of.images[number].cam_from_world() for number in sorted(of.images)]
        return [(b * a.inverse()).rotation for a, b in pairwise(poses)]

    wrong = [found.inverse() * real for found, real in zip(turns(model), turns(true), strict=True)]
    return float(np.degrees(np.mean([each.angle() for each in wrong])))


def test_wrong_matches_move_poses_less_after_the_last_fit(tmp_path: Path) -> None:
    true = synthetic()
    reconstructed(synthetic(), tmp_path)
    before = pycolmap.Reconstruction(tmp_path / "0")
    fit_again(tmp_path, feature_size=WIDTH, threads=1)
    after = pycolmap.Reconstruction(tmp_path / "0")
    assert turned(after, true) < 0.7 * turned(before, true)
    assert len(after.images) == len(before.images)


def test_pixels_are_those_of_the_photographs_in_which_features_were_found(tmp_path: Path) -> None:
    reconstructed(synthetic(), tmp_path)
    before = pycolmap.Reconstruction(tmp_path / "0").compute_num_observations()
    fit_again(tmp_path, feature_size=WIDTH // 4, threads=1)  # MOST_ERROR is 6 pixels of these photographs
    assert 4 * MOST_ERROR > WRONG_BY
    assert pycolmap.Reconstruction(tmp_path / "0").compute_num_observations() > 0.99 * before
