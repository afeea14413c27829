"""The inner loops of colouring, compiled by numba once and kept: depth buffer of points, colours out of an image."""

import math

from numba import njit

COMPILED = {"cache": True, "fastmath": {"nsz", "arcp", "contract"}, "error_model": "numpy", "nogil": True}


@njit(inline="always", **COMPILED)
def _pixel(x, y, z, pose, lens):
    """Pixel and distance of a platform point; a negative distance behind the camera or beyond the fold of its lens."""
    a = pose[0, 0] * x + pose[0, 1] * y + pose[0, 2] * z + pose[0, 3]
    b = pose[1, 0] * x + pose[1, 1] * y + pose[1, 2] * z + pose[1, 3]
    c = pose[2, 0] * x + pose[2, 1] * y + pose[2, 2] * z + pose[2, 3]
    if not c > 0:  # NaN too
        return 0.0, 0.0, -1.0
    distance = math.sqrt(a * a + b * b + c * c)
    a, b = a / c, b / c
    r2 = a * a + b * b
    if r2 >= lens[9]:
        return 0.0, 0.0, -1.0
    radial = 1 + r2 * (lens[4] + r2 * (lens[5] + r2 * lens[8]))
    u = a * radial + 2 * lens[6] * a * b + lens[7] * (r2 + 2 * a * a)
    v = b * radial + lens[6] * (r2 + 2 * b * b) + 2 * lens[7] * a * b
    return lens[0] * u + lens[2], lens[1] * v + lens[3], distance


@njit(**COMPILED)
def hide(points, pose, lens, width, height, cell, nearest):
    """Write the distances (metres) of points (n, 3) into a depth buffer with square cells of a size in pixels."""
    for i in range(len(points)):
        u, v, distance = _pixel(points[i, 0], points[i, 1], points[i, 2], pose, lens)
        if distance > 0 and -0.5 <= u < width - 0.5 and -0.5 <= v < height - 0.5:
            row, column = int((v + 0.5) / cell), int((u + 0.5) / cell)
            nearest[row, column] = min(nearest[row, column], distance)


@njit(**COMPILED)
def paint(points, normals, pose, lens, image, cell, nearest, noise, exposure, sums, best, source, number):
    """Add what one image (blue, green, red) says about the colours of points (n, 3) to `sums` (n, 4).

    `sums` are weighted red, green and blue in the exposure of all images together, and the weight: the cosine of
    incidence by the squared distance, next to nothing where the image is too dark or too bright. `source` becomes the
    `number` of the image where its weight is above `best`. A point is seen unless it lies behind the nearest one of its
    cell by more than the `noise` (metres) and the slant of its surface over a cell.
    """
    height, width = image.shape[0], image.shape[1]
    x0 = -(pose[0, 0] * pose[0, 3] + pose[1, 0] * pose[1, 3] + pose[2, 0] * pose[2, 3])
    y0 = -(pose[0, 1] * pose[0, 3] + pose[1, 1] * pose[1, 3] + pose[2, 1] * pose[2, 3])
    z0 = -(pose[0, 2] * pose[0, 3] + pose[1, 2] * pose[1, 3] + pose[2, 2] * pose[2, 3])
    for i in range(len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        u, v, distance = _pixel(x, y, z, pose, lens)
        if not distance > 0 or not (-0.5 <= u < width - 0.5 and -0.5 <= v < height - 0.5):
            continue
        along = normals[i, 0] * (x - x0) + normals[i, 1] * (y - y0) + normals[i, 2] * (z - z0)
        cosine = min(max(abs(along) / distance, 0.1), 1.0)
        slant = cell / lens[0] * distance * math.sqrt(1 - cosine * cosine) / cosine
        if distance > nearest[int((v + 0.5) / cell), int((u + 0.5) / cell)] + noise + slant:
            continue
        u0, v0 = min(max(u, 0.0), width - 1.0), min(max(v, 0.0), height - 1.0)
        column, row = min(int(u0), width - 2), min(int(v0), height - 2)
        f, g = u0 - column, v0 - row
        a, b, c, d = (1 - f) * (1 - g), f * (1 - g), (1 - f) * g, f * g
        first, second = image[row, column], image[row, column + 1]
        third, fourth = image[row + 1, column], image[row + 1, column + 1]
        blue = a * first[0] + b * second[0] + c * third[0] + d * fourth[0]
        green = a * first[1] + b * second[1] + c * third[1] + d * fourth[1]
        red = a * first[2] + b * second[2] + c * third[2] + d * fourth[2]
        weight = cosine / (distance * distance)
        if max(red, green, blue) > 248 or max(red, green, blue) < 6:
            weight *= 1e-3
        radius = ((u - lens[2]) ** 2 + (v - lens[3]) ** 2) / (0.25 * (width * width + height * height))
        scale = weight * math.exp(-exposure[0] - exposure[1] * radius)
        sums[i, 0] += scale * red
        sums[i, 1] += scale * green
        sums[i, 2] += scale * blue
        sums[i, 3] += weight
        if weight > best[i]:
            best[i], source[i] = weight, number
