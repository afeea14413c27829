"""The inner loops of colouring, compiled by numba once and kept.

First the pixels of all points without a branch, in single precision and coordinate by coordinate,
so that the compiler takes many at once; then what the few in the image need.
"""

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from lrfcal_lib.model import camera

COMPILED = {
    "cache": True,
    "fastmath": {"nsz", "arcp", "contract"},
    "error_model": "numpy",
    "nogil": True,
}
LEAST_COSINE = 0.1  # of incidence
# levels: below and above these a brightness is clipped, and next to nothing worth
DARK = 6.0
BRIGHT = 248.0
CLIPPED = 1e-3  # weight of such a colour
# literals would turn single precision into double
ZERO = np.float32(0)
HALF = np.float32(0.5)
ONE = np.float32(1)

# a call, or rows taken out of an array at once, would keep the compiler from taking many at a time
lens_terms = njit(inline="always", **COMPILED)(camera.lens_terms)


class Eye(NamedTuple):
    """An image, all that the loops need of it.

    Attributes
    ----------
    pose : ndarray of float32, shape (3, 4)
        ``T_camera_platform``.
    centre : ndarray of float32, shape (3,)
        Of the camera, platform frame, metres.
    lens : ndarray of float32, shape (10,)
        Intrinsics, and the squared distance from the axis at which the lens folds.
    image : ndarray of uint8, shape (height, width, 3)
        Blue, green, red.
    cell : float
        Width of the depth buffer's square cells, pixels.
    nearest : ndarray of float32, shape (workers, n)
        Depth buffers, flat: distances, metres. Each thread has its own; the first one is that of
        all in the end.
    noise : float
        Metres by which a point may lie behind another one of the same surface.
    exposure : ndarray, shape (2,)
        Logarithms of gain, and of fall-off at the squared distance 1 from the middle.
    number : int
    corner : float
        Squared distance of a corner from the middle, pixels.
    """

    pose: np.ndarray
    centre: np.ndarray
    lens: np.ndarray
    image: np.ndarray
    cell: float
    nearest: np.ndarray
    noise: float
    exposure: np.ndarray
    number: int
    corner: float


@njit(**COMPILED)
def hide(points, eye, worker):
    """Write the distances (metres) of points (3, n) into a depth buffer of an Eye."""
    _, _, far, at = _locate(points, eye)
    nearest = eye.nearest[worker]
    for i in range(len(at)):
        if at[i] >= 0:
            nearest[at[i]] = min(nearest[at[i]], far[i])


@njit(**COMPILED)
def paint(points, normals, eye, sums, best, source):
    """Add what one image says about the colours of points (3, n) to `sums` (n, 4).

    `sums` are weighted blue, green and red in the exposure of all images together, and the weight:
    the cosine of incidence by the squared distance, next to nothing where the image is too dark or
    too bright. `source` becomes the number of the image where its weight is above `best`. A point
    is seen unless it lies behind the nearest one of its cell by more than the noise and the slant
    of its surface over a cell. `normals` are rows, (n, 3).
    """
    lens = eye.lens
    nearest = eye.nearest[0]
    slant = eye.cell / lens[0]  # of a cell, metres at a distance of one
    centre = eye.centre
    tone = np.empty(3)
    u, v, far, at = _locate(points, eye)
    for i in range(len(at)):
        if at[i] < 0:
            continue
        distance = far[i]
        along = 0.0
        for j in range(3):
            along += normals[i, j] * (points[j, i] - centre[j])
        cosine = abs(along) / distance
        cosine = min(cosine, 1.0) if cosine > LEAST_COSINE else LEAST_COSINE  # NaN too
        rise = slant * distance * math.sqrt(1 - cosine * cosine) / cosine
        if distance > nearest[at[i]] + eye.noise + rise:
            continue
        brightest = _tone(eye.image, u[i], v[i], tone)
        weight = cosine / (distance * distance)
        if not DARK <= brightest <= BRIGHT:
            weight *= CLIPPED
        radius = ((u[i] - lens[2]) ** 2 + (v[i] - lens[3]) ** 2) / eye.corner
        scale = weight * math.exp(-eye.exposure[0] - eye.exposure[1] * radius)
        for j in range(3):
            sums[i, j] += scale * tone[j]
        sums[i, 3] += weight
        if weight > best[i]:
            best[i] = weight
            source[i] = eye.number


@njit(**COMPILED)
def _locate(points, eye):
    """Pixels u and v, distances and cells, each (n,), of platform points (3, n).

    The cell is -1 behind the camera, beyond the fold of its lens and outside the image.
    """
    x = points[0]
    y = points[1]
    z = points[2]
    u = np.empty_like(x)
    v = np.empty_like(x)
    far = np.empty_like(x)
    at = np.empty(len(x), np.int32)
    r00, r01, r02, t0 = eye.pose[0]
    r10, r11, r12, t1 = eye.pose[1]
    r20, r21, r22, t2 = eye.pose[2]
    fx, fy, cx, cy, k1, k2, p1, p2, k5, fold = eye.lens
    share = np.float32(1 / eye.cell)
    height, width, _ = eye.image.shape
    right = np.float32(width)
    low = np.float32(height)
    columns = np.int32(width / eye.cell + 1)
    for i in range(len(x)):
        a = r00 * x[i] + r01 * y[i] + r02 * z[i] + t0
        b = r10 * x[i] + r11 * y[i] + r12 * z[i] + t1
        c = r20 * x[i] + r21 * y[i] + r22 * z[i] + t2
        far[i] = math.sqrt(a * a + b * b + c * c)
        a = a / c
        b = b / c
        growth, shift_a, shift_b = lens_terms(a, b, k1, k2, p1, p2, k5)
        u[i] = fx * (a * (ONE + growth) + shift_a) + cx
        v[i] = fy * (b * (ONE + growth) + shift_b) + cy
        column = u[i] + HALF
        row = v[i] + HALF
        inside = (
            (c > ZERO)
            & (a * a + b * b < fold)
            & (column >= ZERO)
            & (column < right)
            & (row >= ZERO)
            & (row < low)
        )
        cell = np.int32(row * share) * columns + np.int32(column * share)
        at[i] = cell if inside else np.int32(-1)
    return u, v, far, at


@njit(**COMPILED)
def _tone(image, u, v, tone):
    """Fill `tone` with blue, green and red of a pixel between four, and return the brightest."""
    height, width, _ = image.shape
    u0 = min(max(u, 0.0), width - 1.0)
    v0 = min(max(v, 0.0), height - 1.0)
    column = min(int(u0), width - 2)
    row = min(int(v0), height - 2)
    f = u0 - column
    g = v0 - row
    brightest = 0.0
    for j in range(3):
        above = (1 - f) * image[row, column, j] + f * image[row, column + 1, j]
        below = (1 - f) * image[row + 1, column, j] + f * image[row + 1, column + 1, j]
        tone[j] = (1 - g) * above + g * below
        brightest = max(brightest, tone[j])
    return brightest
