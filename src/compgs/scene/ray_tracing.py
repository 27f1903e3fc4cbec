"""A small ray tracer with procedural textures: the photographs of the generated scene.

z is up, the ground is z = 0. Colors are linear until `render` turns them into display RGB. Textures and
shadows depend on the position in space alone, never on pixels: all views show the same surface.
"""

from dataclasses import dataclass

import numpy as np

from compgs.cameras import Camera
from compgs.numerics.compiled import njit

SPHERE, BOX, CYLINDER, GROUND, BACKDROP = range(5)
TILES, MARBLE, STRIPES, SPOTS, BRICKS, WOOD, LANDSCAPE = range(7)

_FAR = 1e9
_SUN = np.array([0.48, -0.36, 0.8]) / np.linalg.norm([0.48, -0.36, 0.8])  # towards the light
_SHADOW_SAMPLES = 16  # per pixel, over a disk of this radius at distance 1:
_SUN_RADIUS = 0.055


@dataclass(frozen=True, eq=False)
class Solids:
    """What stands in the scene, one row each."""

    kinds: np.ndarray  # [S] int64: SPHERE, BOX, CYLINDER, GROUND, BACKDROP
    centers: np.ndarray  # [S, 3]
    sizes: np.ndarray  # [S, 3] half sizes of a box; radius (and half height, third) of the others
    yaws: np.ndarray  # [S] radians around z
    textures: np.ndarray  # [S] int64
    colors: np.ndarray  # [S, 2, 3] linear RGB, the two colors of the texture
    gloss: np.ndarray  # [S] strength of the highlight

    def shapes(self) -> np.ndarray:
        """[S, 9] what the kernels take: center, size, cosine and sine of yaw, squared outer radius."""
        turn = np.stack([np.cos(self.yaws), np.sin(self.yaws), (self.sizes**2).sum(axis=1)], axis=1)
        return np.concatenate([self.centers, self.sizes, turn], axis=1)


def render(solids: Solids, camera: Camera) -> np.ndarray:
    """[H, W, 3] uint8, 2 x 2 samples per pixel."""
    intrinsics = np.array([camera.fx, camera.fy, camera.cx, camera.cy])
    eye = (camera.width, camera.height, camera.rotation.copy(), camera.center, intrinsics)
    looks = (solids.textures, solids.colors, solids.gloss)
    linear = _render(*eye, _SUN, _light_disk(), solids.kinds, solids.shapes(), *looks)
    display = np.clip(linear, 0.0, 1.0) ** (1 / 2.2)
    return np.round(display * 255).astype(np.uint8)


def trace(solids: Solids, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """[N] distance along each ray to the first surface, in lengths of the directions [N, 3]."""
    return _trace(origins, directions, solids.kinds, solids.shapes())


def _light_disk() -> np.ndarray:
    """[_SHADOW_SAMPLES, 3] directions to points spread evenly over the light (sunflower pattern)."""
    index = np.arange(_SHADOW_SAMPLES)
    radius = _SUN_RADIUS * np.sqrt((index + 0.5) / _SHADOW_SAMPLES)
    angle = index * np.pi * (3 - np.sqrt(5))
    side = np.cross(_SUN, [0.0, 0.0, 1.0])
    side /= np.linalg.norm(side)
    up = np.cross(side, _SUN)
    spread = _SUN + radius[:, None] * (np.cos(angle)[:, None] * side + np.sin(angle)[:, None] * up)
    return spread / np.linalg.norm(spread, axis=1, keepdims=True)


# Surfaces: distance and normal of the first hit. Solids are passed as tables and a row: an array view of one
# row, made for every ray, costs more than the intersection.


@njit(nogil=True, error_model="numpy")
def _hit(ox, oy, oz, dx, dy, dz, kinds, shapes, s):
    """(distance, normal x, y, z) of a ray with solid s; the distance is _FAR without a hit."""
    kind = kinds[s]
    if kind == GROUND:
        if dz < -1e-9 and oz > 0:
            return -oz / dz, 0.0, 0.0, 1.0
        return _FAR, 0.0, 0.0, 1.0
    ox, oy, oz = ox - shapes[s, 0], oy - shapes[s, 1], oz - shapes[s, 2]
    # most rays miss: the sphere around the solid tells so first
    a = dx * dx + dy * dy + dz * dz
    b = ox * dx + oy * dy + oz * dz
    square = ox * ox + oy * oy + oz * oz
    if b * b < a * (square - shapes[s, 8]) or (b > 0 and square > shapes[s, 8]):
        return _FAR, 0.0, 0.0, 1.0
    radius = shapes[s, 3]
    if kind in (SPHERE, BACKDROP):
        discriminant = b * b - a * (square - radius * radius)
        if discriminant <= 0:
            return _FAR, 0.0, 0.0, 1.0
        root = np.sqrt(discriminant)
        t = (-b + root) / a if kind == BACKDROP else (-b - root) / a
        if t < 1e-6:
            return _FAR, 0.0, 0.0, 1.0
        inverse = (-1.0 if kind == BACKDROP else 1.0) / radius
        return t, (ox + t * dx) * inverse, (oy + t * dy) * inverse, (oz + t * dz) * inverse
    cos, sin = shapes[s, 6], shapes[s, 7]
    ox, oy = cos * ox + sin * oy, cos * oy - sin * ox
    dx, dy = cos * dx + sin * dy, cos * dy - sin * dx
    if kind == CYLINDER:
        return _hit_cylinder(ox, oy, oz, dx, dy, dz, radius, shapes[s, 5], cos, sin)
    near, far, axis, sign = -_FAR, _FAR, 0, 1.0
    for k in range(3):
        o = ox if k == 0 else oy if k == 1 else oz
        d = dx if k == 0 else dy if k == 1 else dz
        half = shapes[s, 3 + k]
        if abs(d) < 1e-12:
            if abs(o) > half:
                return _FAR, 0.0, 0.0, 1.0
            continue
        first, last = (-half - o) / d, (half - o) / d
        if first > last:
            first, last = last, first
        if first > near:
            near, axis, sign = first, k, -np.sign(d)
        far = min(far, last)
    if near > far or near < 1e-6:
        return _FAR, 0.0, 0.0, 1.0
    if axis == 0:
        return near, sign * cos, sign * sin, 0.0
    if axis == 1:
        return near, -sign * sin, sign * cos, 0.0
    return near, 0.0, 0.0, sign


@njit(nogil=True, error_model="numpy")
def _hit_cylinder(ox, oy, oz, dx, dy, dz, radius, half_height, cos, sin):
    best, nx, ny, nz = _FAR, 0.0, 0.0, 1.0
    a = dx * dx + dy * dy
    if a > 1e-12:
        b = ox * dx + oy * dy
        discriminant = b * b - a * (ox * ox + oy * oy - radius * radius)
        if discriminant > 0:
            t = (-b - np.sqrt(discriminant)) / a
            if t > 1e-6 and abs(oz + t * dz) <= half_height:
                x, y = (ox + t * dx) / radius, (oy + t * dy) / radius
                best, nx, ny, nz = t, cos * x - sin * y, sin * x + cos * y, 0.0
    if abs(dz) > 1e-12:
        t = (np.sign(oz) * half_height - oz) / dz
        x, y = ox + t * dx, oy + t * dy
        if 1e-6 < t < best and x * x + y * y <= radius * radius:
            best, nx, ny, nz = t, 0.0, 0.0, np.sign(oz)
    return best, nx, ny, nz


@njit(nogil=True, error_model="numpy")
def _trace(origins, directions, kinds, shapes):
    distances = np.full(len(origins), _FAR)
    for i in range(len(origins)):
        ox, oy, oz = origins[i, 0], origins[i, 1], origins[i, 2]
        dx, dy, dz = directions[i, 0], directions[i, 1], directions[i, 2]
        for s in range(len(kinds)):
            t = _hit(ox, oy, oz, dx, dy, dz, kinds, shapes, s)[0]
            distances[i] = min(distances[i], t)
    return distances


@njit(nogil=True, error_model="numpy")
def _in_shadow(x, y, z, lx, ly, lz, kinds, shapes):
    for s in range(len(kinds)):
        if kinds[s] >= GROUND:  # casts none: everything stands on it or within it
            continue
        if _hit(x, y, z, lx, ly, lz, kinds, shapes, s)[0] < _FAR:
            return True
    return False


# Textures: mixtures of two colors, by noise on a lattice of random numbers


@njit(nogil=True, error_model="numpy")
def _random(i, j, k):
    """A number in [0, 1) that belongs to a cell of the lattice."""
    h = np.uint32(i * 374761393 + j * 668265263 + k * 974634721)
    h = np.uint32((h ^ (h >> np.uint32(13))) * np.uint32(1274126177))
    h = np.uint32((h ^ (h >> np.uint32(15))) * np.uint32(2246822519))
    return (h ^ (h >> np.uint32(16))) / 4294967296.0


@njit(nogil=True, error_model="numpy")
def _noise(x, y, z):
    """Smooth noise in [0, 1], features of size 1."""
    i, j, k = int(np.floor(x)), int(np.floor(y)), int(np.floor(z))
    x, y, z = x - i, y - j, z - k
    x, y, z = x * x * (3 - 2 * x), y * y * (3 - 2 * y), z * z * (3 - 2 * z)
    total = 0.0
    for a in range(2):
        for b in range(2):
            for c in range(2):
                weight = (x if a else 1 - x) * (y if b else 1 - y) * (z if c else 1 - z)
                total += weight * _random(i + a, j + b, k + c)
    return total


@njit(nogil=True, error_model="numpy")
def _clouds(x, y, z):
    """Three octaves of noise, in [0, 1]."""
    return (4 * _noise(x, y, z) + 2 * _noise(2 * x, 2 * y, 2 * z) + _noise(4 * x, 4 * y, 4 * z)) / 7


@njit(nogil=True, error_model="numpy")
def _ramp(x, low, high):
    """0 below low, 1 above high, smooth between."""
    x = min(max((x - low) / (high - low), 0.0), 1.0)
    return x * x * (3 - 2 * x)


@njit(nogil=True, error_model="numpy")
def _mixture(texture, x, y, z, nx, ny, nz):
    """(share of the second color, brightness) at a point in the solid's own axes; n is the normal there."""
    if texture == TILES:
        i, j = np.floor(x * 1.6), np.floor(y * 1.6)
        u, v = x * 1.6 - i, y * 1.6 - j
        joint = _ramp(min(min(u, 1 - u), min(v, 1 - v)), 0.015, 0.05)
        tint = 0.8 + 0.4 * _random(int(i), int(j), 7)
        worn = 0.8 + 0.4 * _clouds(3 * x, 3 * y, 1.5)
        return float((int(i) + int(j)) % 2), (0.45 + 0.55 * joint) * tint * worn
    if texture == MARBLE:
        vein = np.sin(5 * x + 4 * z + 7 * _clouds(2.2 * x, 2.2 * y, 2.2 * z))
        return _ramp(abs(vein), 0.0, 0.45), 0.9 + 0.2 * _noise(9 * x, 9 * y, 9 * z)
    if texture == STRIPES:
        wave = np.sin(15 * z + 1.2 * np.sin(3 * np.arctan2(y, x)))
        return _ramp(wave, -0.15, 0.15), 0.85 + 0.3 * _clouds(6 * x, 6 * y, 6 * z)
    if texture == SPOTS:
        spots = _noise(7 * x, 7 * y, 7 * z)
        return _ramp(spots, 0.55, 0.62), 0.85 + 0.3 * _clouds(4 * x, 4 * y, 4 * z)
    if texture == BRICKS:
        # around the solid: along the face, upward (on its top: along x and y)
        across = x if abs(nz) > 0.5 or abs(ny) > abs(nx) else y
        up = y if abs(nz) > 0.5 else z
        row = np.floor(up * 7)
        i = np.floor(across * 3.2 + 0.5 * (int(row) % 2))
        u, v = across * 3.2 + 0.5 * (int(row) % 2) - i, up * 7 - row
        mortar = 1 - _ramp(min(min(u, 1 - u) * 2.2, min(v, 1 - v)), 0.06, 0.13)
        return mortar, 0.7 + 0.45 * _random(int(i), int(row), 3) + 0.25 * (_clouds(9 * x, 9 * y, 9 * z) - 0.5)
    if texture == WOOD:
        radius = np.hypot(x + 0.6, y - 0.3) * 9 + 1.6 * _clouds(1.5 * x, 1.5 * y, 0.6 * z)
        ring = radius - np.floor(radius)
        return _ramp(ring, 0.1, 0.8) * (1 - _ramp(ring, 0.85, 1.0)), 0.85 + 0.3 * _noise(
            20 * x, 20 * y, 2 * z
        )
    return 0.0, 1.0


@njit(nogil=True, error_model="numpy")
def _landscape(x, y, z, radius):
    """Linear RGB of the backdrop: hills in front of a sky with clouds."""
    ux, uy, uz = x / radius, y / radius, z / radius
    flat = np.hypot(ux, uy) + 1e-9
    ax, ay = ux / flat, uy / flat
    height = uz / flat
    near = 0.04 + 0.12 * _clouds(2.3 * ax, 2.3 * ay, 11.0)
    far = 0.1 + 0.18 * _clouds(1.7 * ax, 1.7 * ay, 29.0)
    leaf = 0.6 + 0.8 * _clouds(11 * ux, 11 * uy, 16 * uz)
    cloud = _ramp(_clouds(2.5 * ux, 2.5 * uy, 6 * uz), 0.45, 0.75)
    haze = _ramp(height, 0.0, 1.3)
    r = 0.55 - 0.40 * haze + (0.45 + 0.40 * haze) * 0.7 * cloud
    g = 0.68 - 0.36 * haze + (0.32 + 0.36 * haze) * 0.7 * cloud
    b = 0.85 - 0.22 * haze + (0.15 + 0.22 * haze) * 0.7 * cloud
    hill = 1 - _ramp(height, far - 0.012, far)
    r, g, b = r + hill * (0.22 * leaf - r), g + hill * (0.3 * leaf - g), b + hill * (0.36 * leaf - b)
    hill = 1 - _ramp(height, near - 0.012, near)
    return r + hill * (0.10 * leaf - r), g + hill * (0.20 * leaf - g), b + hill * (0.07 * leaf - b)


@njit(nogil=True, error_model="numpy")
def _shade(ox, oy, oz, dx, dy, dz, sun, disk, sample, kinds, shapes, textures, colors, gloss):
    """Linear RGB along a ray of unit direction; every fourth direction of the disk decides on shadow."""
    best, hit, nx, ny, nz = _FAR, -1, 0.0, 0.0, 1.0
    for s in range(len(kinds)):
        t, mx, my, mz = _hit(ox, oy, oz, dx, dy, dz, kinds, shapes, s)
        if t < best:
            best, hit, nx, ny, nz = t, s, mx, my, mz
    if hit < 0:
        return 0.0, 0.0, 0.0
    x, y, z = ox + best * dx, oy + best * dy, oz + best * dz
    lx, ly, lz = x - shapes[hit, 0], y - shapes[hit, 1], z - shapes[hit, 2]
    if textures[hit] == LANDSCAPE:
        return _landscape(lx, ly, lz, shapes[hit, 3])
    cos, sin = shapes[hit, 6], shapes[hit, 7]
    lx, ly = cos * lx + sin * ly, cos * ly - sin * lx
    share, brightness = _mixture(textures[hit], lx, ly, lz, cos * nx + sin * ny, cos * ny - sin * nx, nz)

    light = 0.0
    facing = nx * sun[0] + ny * sun[1] + nz * sun[2]
    if facing > 0:
        for k in range(sample, _SHADOW_SAMPLES, 4):
            # started off the surface: its own curvature must not shade it
            sx, sy, sz = x + 1e-4 * nx, y + 1e-4 * ny, z + 1e-4 * nz
            if not _in_shadow(sx, sy, sz, disk[k, 0], disk[k, 1], disk[k, 2], kinds, shapes):
                light += 4.0 / _SHADOW_SAMPLES
    # halfway between the light and the eye (Blinn)
    hx, hy, hz = sun[0] - dx, sun[1] - dy, sun[2] - dz
    aligned = max((nx * hx + ny * hy + nz * hz) / np.sqrt(hx * hx + hy * hy + hz * hz), 0.0)
    highlight = gloss[hit] * light * aligned**60
    # darker near the ground, where less sky is seen
    open_sky = (0.5 + 0.5 * nz) * (0.65 + 0.35 * _ramp(z, 0.0, 0.5)) if kinds[hit] != GROUND else 0.85
    direct, ambient = 1.15 * light * max(facing, 0.0), 0.42 * open_sky + 0.06
    r = brightness * (colors[hit, 0, 0] + share * (colors[hit, 1, 0] - colors[hit, 0, 0]))
    g = brightness * (colors[hit, 0, 1] + share * (colors[hit, 1, 1] - colors[hit, 0, 1]))
    b = brightness * (colors[hit, 0, 2] + share * (colors[hit, 1, 2] - colors[hit, 0, 2]))
    return (
        r * (direct * 1.0 + ambient * 0.88) + highlight,
        g * (direct * 0.95 + ambient * 0.97) + highlight,
        b * (direct * 0.85 + ambient * 1.12) + highlight,
    )


@njit(nogil=True, error_model="numpy")
def _render(
    width,
    height,
    rotation,
    center,
    intrinsics,
    sun,
    disk,
    kinds,
    shapes,
    textures,
    colors,
    gloss,
):
    out = np.zeros((height, width, 3))
    fx, fy, cx, cy = intrinsics
    for i in range(height):
        for j in range(width):
            for sample in range(4):
                u = (j + 0.25 + 0.5 * (sample % 2) - cx) / fx
                v = (i + 0.25 + 0.5 * (sample // 2) - cy) / fy
                dx = rotation[0, 0] * u + rotation[1, 0] * v + rotation[2, 0]
                dy = rotation[0, 1] * u + rotation[1, 1] * v + rotation[2, 1]
                dz = rotation[0, 2] * u + rotation[1, 2] * v + rotation[2, 2]
                length = np.sqrt(dx * dx + dy * dy + dz * dz)
                r, g, b = _shade(
                    center[0],
                    center[1],
                    center[2],
                    dx / length,
                    dy / length,
                    dz / length,
                    sun,
                    disk,
                    sample,
                    kinds,
                    shapes,
                    textures,
                    colors,
                    gloss,
                )
                # each sample is cut off, not their mean: a highlight's edge stays smooth
                out[i, j, 0] += 0.25 * min(r, 1.0)
                out[i, j, 1] += 0.25 * min(g, 1.0)
                out[i, j, 2] += 0.25 * min(b, 1.0)
    return out
