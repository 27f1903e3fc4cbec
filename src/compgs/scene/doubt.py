"""Whether a capture's cameras may be off: what the reconstruction says of itself, and who made it."""

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from compgs.scene.capture import Capture
from compgs.scene.views import View

REPORT = "reconstruction.json"  # of `compgs reconstruct`, in the scene's folder
ADJUSTMENT = "adjustment.json"  # of `compgs adjust`
GENERATED = "generated.json"  # of `compgs demo-scene`, whose cameras are exact
MOST_ERROR = 1.0  # pixels of the photographs as they are read


def poses_in_doubt(folder: Path, capture: Capture, views: Sequence[View]) -> str:
    """Why poses may be off by a pixel of the views, in words; empty where nothing says so."""
    if _of_a_video(folder / REPORT):
        return "the photographs are frames of a video"
    if capture.reprojection_error is None:
        return ""
    there = np.median([posed.camera.fx for posed in capture.images])
    here = np.median([view.camera.fx for view in views])
    error = capture.reprojection_error * float(here / there)
    return f"the reconstruction's mean error is {error:.1f} pixels" if error > MOST_ERROR else ""


def cameras_from_elsewhere(folder: Path) -> bool:
    """Whether a COLMAP capture that `compgs adjust` reads has cameras that this program neither fitted nor computed."""
    adjustable = (folder / "images").is_dir() and (folder / "sparse" / "0").is_dir()
    return adjustable and not any((folder / name).exists() for name in (REPORT, ADJUSTMENT, GENERATED))


def _of_a_video(report: Path) -> bool:
    try:
        told = json.loads(report.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False
    return isinstance(told, dict) and told.get("video") is True
