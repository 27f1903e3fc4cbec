"""Lenses as `transforms.json` describes them: a model's name, and coefficients by name.

nerfstudio and instant-ngp mean the same polynomial by k1 to k4, in the squared radius of a perspective image or in the
squared angle of a fisheye; p1 and p2 are tangential. COLMAP's FULL_OPENCV has k4 to k6 in a denominator.
"""

from collections.abc import Mapping
from typing import Any

from compgs.errors import UnsupportedCamera
from compgs.scene.transforms import number
from compgs.scene.undistort import Distortion

COEFFICIENTS = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")
FISHEYE = ("OPENCV_FISHEYE", "FISHEYE", "EQUIDISTANT", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE")
RATIONAL = "FULL_OPENCV"
PERSPECTIVE = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "PERSPECTIVE", "SIMPLE_RADIAL", "RADIAL", RATIONAL)


def lens_of(values: Mapping[str, Any], place: str, file: str, notes: list[str]) -> Distortion | None:
    """None for a pinhole. Adds to `notes` what is not used; raises UnsupportedCamera for what cannot be undone."""
    is_fisheye = bool(values.get("is_fisheye"))
    model = values.get("camera_model") or ("OPENCV_FISHEYE" if is_fisheye else "OPENCV")
    if model not in FISHEYE + PERSPECTIVE:
        raise UnsupportedCamera(
            f"{place}: the camera model {model!r} is not supported; export undistorted images (PINHOLE)"
        )
    if is_fisheye and model not in FISHEYE:
        raise UnsupportedCamera(
            f"{place}: camera_model is {model} and is_fisheye is true, which contradict each other; correct one of them"
        )
    k1, k2, k3, k4, k5, k6, p1, p2 = (
        number(dict(values), key, place) if values.get(key) is not None else 0.0 for key in COEFFICIENTS
    )
    if model != RATIONAL and (k5 or k6):
        raise UnsupportedCamera(
            f"{place}: k5 and k6 are coefficients of {RATIONAL}, but the camera model is {model}; name that model, or "
            "export undistorted images (PINHOLE)"
        )
    if model in FISHEYE:
        if p1 or p2:
            notes.append(f"{file}: p1 and p2 are not used: {model} has none")
        return Distortion("OPENCV_FISHEYE", (k1, k2, k3, k4))
    if model == RATIONAL:
        lens = Distortion("FULL_OPENCV", (k1, k2, p1, p2, k3, k4, k5, k6))
    else:
        lens = Distortion("BROWN", (k1, k2, p1, p2, k3, k4))
    return None if lens.is_identity else lens
