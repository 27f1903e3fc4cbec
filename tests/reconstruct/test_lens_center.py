"""The last adjustment of a reconstruction, beside the cameras that a synthetic capture was made with."""

from pathlib import Path

import numpy as np
import pytest

from compgs.reconstruct.cameras import MANY_PHOTOGRAPHS
from compgs.reconstruct.lens_center import fit_center

pycolmap = pytest.importorskip("pycolmap", reason="the extra `reconstruct` is not installed")

WIDTH, HEIGHT, FOCAL = 1024, 768, 900.0
CENTER = (WIDTH / 2 - 9.0, HEIGHT / 2 + 7.0)  # where the optical axis meets the photographs
NOISE = 0.3  # pixels, of the features


def capture(folder: Path, photographs: int) -> Path:
    """Write a model as COLMAP ends with: fitted to features of noise NOISE, the center at the middle."""
    pycolmap.set_random_seed(0)
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_frames_per_rig, options.num_points3D = 1, photographs, 400
    options.camera_width, options.camera_height = WIDTH, HEIGHT
    options.camera_model_id = pycolmap.CameraModelId.OPENCV
    options.camera_params = [FOCAL, FOCAL, *CENTER, 0.02, -0.01, 0.0, 0.0]
    model = pycolmap.synthesize_dataset(options)
    noise = pycolmap.SyntheticNoiseOptions()
    noise.point2D_stddev = NOISE
    pycolmap.synthesize_noise(noise, model)
    (camera,) = model.cameras.values()
    camera.params = [FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2, 0.02, -0.01, 0.0, 0.0]
    usual = pycolmap.BundleAdjustmentOptions()
    usual.print_summary = False
    pycolmap.bundle_adjustment(model, usual)
    model.update_point_3d_errors()
    models = folder / "models"
    (models / "0").mkdir(parents=True)
    model.write(models / "0")
    return models


def test_the_center_of_a_lens_is_found_from_many_photographs(tmp_path: Path) -> None:
    models = capture(tmp_path, MANY_PHOTOGRAPHS)
    before = pycolmap.Reconstruction(models / "0")
    fit_center(models, threads=1)
    after = pycolmap.Reconstruction(models / "0")
    (camera,) = after.cameras.values()
    found = np.array([camera.principal_point_x, camera.principal_point_y])
    assert np.abs(found - CENTER).max() < 1.0  # of 9: noise of the features moves it, too
    assert abs(camera.focal_length_x - FOCAL) < 1.0
    # Two coordinates of such noise are off by its root of pi / 2 on average.
    assert after.compute_mean_reprojection_error() == pytest.approx(NOISE * np.sqrt(np.pi / 2), rel=0.1)
    assert before.compute_mean_reprojection_error() > after.compute_mean_reprojection_error()


def test_with_few_photographs_the_model_stays_as_it_was(tmp_path: Path) -> None:
    models = capture(tmp_path, MANY_PHOTOGRAPHS - 1)
    before = {path.name: path.read_bytes() for path in (models / "0").iterdir()}
    fit_center(models, threads=1)
    assert {path.name: path.read_bytes() for path in (models / "0").iterdir()} == before
