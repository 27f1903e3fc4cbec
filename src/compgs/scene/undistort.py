"""Lens distortion: forward models, and images as a pinhole camera would have taken them.

`x, y` are normalized image coordinates: a point in camera axes divided by its depth. Distorted ones,
multiplied by the focal lengths, are pixels from the principal point. Only the forward equations are needed:
every pixel of the undistorted image asks where the lens has put it.
"""

from dataclasses import dataclass, replace

import numpy as np

from compgs.cameras import Camera
from compgs.errors import UnsupportedCamera
from compgs.numerics.compiled import njit

MODELS = (
    "SIMPLE_RADIAL",
    "RADIAL",
    "OPENCV",
    "FULL_OPENCV",
    "BROWN",
    "OPENCV_FISHEYE",
    "SIMPLE_RADIAL_FISHEYE",
    "RADIAL_FISHEYE",
    "FOV",
)


@dataclass(frozen=True)
class Distortion:
    """A lens: the model's name as COLMAP spells it, and its distortion coefficients in COLMAP's order.

    BROWN is none of COLMAP's: k1, k2, p1, p2, k3, k4, where k4 belongs to the eighth power of the radius (nerfstudio).
    """

    model: str  # one of MODELS
    coefficients: tuple[float, ...]

    @property
    def is_identity(self) -> bool:
        """True where the lens is a pinhole; a fisheye lens never is."""
        return "FISHEYE" not in self.model and not any(self.coefficients)


def distort(x: np.ndarray, y: np.ndarray, lens: Distortion) -> tuple[np.ndarray, np.ndarray]:
    """Undistorted -> distorted normalized coordinates; any shape."""
    c = lens.coefficients
    if lens.model in ("SIMPLE_RADIAL", "RADIAL"):
        k1, k2 = (*c, 0.0)[:2]
        return _brown_conrady(x, y, (k1, k2, 0.0, 0.0, 0.0, 0.0))
    if lens.model == "OPENCV":
        k1, k2, p1, p2 = c
        return _brown_conrady(x, y, (k1, k2, p1, p2, 0.0, 0.0))
    if lens.model == "BROWN":
        return _brown_conrady(x, y, c)
    if lens.model == "FULL_OPENCV":
        k1, k2, p1, p2, k3, *denominator = c
        return _brown_conrady(x, y, (k1, k2, p1, p2, k3, 0.0), tuple(denominator))
    if lens.model == "FOV":
        return _field_of_view(x, y, c[0])
    return _fisheye(x, y, (*c, 0.0, 0.0, 0.0, 0.0)[:4])


def _brown_conrady(
    x: np.ndarray,
    y: np.ndarray,
    coefficients: tuple[float, ...],  # k1, k2, p1, p2, k3, k4
    denominator: tuple[float, ...] = (0.0, 0.0, 0.0),
) -> tuple[np.ndarray, np.ndarray]:
    """Radial polynomial, perhaps over another, and tangential distortion (OpenCV's calib3d documentation)."""
    k1, k2, p1, p2, k3, k4 = coefficients
    d1, d2, d3 = denominator
    r2 = x * x + y * y
    radial = (1 + r2 * (k1 + r2 * (k2 + r2 * (k3 + r2 * k4)))) / (1 + r2 * (d1 + r2 * (d2 + r2 * d3)))
    xy = 2 * x * y
    return (
        x * radial + p1 * xy + p2 * (r2 + 2 * x * x),
        y * radial + p2 * xy + p1 * (r2 + 2 * y * y),
    )


def _fisheye(x: np.ndarray, y: np.ndarray, coefficients: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Equidistant projection with a polynomial in the angle theta from the axis (Kannala and Brandt 2006)."""
    k1, k2, k3, k4 = coefficients
    r = np.hypot(x, y)
    theta = np.arctan(r)
    t2 = theta * theta
    bent = theta * (1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))))
    scale = np.where(r > 1e-9, bent / np.maximum(r, 1e-9), 1.0)
    return x * scale, y * scale


def _field_of_view(x: np.ndarray, y: np.ndarray, omega: float) -> tuple[np.ndarray, np.ndarray]:
    """One parameter, the lens's field of view in radians (Devernay and Faugeras 2001)."""
    if abs(omega) < 1e-8:
        return x, y
    r = np.hypot(x, y)
    factor = 2 * np.tan(omega / 2)
    scale = np.where(r > 1e-9, np.arctan(r * factor) / (np.maximum(r, 1e-9) * omega), factor / omega)
    return x * scale, y * scale


def undistorted_camera(camera: Camera, lens: Distortion) -> Camera:
    """The pinhole camera with the same pose and focal lengths that sees as much as it can of the image, and
    nothing beyond its edges. Raises UnsupportedCamera where the lens leaves nothing worth seeing."""
    full = np.array([camera.cx, camera.cy, camera.width - camera.cx, camera.height - camera.cy])
    focal = np.array([camera.fx, camera.fy, camera.fx, camera.fy])
    if full.min() <= 0:
        raise UnsupportedCamera(
            f"the principal point ({camera.cx:g}, {camera.cy:g}) lies outside of the image of {camera.width}x"
            f"{camera.height} pixels, which cannot be undistorted; calibrate again"
        )

    def largest(sides: np.ndarray, growth: np.ndarray, top: float) -> np.ndarray:
        """sides + t growth for the largest t in [0, top] up to which only the image is seen, to 1e-5 of t."""
        # Walked from 0, then halved: far outside, polynomials fold back and look valid again.
        steps = np.linspace(0.0, top, 65).tolist()
        bad = next((t for t in steps[1:] if not _sees_only_image(sides + t * growth, camera, lens)), None)
        if bad is None:
            return sides + top * growth
        good = bad - steps[1]
        while bad - good > 1e-5:
            middle = (good + bad) / 2
            if _sees_only_image(sides + middle * growth, camera, lens):
                good = middle
            else:
                bad = middle
        return sides + good * growth

    # Sides: distance of the left, top, right, bottom edge from the axis, in undistorted normalized units.
    # First all four grow together from the axis, then each on its own, until it would look past the image.
    # At most to twice the distance without a lens: the image of a fisheye lens could be endless.
    sides = largest(np.zeros(4), full / focal, 2.0)
    for side in (0, 2, 1, 3):
        growth = np.zeros(4)
        growth[side] = max(2 * full[side] / focal[side] - sides[side], 0.0)
        sides = largest(sides, growth, 1.0)
    left, top, right, bottom = (sides * focal).tolist()
    width, height = int(left + right + 1e-6), int(top + bottom + 1e-6)
    if width * height < 0.05 * camera.width * camera.height or min(width, height) < 1:
        raise UnsupportedCamera(
            f"the distortion {lens.model} {lens.coefficients} leaves {width}x{height} of {camera.width}x"
            f"{camera.height} pixels when it is undone; calibrate again"
        )
    return replace(camera, cx=left, cy=top, width=width, height=height)


def _sees_only_image(sides: np.ndarray, camera: Camera, lens: Distortion) -> bool:
    """True if the rectangle's border, distorted, lies inside the image and is not folded back."""
    left, top, right, bottom = sides
    across, down = np.linspace(-left, right, 129), np.linspace(-top, bottom, 129)
    ones = np.ones(129)
    x = np.concatenate([across, across, -left * ones, right * ones])
    y = np.concatenate([-top * ones, bottom * ones, down, down])
    bent_x, bent_y = distort(x, y, lens)
    further_x, further_y = distort(x * 1.001, y * 1.001, lens)
    outward = (further_x - bent_x) * x + (further_y - bent_y) * y
    u, v = bent_x * camera.fx + camera.cx, bent_y * camera.fy + camera.cy
    inside = (u >= -1e-9) & (u <= camera.width + 1e-9) & (v >= -1e-9) & (v <= camera.height + 1e-9)
    return bool((inside & (outward >= 0)).all())


def undistortion_map(source: Camera, target: Camera, lens: Distortion) -> np.ndarray:
    """[H, W, 2] float32: for each pixel of the target the position (u, v) in the source image, in pixels."""
    x = (np.arange(target.width) + 0.5 - target.cx) / target.fx
    y = (np.arange(target.height) + 0.5 - target.cy) / target.fy
    bent_x, bent_y = distort(x[None, :], y[:, None], lens)
    u, v = bent_x * source.fx + source.cx, bent_y * source.fy + source.cy
    return np.stack(np.broadcast_arrays(u, v), axis=-1).astype(np.float32)


@njit(nogil=True)
def _cubic(t: np.float32) -> tuple:
    """Weights of the four samples around a position t in [0, 1) between the inner two (Catmull and Rom)."""
    return (
        ((-0.5 * t + 1.0) * t - 0.5) * t,
        (1.5 * t - 2.5) * t * t + 1.0,
        ((-1.5 * t + 2.0) * t + 0.5) * t,
        (0.5 * t - 0.5) * t * t,
    )


@njit(nogil=True)
def sample_bicubic(image: np.ndarray, positions: np.ndarray) -> np.ndarray:
    """image [H, W, 3] uint8, positions [h, w, 2] (u, v) pixels -> [h, w, 3] uint8; edges are extended."""
    height, width = image.shape[0], image.shape[1]
    h, w = positions.shape[0], positions.shape[1]
    out = np.empty((h, w, 3), dtype=np.uint8)
    columns = np.empty(4, dtype=np.int64)
    for i in range(h):
        for j in range(w):
            u, v = positions[i, j, 0] - 0.5, positions[i, j, 1] - 0.5
            left, top = np.floor(u), np.floor(v)
            wx, wy = _cubic(u - left), _cubic(v - top)
            red = green = blue = 0.0
            for a in range(4):
                columns[a] = min(max(int(left) - 1 + a, 0), width - 1)
            for b in range(4):
                row = min(max(int(top) - 1 + b, 0), height - 1)
                for a in range(4):
                    weight = wx[a] * wy[b]
                    red += weight * image[row, columns[a], 0]
                    green += weight * image[row, columns[a], 1]
                    blue += weight * image[row, columns[a], 2]
            out[i, j, 0] = min(max(red + 0.5, 0.0), 255.0)
            out[i, j, 1] = min(max(green + 0.5, 0.0), 255.0)
            out[i, j, 2] = min(max(blue + 0.5, 0.0), 255.0)
    return out
