"""The process in which COLMAP runs: it can be ended at any time, and what it prints goes to a file.

    python -m compgs.reconstruct.worker < job.json

Stages and registered photographs are told as lines of JSON on the standard output; results are files (`mapping.py`).
"""

import json
import sys
from pathlib import Path
from typing import Any


def main() -> None:
    job: dict[str, Any] = json.load(sys.stdin)
    if "undistorted" in job:
        undistort(job)
    else:
        find_poses(job)


def find_poses(job: dict[str, Any]) -> None:
    import pycolmap

    pycolmap.set_random_seed(job["seed"])
    database, images = Path(job["database"]), Path(job["images"])
    threads = job["threads"] or -1

    extraction = pycolmap.FeatureExtractionOptions()
    extraction.num_threads = threads
    extraction.max_image_size = job["feature_size"]
    extraction.sift.max_num_features = job["features"]
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model = job["lens"]
    modes = {"one": "SINGLE", "folder": "PER_FOLDER", "each": "PER_IMAGE"}
    mode = getattr(pycolmap.CameraMode, modes[job["shared"]])
    _tell("features")
    pycolmap.extract_features(
        database, images, camera_mode=mode, reader_options=reader, extraction_options=extraction
    )

    matching = pycolmap.FeatureMatchingOptions()
    matching.num_threads = threads
    _tell("matching")
    if job["matching"] == "sequential":
        pairing = pycolmap.SequentialPairingOptions()
        pairing.overlap = job["overlap"]
        pycolmap.match_sequential(database, matching_options=matching, pairing_options=pairing)
    else:
        pycolmap.match_exhaustive(database, matching_options=matching)

    mapping = pycolmap.IncrementalPipelineOptions()
    mapping.num_threads = threads
    mapping.random_seed = job["seed"]
    mapping.min_model_size = 3
    _tell("mapping")
    pycolmap.incremental_mapping(
        database,
        images,
        Path(job["models"]),
        options=mapping,
        initial_image_pair_callback=lambda: _tell("registered", 2),
        next_image_callback=lambda: _tell("registered", 1),
    )


def undistort(job: dict[str, Any]) -> None:
    """Images as pinhole cameras would have taken them, and their sparse model, as COLMAP lays them out."""
    import pycolmap

    model, images = Path(job["model"]), Path(job["images"])
    pycolmap.undistort_images(Path(job["undistorted"]), model, images, jpeg_quality=95)


def _tell(event: str, count: int = 0) -> None:
    sys.stdout.write(json.dumps({"event": event, "count": count}) + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    main()
