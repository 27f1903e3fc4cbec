"""The last bundle adjustment of a reconstruction: by what fits, and robust.

COLMAP keeps points that are seen up to four pixels off, and squares the distances: wrong matches pull at the poses of
photographs that are sharper than that. Here points that are off by more than MOST_ERROR go, and the others are fitted
once more with a loss that grows linearly.
"""

from pathlib import Path
from typing import Any

# Pixels of the photographs as features were found in them: a feature that is off by more is none of a point's.
MOST_ERROR = 1.5
LEAST_ANGLE = 1.0  # degrees between the rays to a point: with less its distance is not known
MOST_STEPS = 150  # it ends earlier where nothing moves any more


def fit_again(models: Path, feature_size: int, threads: int) -> None:
    """Fit each of COLMAP's models in the folder `models` again; it is written where it was. `feature_size`: pixels of
    the longer side of the photographs in which features were found.
    """
    import pycolmap

    options = robust_options(threads)
    for folder in sorted(path for path in models.iterdir() if path.is_dir()):
        model = pycolmap.Reconstruction(folder)
        most = MOST_ERROR * pixels_of_features(model, feature_size)
        pycolmap.ObservationManager(model).filter_all_points3D(most, LEAST_ANGLE)
        if any(image.has_pose and image.num_points3D == 0 for image in model.images.values()):
            continue  # nothing would hold this photograph where it is
        pycolmap.bundle_adjustment(model, options)
        model.update_point_3d_errors()
        model.write(folder)


def robust_options(threads: int) -> Any:
    """COLMAP's options of a bundle adjustment in which wrong matches count little."""
    import pycolmap

    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.ceres.loss_function_type = pycolmap.LossFunctionType.SOFT_L1
    options.ceres.solver_options.max_num_iterations = MOST_STEPS
    options.ceres.solver_options.num_threads = threads
    return options


def pixels_of_features(model: Any, feature_size: int) -> float:
    """Pixels of the model's photographs to one of those in which features were found, 1 or more."""
    longest = max(max(camera.width, camera.height) for camera in model.cameras.values())
    return max(1.0, longest / feature_size)
