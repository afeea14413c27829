"""The inner loops of edges in images, compiled by numba once and kept: colours between pixels,
votes for lines.
"""

import numpy as np
from numba import njit

from lrfcal_lib.model import camera

COMPILED = {"cache": True, "error_model": "numpy", "nogil": True}

lens_terms = njit(**COMPILED)(camera.lens_terms)


@njit(**COMPILED)
def bilinear(image, uv, lens, fold, out):
    """Colours (n, channels) of a recorded image at undistorted pixels (n, 2); NaN outside of it.

    `lens` is :attr:`lrfcal_lib.model.camera.CameraModel.parameters`, `fold` where its radial
    distortion no longer grows (:func:`lrfcal_lib.model.camera.fold`): it would fold points beyond
    back into the image.
    """
    height, width, channels = image.shape
    fx, fy, cx, cy, k1, k2, k3, k4, k5 = lens
    for i in range(len(uv)):
        x = (uv[i, 0] - cx) / fx
        y = (uv[i, 1] - cy) / fy
        growth, shift_x, shift_y = lens_terms(x, y, k1, k2, k3, k4, k5)
        u = (x * (1 + growth) + shift_x) * fx + cx
        v = (y * (1 + growth) + shift_y) * fy + cy
        if not (x * x + y * y < fold and 0 <= u < width - 1 and 0 <= v < height - 1):
            out[i] = np.nan
            continue
        column = int(u)
        row = int(v)
        right = np.float32(u - column)
        down = np.float32(v - row)
        left = np.float32(1) - right
        up = np.float32(1) - down
        for c in range(channels):
            top = (
                np.float32(image[row, column, c]) * left
                + np.float32(image[row, column + 1, c]) * right
            )
            bottom = (
                np.float32(image[row + 1, column, c]) * left
                + np.float32(image[row + 1, column + 1, c]) * right
            )
            out[i, c] = top * up + bottom * down


@njit(**COMPILED)
def vote(column, place, weight, shape, slopes):
    """Weight of the profiles with a peak near each line ``place = offset + slope (column -
    middle)``, (m, across).

    `shape` is (across, along) of the strip, `column` ascends; a sample to either side still agrees,
    and of the peaks of one profile that agree with a line the highest counts.
    """
    votes = np.zeros((len(slopes), shape[0]))
    for line in range(len(slopes)):
        counted = np.full(shape[0], -1)
        highest = np.zeros(shape[0])
        for i in range(len(column)):
            near = int(np.rint(place[i] - slopes[line] * (column[i] - (shape[1] - 1) / 2)))
            for offset in range(max(near - 1, 0), min(near + 2, shape[0])):
                before = highest[offset] if counted[offset] == column[i] else 0.0
                if weight[i] > before:
                    votes[line, offset] += weight[i] - before
                    counted[offset] = column[i]
                    highest[offset] = weight[i]
    return votes
