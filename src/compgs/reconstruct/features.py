"""Features of photographs, by COLMAP, in the process of `worker.py`."""

from pathlib import Path
from typing import Any


def find_features(job: dict[str, Any], camera_mode: str, lens: str) -> None:
    """Fill the job's database with features and a camera of the model `lens` for each photograph, folder, or for all,
    as pycolmap's CameraMode of that name has it.
    """
    import pycolmap

    extraction = pycolmap.FeatureExtractionOptions()
    extraction.num_threads = job["threads"] or -1
    extraction.max_image_size = job["feature_size"]
    extraction.sift.max_num_features = job["features"]
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model = lens
    pycolmap.extract_features(
        Path(job["database"]),
        Path(job["images"]),
        camera_mode=getattr(pycolmap.CameraMode, camera_mode),
        reader_options=reader,
        extraction_options=extraction,
    )
