"""What to do with a folder in which no poses, or not its photographs, were found."""

import shlex
from pathlib import Path, PurePosixPath

from compgs.errors import UnreadableImage
from compgs.scene.capture import Capture
from compgs.scene.colmap import find_sparse_model
from compgs.scene.names import Names

# Files of poses that are not read, as patterns of their names, and whose they are.
POSES_OF_OTHERS = {
    "poses_bounds.npy": "LLFF",
    "*.nvm": "VisualSFM",
    "bundle*.out": "Bundler",
    "cameras.xml": "Metashape or RealityScan",
    "*.xmp": "RealityScan",
    "images/*.xmp": "RealityScan",
    "*.abc": "Alembic",
    "sfm_data.json": "OpenMVG",
    "cameras.sfm": "Meshroom",
    "reconstruction.json": "OpenSfM",
}


def _pattern(file: Path) -> str:
    return next(pattern for pattern in POSES_OF_OTHERS if file.match(pattern))


def no_poses(folder: Path) -> str:
    """What to do with a folder in which no poses were found: somewhere inside it there may be some."""
    deeper = [place for pattern in ("*/", "*/*/", "*/*/*/") for place in sorted(folder.glob(pattern))]
    if (folder / "database.db").is_file():
        return (
            f"{folder}: no camera poses found; database.db has COLMAP's features and matches, but no poses: run "
            f"`colmap mapper`, which writes sparse/0, or: compgs reconstruct {shlex.quote(str(folder))} -o SCENE"
        )
    others = [file for pattern in POSES_OF_OTHERS for file in sorted(folder.glob(pattern))]
    if others:
        return (
            f"{folder}: {others[0].relative_to(folder)} is not read: poses of {POSES_OF_OTHERS[_pattern(others[0])]}; "
            f"export them from there for COLMAP (sparse/0) or nerfstudio (transforms.json), beside images/"
        )
    inside = [p for p in deeper if find_sparse_model(p) == p or (p / "transforms.json").is_file()]
    if inside:
        way = f"; there are some in {inside[0].relative_to(folder)}/"
        return (
            f"{folder}: no camera poses found where they are expected: a COLMAP sparse model in sparse/0, "
            f"transforms_train.json or transforms.json{way}: name the folder of that scene, or put it there, beside "
            "images/"
        )
    return (
        f"{folder}: no camera poses found; expected a COLMAP sparse model (cameras.bin, images.bin and "
        f"points3D.bin in sparse/0), transforms_train.json (Blender) or transforms.json (nerfstudio). "
        f"For photographs alone, or a video, run: compgs reconstruct {shlex.quote(str(folder))} -o SCENE"
    )


def check_there(capture: Capture, folder: Path, images: str) -> None:
    """Raises UnreadableImage where photographs are missing that lie in another folder inside the scene's."""
    missing = [posed for posed in capture.images if not posed.path.is_file()]
    if not missing:
        return
    names, wanted = Names(), PurePosixPath(missing[0].name)
    for place in sorted(path for path in folder.iterdir() if path.is_dir()):
        if any(names.find(place, str(name)) for name in (wanted, wanted.name)):
            raise UnreadableImage(
                f"{missing[0].path}: this view's image does not exist; {place.name}/ has one of that name: name that "
                f"folder with images=..., or rename it to {images}"
            )
