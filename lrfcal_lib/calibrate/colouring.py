"""The inner loops of colouring, compiled by numba once and kept: depth buffer of points, colours
out of an image.

Points pass in tiles that stay in the processor's cache: the pixels of a whole tile without a
branch, in single precision and column by column, so that the compiler takes many at once; then what
the few in the image need.
"""

import math

import numpy as np
from numba import njit

from lrfcal_lib.model import camera

COMPILED = {
    "cache": True,
    "fastmath": {"nsz", "arcp", "contract"},
    "error_model": "numpy",
    "nogil": True,
}
TILE = 1024
LEAST_COSINE = 0.1  # of incidence

lens_terms = njit(**COMPILED)(camera.lens_terms)


@njit(**COMPILED)
def _locate(points, pose, lens, size, cell, rows, at):
    """Fill `rows` with x, y, z of a tile of platform points, their pixels and distances, `at` with
    their cells.

    The cell is -1 behind the camera, beyond the fold of its lens and outside the image.
    """
    x = rows[0]
    y = rows[1]
    z = rows[2]
    u = rows[3]
    v = rows[4]
    far = rows[5]
    for i in range(len(points)):
        x[i], y[i], z[i] = points[i, 0], points[i, 1], points[i, 2]
    r00, r01, r02, t0 = pose[0]
    r10, r11, r12, t1 = pose[1]
    r20, r21, r22, t2 = pose[2]
    fx, fy, cx, cy, k1, k2, p1, p2, k5, fold = lens
    zero = np.float32(0)
    half = np.float32(0.5)
    one = np.float32(1)
    share = np.float32(1 / cell)
    right = np.float32(size[0])
    low = np.float32(size[1])
    columns = np.int32(size[0] / cell + 1)
    for i in range(len(points)):
        a = r00 * x[i] + r01 * y[i] + r02 * z[i] + t0
        b = r10 * x[i] + r11 * y[i] + r12 * z[i] + t1
        c = r20 * x[i] + r21 * y[i] + r22 * z[i] + t2
        far[i] = math.sqrt(a * a + b * b + c * c)
        a = a / c
        b = b / c
        growth, shift_a, shift_b = lens_terms(a, b, k1, k2, p1, p2, k5)
        u[i] = fx * (a * (one + growth) + shift_a) + cx
        v[i] = fy * (b * (one + growth) + shift_b) + cy
        column = u[i] + half
        row = v[i] + half
        inside = (
            (c > zero)
            & (a * a + b * b < fold)
            & (column >= zero)
            & (column < right)
            & (row >= zero)
            & (row < low)
        )
        column = column if inside else zero
        row = row if inside else zero
        cell_of_it = np.int32(row * share) * columns + np.int32(column * share)
        at[i] = cell_of_it if inside else np.int32(-1)


@njit(**COMPILED)
def hide(points, pose, lens, size, cell, nearest):
    """Write the distances (metres) of points (n, 3) into a flat depth buffer of square cells,
    `cell` pixels wide.
    """
    rows = np.empty((6, TILE), np.float32)
    at = np.empty(TILE, np.int32)
    far = rows[5]
    for start in range(0, len(points), TILE):
        count = min(TILE, len(points) - start)
        _locate(points[start : start + count], pose, lens, size, cell, rows, at)
        for i in range(count):
            if at[i] >= 0:
                nearest[at[i]] = min(nearest[at[i]], far[i])


@njit(**COMPILED)
def paint(
    points, normals, pose, lens, image, cell, nearest, noise, exposure, sums, best, source, number
):
    """Add what one image (blue, green, red) says about the colours of points (n, 3) to `sums` (n,
    4).

    `sums` are weighted red, green and blue in the exposure of all images together, and the weight:
    the cosine of incidence by the squared distance, next to nothing where the image is too dark or
    too bright. `source` becomes the `number` of the image where its weight is above `best`. A point
    is seen unless it lies behind the nearest one of its cell by more than the `noise` (metres) and
    the slant of its surface over a cell.
    """
    height = image.shape[0]
    width = image.shape[1]
    x0 = -(pose[0, 0] * pose[0, 3] + pose[1, 0] * pose[1, 3] + pose[2, 0] * pose[2, 3])
    y0 = -(pose[0, 1] * pose[0, 3] + pose[1, 1] * pose[1, 3] + pose[2, 1] * pose[2, 3])
    z0 = -(pose[0, 2] * pose[0, 3] + pose[1, 2] * pose[1, 3] + pose[2, 2] * pose[2, 3])
    rows = np.empty((6, TILE), np.float32)
    at = np.empty(TILE, np.int32)
    chosen = np.empty(TILE, np.int32)
    slack = np.float32(noise)
    tone = np.empty(3)
    least = np.float32(1 - cell / lens[0] * math.sqrt(1 - LEAST_COSINE**2) / LEAST_COSINE)
    x, y, z, us, vs, far = rows
    for start in range(0, len(points), TILE):
        count = min(TILE, len(points) - start)
        few = 0
        _locate(points[start : start + count], pose, lens, (width, height), cell, rows, at)
        # those that some incidence would let be seen, counted without a branch
        for i in range(count):
            chosen[few] = i
            few += (at[i] >= 0) & (far[i] * least <= nearest[max(at[i], 0)] + slack)
        for i in chosen[:few]:
            k = start + i
            u = us[i]
            v = vs[i]
            distance = far[i]
            along = (
                normals[k, 0] * (x[i] - x0)
                + normals[k, 1] * (y[i] - y0)
                + normals[k, 2] * (z[i] - z0)
            )
            cosine = abs(along) / distance
            cosine = min(cosine, 1.0) if cosine > LEAST_COSINE else LEAST_COSINE  # NaN too
            if (
                distance
                > nearest[at[i]]
                + noise
                + cell / lens[0] * distance * math.sqrt(1 - cosine * cosine) / cosine
            ):
                continue
            u0 = min(max(u, 0.0), width - 1.0)
            v0 = min(max(v, 0.0), height - 1.0)
            column = min(int(u0), width - 2)
            row = min(int(v0), height - 2)
            f = u0 - column
            g = v0 - row
            a = (1 - f) * (1 - g)
            b = f * (1 - g)
            c = (1 - f) * g
            d = f * g
            brightest = 0.0
            for j in range(3):
                near = a * image[row, column, 2 - j] + b * image[row, column + 1, 2 - j]
                tone[j] = (
                    near + c * image[row + 1, column, 2 - j] + d * image[row + 1, column + 1, 2 - j]
                )
                brightest = max(brightest, tone[j])
            weight = cosine / (distance * distance)
            if not 6 <= brightest <= 248:
                weight *= 1e-3
            radius = ((u - lens[2]) ** 2 + (v - lens[3]) ** 2) / (
                0.25 * (width * width + height * height)
            )
            scale = weight * math.exp(-exposure[0] - exposure[1] * radius)
            for j in range(3):
                sums[k, j] += scale * tone[j]
            sums[k, 3] += weight
            if weight > best[k]:
                best[k] = weight
                source[k] = number


@njit(**COMPILED)
def finish(sums, colors, seen):
    """Colours (n, 3) of `sums`, NaN where no image sees a point, and whether one does."""
    for i in range(len(sums)):
        seen[i] = sums[i, 3] > 0
        for j in range(3):
            colors[i, j] = sums[i, j] / sums[i, 3]
