"""The residual of the paper's lines, compiled by numba once and kept: forty a camera, a thousand times over.

What the loop computes is equations (16), (19) and (20) of Li et al. 2009, their derivatives and their noise; tests
compare it with differences and with plain arrays.
"""

import math

from numba import float64, njit, types

_GIVEN = [types.Array(float64, dimensions, "C", readonly=True) for dimensions in (3, 3, 4, 3, 2, 1)]
_FILLED = [float64[:, ::1], float64[:, ::1], float64[:, :, ::1], float64[:, :, ::1]]


@njit(types.void(*_GIVEN, *_FILLED), cache=True, error_model="numpy", nogil=True)
def line_rows(poses, points, covariances, lines, line_sigma, camera, residuals, whitener, jacobian, corrected):
    """Fill residuals and whitener (t, n), Jacobian and its correction (t, n, 6) of points and lines under poses.

    Of poses (t, 3, 4), points, covariances, lines and their sigma there is one set for each trial or one for all;
    `camera` is fx, fy, cx, cy.
    """
    fx, fy, cx, cy = camera
    for t in range(len(residuals)):
        (r00, r01, r02, tx), (r10, r11, r12, ty), (r20, r21, r22, tz) = poses[t % len(poses)]
        own, spread = t % len(points), t % len(covariances)
        line, sigma = t % len(lines), t % len(line_sigma)
        for i in range(points.shape[1]):
            px, py, pz = points[own, i]
            x, y, z = r00 * px + r01 * py + r02 * pz, r10 * px + r11 * py + r12 * pz, r20 * px + r21 * py + r22 * pz
            l0, l1, l2 = lines[line, i]
            depth = z + tz
            slope = (l0 * fx * (x + tx) + l1 * fy * (y + ty)) / depth
            residual = slope + l0 * cx + l1 * cy + l2
            a, b, c = l0 * fx / depth, l1 * fy / depth, -slope / depth  # gradient by the moved point
            sx, sy, sz = r00 * a + r10 * b + r20 * c, r01 * a + r11 * b + r21 * c, r02 * a + r12 * b + r22 * c
            C = covariances[spread, i]
            ux = C[0, 0] * sx + C[0, 1] * sy + C[0, 2] * sz
            uy = C[1, 0] * sx + C[1, 1] * sy + C[1, 2] * sz
            uz = C[2, 0] * sx + C[2, 1] * sy + C[2, 2] * sz
            variance = sx * ux + sy * uy + sz * uz
            # how the noise pulls the point, and what that changes in the gradient (see geometry.noise_correction)
            kx, ky, kz = r00 * ux + r01 * uy + r02 * uz, r10 * ux + r11 * uy + r12 * uz, r20 * ux + r21 * uy + r22 * uz
            da, db, dc = -a * kz / depth, -b * kz / depth, -(c * kz + variance) / depth
            variance += line_sigma[sigma, i] ** 2
            factor = residual / variance
            residuals[t, i], whitener[t, i] = residual, 1 / math.sqrt(variance)
            row, moved = jacobian[t, i], corrected[t, i]
            row[0], row[1], row[2], row[3], row[4], row[5] = y * c - z * b, z * a - x * c, x * b - y * a, a, b, c
            moved[0] = row[0] - factor * (ky * c - kz * b + y * dc - z * db)
            moved[1] = row[1] - factor * (kz * a - kx * c + z * da - x * dc)
            moved[2] = row[2] - factor * (kx * b - ky * a + x * db - y * da)
            moved[3], moved[4], moved[5] = a - factor * da, b - factor * db, c - factor * dc
