"""Bundle adjustment of a capture that has cameras, in the process of `worker.py`."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from compgs.reconstruct.features import find_features

FEW_SEEN = 50  # common points of a photograph, of which fewer hardly say where it is
# Pixels of the photographs as features were found in them: a point that is off by more is none of a photograph's, and
# says nothing of its camera; it may be off by more while cameras are as they came.
MOST_ERROR, MOST_ERROR_AT_FIRST = 1.5, 4.0
LEAST_ANGLE = 1.0  # degrees between the rays to a point
MOST_STEPS = 150  # of a round: it ends earlier where nothing moves any more
ROUNDS = 2  # with all points, and with those that fit


def adjust(job: dict[str, Any], tell: Callable[..., None]) -> None:
    """Find features, match them, triangulate them from the given cameras, then fit all. Writes the model to the folder
    `adjusted`, and beside the database `adjusted.json`, what came of it, and `moved.npz`, where points were and are.
    """
    import pycolmap

    pycolmap.set_random_seed(job["seed"])
    database, images = Path(job["database"]), Path(job["images"])
    given = pycolmap.Reconstruction(job["given"])
    threads = job["threads"] or -1

    tell("features")
    find_features(job, "PER_FOLDER", "PINHOLE")  # a lens until the given ones take its place
    model = _given_cameras(database, given, job["names"])

    matching = pycolmap.FeatureMatchingOptions()
    matching.num_threads = threads
    listed = pycolmap.ImportedPairingOptions()
    listed.match_list_path = job["pairs"]
    tell("pairs", len(Path(job["pairs"]).read_text(encoding="utf-8").splitlines()))
    tell("matching")
    pycolmap.match_image_pairs(database, matching_options=matching, pairing_options=listed)

    tell("adjusting")
    folder = database.with_name("triangulated")
    folder.mkdir()
    model = pycolmap.triangulate_points(model, database, images, folder, refine_intrinsics=False)
    longest = max(max(camera.width, camera.height) for camera in model.cameras.values())
    unit = max(1.0, longest / job["feature_size"])
    before, placed = errors(model, MOST_ERROR * unit), _places(model)
    seldom = [image.image_id for image in model.images.values() if image.num_points3D < FEW_SEEN]
    for done in range(ROUNDS):
        most = MOST_ERROR if done else MOST_ERROR_AT_FIRST
        pycolmap.ObservationManager(model).filter_all_points3D(most * unit, LEAST_ANGLE)
        _fit(model, threads)
        tell("round", done + 1)
    after = errors(model, MOST_ERROR * unit)
    old = {image.name: image for image in given.images.values()}
    real = {short: name for name, short in job["names"].items()}
    _bring_back(model, {image_id: old[real[image.name]] for image_id, image in model.images.items()})
    model.extract_colors_for_all_images(images)
    for image in model.images.values():
        image.name = real[image.name]
    model.write_binary(job["adjusted"])
    kept = sorted(number for number in placed if number in model.points3D)
    there, now = ([points[number] for number in kept] for points in (placed, _places(model)))
    np.savez(database.with_name("moved.npz"), there=np.reshape(there, (-1, 3)), now=np.reshape(now, (-1, 3)))
    told = {
        "points": len(model.points3D),
        "seldom_seen": sorted(model.images[number].name for number in seldom),
        "error_before": before[0],
        "error_after": after[0],
        "shift_before": before[1],
        "shift_after": after[1],
    }
    database.with_name("adjusted.json").write_text(json.dumps(told), encoding="utf-8")


def _places(model: Any) -> dict[int, np.ndarray]:
    """[3] of each point."""
    return {number: point.xyz for number, point in model.points3D.items()}


def _given_cameras(database: Path, given: Any, names: dict[str, str]) -> Any:
    """A model without points: the database's images, with the cameras and poses that they have in the `given` one."""
    import pycolmap

    old = {names[image.name]: image for image in given.images.values() if image.name in names}
    model = pycolmap.Reconstruction()
    with pycolmap.Database.open(database) as opened:
        images = opened.read_all_images()
        for camera in opened.read_all_cameras():
            its = next(old[image.name] for image in images if image.camera_id == camera.camera_id).camera
            camera.model, camera.params, camera.has_prior_focal_length = its.model, list(its.params), True
            opened.update_camera(camera)
            model.add_camera(camera)
        for rig in opened.read_all_rigs():
            model.add_rig(rig)
        for frame in opened.read_all_frames():
            model.add_frame(frame)
        for image in images:
            model.add_image(image)
    for image in images:
        frame = model.frames[model.images[image.image_id].frame_id]
        frame.set_cam_from_world(image.camera_id, old[image.name].cam_from_world())
        model.register_frame(frame.frame_id)
    return model


def _fit(model: Any, threads: int) -> None:
    """Poses, principal points, distortions and points, all together; a robust loss, as some matches are wrong. Focal
    lengths stay: where each photograph has a camera of its own, nothing else holds the world's proportions.
    """
    import pycolmap

    options = pycolmap.BundleAdjustmentOptions()
    options.refine_focal_length = False
    options.refine_principal_point = options.refine_extra_params = True
    options.print_summary = False
    options.ceres.loss_function_type = pycolmap.LossFunctionType.SOFT_L1
    options.ceres.solver_options.max_num_iterations = MOST_STEPS
    options.ceres.solver_options.num_threads = threads
    pycolmap.bundle_adjustment(model, options)


def _bring_back(model: Any, given: dict[int, Any]) -> None:
    """Move the model to where its cameras' centers were before, by a similarity."""
    import pycolmap

    numbers = sorted(given)
    found = np.array([model.images[number].projection_center() for number in numbers])
    moved = pycolmap.estimate_sim3d(
        found, np.array([given[number].projection_center() for number in numbers])
    )
    if moved is not None:
        model.transform(moved)


def errors(model: Any, most: float) -> tuple[float, float]:
    """Mean distance from features to where their points are seen, and the root mean square of what is common to it in a
    part of a photograph (a quadratic polynomial of the place, by least squares); pixels, means over the photographs.
    Features that are off by more than `most` pixels are none of their points'.
    """
    distances, common = [], []
    for image in model.images.values():
        seen = [point for point in image.points2D if point.has_point3D()]
        if len(seen) < FEW_SEEN:
            continue
        places = np.array([point.xy for point in seen])
        points = np.array([model.points3D[point.point3D_id].xyz for point in seen])
        off = places - image.camera.img_from_cam(image.cam_from_world() * points)
        fits = np.isfinite(off).all(axis=1) & (np.hypot(*off.T) < most)
        if fits.sum() < FEW_SEEN:
            continue
        off, (x, y) = off[fits], (places[fits] / max(image.camera.width, image.camera.height)).T
        terms = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1)
        shift = terms @ np.linalg.lstsq(terms, off, rcond=None)[0]
        distances.append(float(np.hypot(*off.T).mean()))
        common.append(float(np.sqrt((shift**2).sum(axis=1).mean())))
    return (float(np.mean(distances)), float(np.mean(common))) if distances else (float("nan"), float("nan"))
