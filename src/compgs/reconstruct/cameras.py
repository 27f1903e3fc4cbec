"""Which photographs share a camera: fewer unknowns make for better poses."""

from collections.abc import Sequence
from typing import Literal

from compgs.reconstruct.photographs import Photograph

SharedCamera = Literal["one", "folder", "each"]


def shared_camera(photographs: Sequence[Photograph]) -> SharedCamera:
    """One camera for photographs of one size whose headers agree (or are silent), else one for each photograph.

    A zoom lens that moved shows in the focal length of the headers; without headers, equal sizes are what there is to
    go by, and photographs of one visit usually come from one phone.
    """
    alike = {(photograph.size, photograph.camera) for photograph in photographs}
    return "one" if len(alike) == 1 else "each"


def lens_model(shared: SharedCamera, photographs: int) -> str:
    """COLMAP's name of the lens model: four distortion coefficients where many photographs determine them."""
    return "OPENCV" if shared == "one" and photographs >= 20 else "SIMPLE_RADIAL"
