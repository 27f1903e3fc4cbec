"""The process in which COLMAP runs: it can be ended at any time, and what it prints goes to a file.

    python -m compgs.reconstruct.worker < job.json

Stages and registered photographs are told as lines of JSON on the standard output; results are files (`mapping.py`).
"""

import json
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from compgs.reconstruct.adjusting import adjust
from compgs.reconstruct.features import find_features


def main() -> None:
    job: dict[str, Any] = json.load(sys.stdin)
    if "undistorted" in job:
        undistort(job)
    elif "adjusted" in job:
        adjust(job, _tell)
    else:
        find_poses(job)


def find_poses(job: dict[str, Any]) -> None:
    import pycolmap

    pycolmap.set_random_seed(job["seed"])
    database, images = Path(job["database"]), Path(job["images"])
    threads = job["threads"] or -1

    modes = {"one": "SINGLE", "folder": "PER_FOLDER", "each": "PER_IMAGE"}
    _tell("features")
    find_features(job, modes[job["shared"]], job["lens"])

    matching = pycolmap.FeatureMatchingOptions()
    matching.num_threads = threads
    if job["matching"] == "sequential":
        _tell("matching")
        pairing = pycolmap.SequentialPairingOptions()
        pairing.overlap = job["overlap"]
        pycolmap.match_sequential(database, matching_options=matching, pairing_options=pairing)
    elif job["matching"] == "retrieval":
        listed = pycolmap.ImportedPairingOptions()
        listed.match_list_path = database.with_name("pairs.txt")
        with numbered(database):
            listed.match_list_path.write_text(alike_pairs(database, job["seed"]), encoding="utf-8")
            _tell("matching")  # not before: how many pairs there are is known now
            pycolmap.match_image_pairs(database, matching_options=matching, pairing_options=listed)
    else:
        _tell("matching")
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


@contextmanager
def numbered(database: Path) -> Iterator[None]:
    """Inside, images are called by their number in the order of their names: lists of pairs have no spaces in names."""
    import pycolmap

    with pycolmap.Database.open(database) as opened:
        images = sorted(opened.read_all_images(), key=lambda image: image.name)
        names = [image.name for image in images]
        for number, image in enumerate(images):
            image.name = f"{number:08}"
            opened.update_image(image)
    yield
    with pycolmap.Database.open(database) as opened:
        for image, name in zip(images, names, strict=True):
            image.name = name
            opened.update_image(image)


def alike_pairs(database: Path, seed: int) -> str:
    """Lines of two images each: what to compare, by the features that are in the database."""
    import pycolmap

    from compgs.reconstruct.retrieval import pairs_to_compare

    with pycolmap.Database.open(database) as opened:
        images = sorted(opened.read_all_images(), key=lambda image: image.name)
        descriptors = [opened.read_descriptors(image.image_id).data for image in images]
    pairs = pairs_to_compare(descriptors, seed=seed)
    _tell("pairs", len(pairs))
    return "".join(f"{images[first].name} {images[second].name}\n" for first, second in pairs)


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
