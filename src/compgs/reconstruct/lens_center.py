"""The last bundle adjustment of a reconstruction: where the optical axis of its lens meets the photographs.

COLMAP takes the middle of the photographs for that place, as few photographs cannot tell it from a turn of the camera.
Phones are off by half a percent of the width and more. Then no point is quite where two photographs say, and what is
trained on such cameras stays soft (docs/results/truck.md). From many photographs of one camera the place can be told.
"""

from pathlib import Path

from compgs.reconstruct.cameras import MANY_PHOTOGRAPHS

MOST_STEPS = 100  # it ends earlier where nothing moves any more


def fit_center(models: Path, threads: int) -> None:
    """Fit poses, points and the whole lens, its center among them, in each of COLMAP's models in the folder `models`
    that has enough photographs; each is written where it was.
    """
    import pycolmap

    options = pycolmap.BundleAdjustmentOptions()
    options.refine_principal_point = True
    options.print_summary = False
    options.ceres.loss_function_type = pycolmap.LossFunctionType.SOFT_L1  # some matches are wrong
    options.ceres.solver_options.max_num_iterations = MOST_STEPS
    options.ceres.solver_options.num_threads = threads
    for folder in sorted(path for path in models.iterdir() if path.is_dir()):
        model = pycolmap.Reconstruction(folder)
        if model.num_reg_images() < MANY_PHOTOGRAPHS:
            continue
        pycolmap.bundle_adjustment(model, options)
        model.update_point_3d_errors()
        model.write(folder)
