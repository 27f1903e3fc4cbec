"""What a reconstruction gives."""

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Reconstruction:
    """Says what came of photographs: a scene, and how well they fit together."""

    scene: Path
    photographs: int  # found
    registered: int  # with a pose
    missing: tuple[str, ...]  # names of those without
    points: int
    reprojection_error: float  # pixels, mean over the points
    observations: float  # points seen by a photograph, mean
    models: int  # that COLMAP made, from different first pairs; the largest is the scene
    lens: str
    matching: str
    seconds: dict[str, float]  # by stage
    masks: int = 0  # found, of which photographs have one
    video: bool = False  # the photographs are frames of one
    masks_kept: bool = True  # in the scene; undistorted photographs have other pixels than their masks
