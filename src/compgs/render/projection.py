"""EWA projection on the CPU: 3D Gaussians to 2D means and covariances, with gradients (Zwicker et al. 2001).

    camera axes   (x, y, z) = R m + t                  factor   F = J R R(q) diag(s)    [2, 3]
    pixels        mean2d = (fx x/z + cx, fy y/z + cy)  cov2d    F F^T + dilation I = [[a, b], [b, c]]

The determinant of cov2d is summed from squares (Cauchy-Binet) instead of a c - b^2, which would cancel for
long thin splats. Kernels work on blocks of Gaussians: a block is copied to one scratch buffer, a row of BLOCK
floats for each quantity, so that the arithmetic runs across Gaussians in vector registers. Blocks are fixed,
so results do not depend on the number of threads.
"""

import math

import numpy as np

from compgs.cameras import Camera
from compgs.numerics.compiled import chunk_of, njit
from compgs.render.settings import RasterSettings, jacobian_limits

# No "nnan", "ninf": comparisons with NaN decide what is drawn.
FASTMATH = {"contract", "nsz", "arcp"}
f32 = np.float32
ZERO, HALF, ONE, TWO = f32(0), f32(0.5), f32(1), f32(2)
# A splat beyond these is not drawn: the squares of its numbers may overflow.
LARGEST_MEAN = f32(1e9)  # pixels
LARGEST_VARIANCE = f32(1e15)  # pixels^2
LARGEST_DETERMINANT = f32(1e30)  # pixels^4

# Rows of the scratch buffer. Unsigned indices: with signed ones the loops are not vectorized.
U = np.uint64
BLOCK = 128
N_BLOCK = U(BLOCK)
MX, MY, MZ = U(0), U(BLOCK), U(2 * BLOCK)
QW, QX, QY, QZ = U(3 * BLOCK), U(4 * BLOCK), U(5 * BLOCK), U(6 * BLOCK)
SX, SY, SZ = U(7 * BLOCK), U(8 * BLOCK), U(9 * BLOCK)
OUT_U, OUT_V, OUT_A, OUT_B, OUT_C = U(10 * BLOCK), U(11 * BLOCK), U(12 * BLOCK), U(13 * BLOCK), U(14 * BLOCK)
OUT_Z, OUT_DET = U(15 * BLOCK), U(16 * BLOCK)
GRAD_U, GRAD_V, GRAD_A, GRAD_B, GRAD_C = (
    U(10 * BLOCK),
    U(11 * BLOCK),
    U(12 * BLOCK),
    U(13 * BLOCK),
    U(14 * BLOCK),
)
DRAWN = U(15 * BLOCK)
SCRATCH = 17 * BLOCK


def camera_numbers(camera: Camera, settings: RasterSettings) -> np.ndarray:
    """[22] float32: rotation, translation, fx, fy, cx, cy, Jacobian limits (4), near plane, dilation."""
    return np.array(
        [
            *camera.rotation.ravel(),
            *camera.translation,
            *(camera.fx, camera.fy, camera.cx, camera.cy),
            *jacobian_limits(camera, settings),
            *(settings.near_plane, settings.dilation_of(camera)),
        ],
        dtype=np.float32,
    )


def kept_opacity(covariances: np.ndarray, determinants: np.ndarray, dilation: float) -> np.ndarray:
    """[M] float32, 0 to 1: the share of a splat's opacity that stays where dilation spreads it (`antialiased`), from
    covariances [M, 3] and determinants [M] after it.

    The determinant before it is what is left of that after it. Rounding makes a share wrong by 1.5e-7 of its inverse:
    1 % where an opaque splat vanishes, less elsewhere.
    """
    a, c = covariances[:, 0].astype(np.float64), covariances[:, 2].astype(np.float64)
    before = determinants - dilation * (a + c) + dilation**2
    return np.sqrt(np.clip(before / determinants, 0, 1)).astype(np.float32)


@njit(inline="always")
def load_block(s, first, count, means, quaternions, scales):
    """Copies `count` Gaussians to the scratch buffer, one row of floats per quantity."""
    for i in range(N_BLOCK):
        j = first + min(np.int64(i), count - 1)  # a short block repeats its last Gaussian
        s[i + MX] = means[j, 0]
        s[i + MY] = means[j, 1]
        s[i + MZ] = means[j, 2]
        s[i + QW] = quaternions[j, 0]
        s[i + QX] = quaternions[j, 1]
        s[i + QY] = quaternions[j, 2]
        s[i + QZ] = quaternions[j, 3]
        s[i + SX] = scales[j, 0]
        s[i + SY] = scales[j, 1]
        s[i + SZ] = scales[j, 2]


@njit(parallel=True, fastmath=FASTMATH, error_model="numpy")
def project_forward(means, quaternions, scales, k, means2d, covariances, depths, determinants, part):
    """Fills means2d [M, 2], covariances [M, 3], depths [M], determinants [M]; a depth of inf: not drawn."""
    m = means.shape[0]
    for block in chunk_of((m + BLOCK - 1) // BLOCK, part):
        first = block * BLOCK
        count = min(BLOCK, m - first)
        r00, r01, r02 = k[0], k[1], k[2]
        r10, r11, r12 = k[3], k[4], k[5]
        r20, r21, r22 = k[6], k[7], k[8]
        tx, ty, tz = k[9], k[10], k[11]
        fx, fy, cx, cy = k[12], k[13], k[14], k[15]
        left, right, top, bottom, near, dilation = k[16], k[17], k[18], k[19], k[20], k[21]
        s = np.empty(SCRATCH, np.float32)
        load_block(s, first, count, means, quaternions, scales)
        for i in range(N_BLOCK):
            x = r00 * s[i + MX] + r01 * s[i + MY] + r02 * s[i + MZ] + tx
            y = r10 * s[i + MX] + r11 * s[i + MY] + r12 * s[i + MZ] + ty
            z = r20 * s[i + MX] + r21 * s[i + MY] + r22 * s[i + MZ] + tz
            inv_z = ONE / z
            x_z, y_z = x * inv_z, y * inv_z
            u, v = fx * x_z + cx, fy * y_z + cy
            j00, j02 = fx * inv_z, -fx * min(max(x_z, left), right) * inv_z
            j11, j12 = fy * inv_z, -fy * min(max(y_z, top), bottom) * inv_z
            # T = J R, then F = T R(q) diag(s)
            t00, t01, t02 = j00 * r00 + j02 * r20, j00 * r01 + j02 * r21, j00 * r02 + j02 * r22
            t10, t11, t12 = j11 * r10 + j12 * r20, j11 * r11 + j12 * r21, j11 * r12 + j12 * r22
            qw, qx, qy, qz = s[i + QW], s[i + QX], s[i + QY], s[i + QZ]
            n = TWO / (qw * qw + qx * qx + qy * qy + qz * qz)
            xx, yy, zz = n * qx * qx, n * qy * qy, n * qz * qz
            xy, xz, yz = n * qx * qy, n * qx * qz, n * qy * qz
            wx, wy, wz = n * qw * qx, n * qw * qy, n * qw * qz
            s0, s1, s2 = s[i + SX], s[i + SY], s[i + SZ]
            f00 = (t00 * (ONE - yy - zz) + t01 * (xy + wz) + t02 * (xz - wy)) * s0
            f01 = (t00 * (xy - wz) + t01 * (ONE - xx - zz) + t02 * (yz + wx)) * s1
            f02 = (t00 * (xz + wy) + t01 * (yz - wx) + t02 * (ONE - xx - yy)) * s2
            f10 = (t10 * (ONE - yy - zz) + t11 * (xy + wz) + t12 * (xz - wy)) * s0
            f11 = (t10 * (xy - wz) + t11 * (ONE - xx - zz) + t12 * (yz + wx)) * s1
            f12 = (t10 * (xz + wy) + t11 * (yz - wx) + t12 * (ONE - xx - yy)) * s2
            a = f00 * f00 + f01 * f01 + f02 * f02
            b = f00 * f10 + f01 * f11 + f02 * f12
            c = f10 * f10 + f11 * f11 + f12 * f12
            d01, d02, d12 = f00 * f11 - f01 * f10, f00 * f12 - f02 * f10, f01 * f12 - f02 * f11
            det = d01 * d01 + d02 * d02 + d12 * d12 + dilation * (a + c) + dilation * dilation
            drawn = (z >= near) & (det > ZERO) & (det < LARGEST_DETERMINANT)
            drawn = drawn & (abs(u) < LARGEST_MEAN) & (abs(v) < LARGEST_MEAN)
            drawn = drawn & (a < LARGEST_VARIANCE) & (c < LARGEST_VARIANCE)
            s[i + OUT_U] = u if drawn else ZERO
            s[i + OUT_V] = v if drawn else ZERO
            s[i + OUT_A] = a + dilation if drawn else ONE
            s[i + OUT_B] = b if drawn else ZERO
            s[i + OUT_C] = c + dilation if drawn else ONE
            s[i + OUT_Z] = z if drawn else f32(np.inf)
            s[i + OUT_DET] = det if drawn else ONE
        for i in range(U(count)):
            j = first + np.int64(i)
            means2d[j, 0] = s[i + OUT_U]
            means2d[j, 1] = s[i + OUT_V]
            covariances[j, 0] = s[i + OUT_A]
            covariances[j, 1] = s[i + OUT_B]
            covariances[j, 2] = s[i + OUT_C]
            depths[j] = s[i + OUT_Z]
            determinants[j] = s[i + OUT_DET]


@njit(parallel=True, fastmath=FASTMATH, error_model="numpy")
def project_backward(
    means,
    quaternions,
    scales,
    k,
    depths,
    grad_means2d,
    grad_covariances,
    grad_means,
    grad_quaternions,
    grad_scales,
    part,
):
    """Gradients to means [M, 3], quaternions [M, 4] and scales [M, 3]; zero where a Gaussian is not drawn."""
    m = means.shape[0]
    for block in chunk_of((m + BLOCK - 1) // BLOCK, part):
        first = block * BLOCK
        count = min(BLOCK, m - first)
        r00, r01, r02 = k[0], k[1], k[2]
        r10, r11, r12 = k[3], k[4], k[5]
        r20, r21, r22 = k[6], k[7], k[8]
        tx, ty, tz = k[9], k[10], k[11]
        fx, fy = k[12], k[13]
        left, right, top, bottom = k[16], k[17], k[18], k[19]
        s = np.empty(SCRATCH, np.float32)
        load_block(s, first, count, means, quaternions, scales)
        for i in range(N_BLOCK):
            j = first + min(np.int64(i), count - 1)
            s[i + GRAD_U] = grad_means2d[j, 0]
            s[i + GRAD_V] = grad_means2d[j, 1]
            s[i + GRAD_A] = grad_covariances[j, 0]
            s[i + GRAD_B] = grad_covariances[j, 1]
            s[i + GRAD_C] = grad_covariances[j, 2]
            s[i + DRAWN] = ONE if depths[j] < f32(np.inf) else ZERO
        for i in range(N_BLOCK):
            drawn = s[i + DRAWN] > ZERO
            x = r00 * s[i + MX] + r01 * s[i + MY] + r02 * s[i + MZ] + tx
            y = r10 * s[i + MX] + r11 * s[i + MY] + r12 * s[i + MZ] + ty
            z = r20 * s[i + MX] + r21 * s[i + MY] + r22 * s[i + MZ] + tz
            inv_z = ONE / z
            x_z, y_z = x * inv_z, y * inv_z
            cut_x, cut_y = min(max(x_z, left), right), min(max(y_z, top), bottom)
            j00, j02 = fx * inv_z, -fx * cut_x * inv_z
            j11, j12 = fy * inv_z, -fy * cut_y * inv_z
            t00, t01, t02 = j00 * r00 + j02 * r20, j00 * r01 + j02 * r21, j00 * r02 + j02 * r22
            t10, t11, t12 = j11 * r10 + j12 * r20, j11 * r11 + j12 * r21, j11 * r12 + j12 * r22
            qw, qx, qy, qz = s[i + QW], s[i + QX], s[i + QY], s[i + QZ]
            inv_norm = ONE / math.sqrt(qw * qw + qx * qx + qy * qy + qz * qz)
            qw, qx, qy, qz = qw * inv_norm, qx * inv_norm, qy * inv_norm, qz * inv_norm
            q00, q01, q02 = (
                ONE - TWO * (qy * qy + qz * qz),
                TWO * (qx * qy - qw * qz),
                TWO * (qx * qz + qw * qy),
            )
            q10, q11, q12 = (
                TWO * (qx * qy + qw * qz),
                ONE - TWO * (qx * qx + qz * qz),
                TWO * (qy * qz - qw * qx),
            )
            q20, q21, q22 = (
                TWO * (qx * qz - qw * qy),
                TWO * (qy * qz + qw * qx),
                ONE - TWO * (qx * qx + qy * qy),
            )
            s0, s1, s2 = s[i + SX], s[i + SY], s[i + SZ]
            # columns of R(q) diag(s), then F = T R(q) diag(s)
            m00, m10, m20 = q00 * s0, q10 * s0, q20 * s0
            m01, m11, m21 = q01 * s1, q11 * s1, q21 * s1
            m02, m12, m22 = q02 * s2, q12 * s2, q22 * s2
            f00, f10 = t00 * m00 + t01 * m10 + t02 * m20, t10 * m00 + t11 * m10 + t12 * m20
            f01, f11 = t00 * m01 + t01 * m11 + t02 * m21, t10 * m01 + t11 * m11 + t12 * m21
            f02, f12 = t00 * m02 + t01 * m12 + t02 * m22, t10 * m02 + t11 * m12 + t12 * m22
            # cov2d = F F^T: dL/dF = 2 sym(dL/dcov2d) F; b stands for both off-diagonal entries
            ga, gb, gc = TWO * s[i + GRAD_A], s[i + GRAD_B], TWO * s[i + GRAD_C]
            g00, g10 = ga * f00 + gb * f10, gb * f00 + gc * f10
            g01, g11 = ga * f01 + gb * f11, gb * f01 + gc * f11
            g02, g12 = ga * f02 + gb * f12, gb * f02 + gc * f12
            # dL/dT = dL/dF (R(q) diag(s))^T
            gt00 = g00 * m00 + g01 * m01 + g02 * m02
            gt01 = g00 * m10 + g01 * m11 + g02 * m12
            gt02 = g00 * m20 + g01 * m21 + g02 * m22
            gt10 = g10 * m00 + g11 * m01 + g12 * m02
            gt11 = g10 * m10 + g11 * m11 + g12 * m12
            gt12 = g10 * m20 + g11 * m21 + g12 * m22
            # H = T^T dL/dF; dL/ds_k = column k of R(q) . column k of H; dL/dR(q) = H diag(s)
            h00, h10, h20 = t00 * g00 + t10 * g10, t01 * g00 + t11 * g10, t02 * g00 + t12 * g10
            h01, h11, h21 = t00 * g01 + t10 * g11, t01 * g01 + t11 * g11, t02 * g01 + t12 * g11
            h02, h12, h22 = t00 * g02 + t10 * g12, t01 * g02 + t11 * g12, t02 * g02 + t12 * g12
            gs0 = h00 * q00 + h10 * q10 + h20 * q20
            gs1 = h01 * q01 + h11 * q11 + h21 * q21
            gs2 = h02 * q02 + h12 * q12 + h22 * q22
            h00, h10, h20 = h00 * s0, h10 * s0, h20 * s0
            h01, h11, h21 = h01 * s1, h11 * s1, h21 * s1
            h02, h12, h22 = h02 * s2, h12 * s2, h22 * s2
            # dL/d(unit quaternion), then through the normalization
            gw = TWO * (qx * (h21 - h12) + qy * (h02 - h20) + qz * (h10 - h01))
            gx = TWO * (qy * (h01 + h10) + qz * (h02 + h20) + qw * (h21 - h12) - TWO * qx * (h11 + h22))
            gy = TWO * (qx * (h01 + h10) + qz * (h12 + h21) + qw * (h02 - h20) - TWO * qy * (h00 + h22))
            gz = TWO * (qx * (h02 + h20) + qy * (h12 + h21) + qw * (h10 - h01) - TWO * qz * (h00 + h11))
            along = gw * qw + gx * qx + gy * qy + gz * qz
            # dL/dJ = dL/dT R^T, then J and mean2d to camera axes
            gj00 = gt00 * r00 + gt01 * r01 + gt02 * r02
            gj02 = gt00 * r20 + gt01 * r21 + gt02 * r22
            gj11 = gt10 * r10 + gt11 * r11 + gt12 * r12
            gj12 = gt10 * r20 + gt11 * r21 + gt12 * r22
            gu, gv = s[i + GRAD_U], s[i + GRAD_V]
            # J02 = -fx (x/z) / z where x/z is within the limits, -fx limit / z beyond them
            inside_x, inside_y = x_z == cut_x, y_z == cut_y
            to_x = fx * inv_z * (gu - (gj02 * inv_z if inside_x else ZERO))
            to_y = fy * inv_z * (gv - (gj12 * inv_z if inside_y else ZERO))
            factor_x, factor_y = TWO if inside_x else ONE, TWO if inside_y else ONE
            to_z = fx * inv_z * (factor_x * cut_x * gj02 * inv_z - x_z * gu - gj00 * inv_z)
            to_z += fy * inv_z * (factor_y * cut_y * gj12 * inv_z - y_z * gv - gj11 * inv_z)
            s[i + MX] = r00 * to_x + r10 * to_y + r20 * to_z if drawn else ZERO
            s[i + MY] = r01 * to_x + r11 * to_y + r21 * to_z if drawn else ZERO
            s[i + MZ] = r02 * to_x + r12 * to_y + r22 * to_z if drawn else ZERO
            s[i + QW] = (gw - qw * along) * inv_norm if drawn else ZERO
            s[i + QX] = (gx - qx * along) * inv_norm if drawn else ZERO
            s[i + QY] = (gy - qy * along) * inv_norm if drawn else ZERO
            s[i + QZ] = (gz - qz * along) * inv_norm if drawn else ZERO
            s[i + SX] = gs0 if drawn else ZERO
            s[i + SY] = gs1 if drawn else ZERO
            s[i + SZ] = gs2 if drawn else ZERO
        for i in range(U(count)):
            j = first + np.int64(i)
            grad_means[j, 0] = s[i + MX]
            grad_means[j, 1] = s[i + MY]
            grad_means[j, 2] = s[i + MZ]
            grad_quaternions[j, 0] = s[i + QW]
            grad_quaternions[j, 1] = s[i + QX]
            grad_quaternions[j, 2] = s[i + QY]
            grad_quaternions[j, 3] = s[i + QZ]
            grad_scales[j, 0] = s[i + SX]
            grad_scales[j, 1] = s[i + SY]
            grad_scales[j, 2] = s[i + SZ]
