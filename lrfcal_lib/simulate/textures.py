"""Textures of things: brightness of red, green and blue by the place on a surface, metres."""

import numpy as np
from numpy.typing import ArrayLike
from scipy.ndimage import map_coordinates

LINE = 0.0055  # metres, of a printed page
# random values that textures are made of
LATTICE = np.random.default_rng(20091001).random((64,) * 3)


def whole_below(values):
    """The largest whole numbers that are not above values."""
    return np.floor(values).astype(int)


def value_noise(points, cell):
    """Smooth noise (n,) between 0 and 1, from random values on a lattice of cells, metres."""
    low, above = np.divmod(points / cell, 1)
    soft = above * above * (3 - 2 * above)
    return map_coordinates(LATTICE, (low + soft).T, order=1, mode="grid-wrap")


def plain(
    points: np.ndarray, color: ArrayLike, rough: float = 0.0, cell: float = 0.15
) -> np.ndarray:
    """One colour, with a soft variation.

    Parameters
    ----------
    points
        Shape (n, 3), metres.
    color
        Albedo, shape (3,).
    rough
        Share of the variation.
    cell
        Its size, metres.

    Returns
    -------
    ndarray, shape (n, 3) or (3,)
    """
    if not rough:
        return np.asarray(color)
    tone = 1 + rough * (value_noise(points, cell) - 0.5)
    return tone[:, None] * color


def wood(points, color, cell=(0.5, 0.03, 0.03)):
    """Grain along x."""
    return plain(points, color, 0.4, cell)


def planks(points, color):
    """A wooden floor: boards of 0.18 m by 1.4 m along y with dark joints."""
    across = points[:, 0] / 0.18
    row = whole_below(across)
    board = whole_below(points[:, 1] / 1.4 + 0.37 * row)
    tone = LATTICE[row & 63, board & 63, 7]
    dark = np.where(from_whole(across) * 0.18 < 0.002, 0.55, 1.0)
    return wood(points, color, (0.03, 0.6, 1.0)) * ((0.85 + 0.3 * tone) * dark)[:, None]


def from_whole(values):
    """How far values are from the nearest whole number."""
    return np.abs(values - np.round(values))


def stripes(points, first, second, period, axis=0):
    """Two colours in turn along an axis."""
    stripe = whole_below(2 * points[:, axis] / period)
    return np.array([first, second], float)[stripe & 1]


def tiles(points, color, joint, size):
    """Square tiles in x and z with joints of 4 mm."""
    at = points[:, [0, 2]] / size
    near = from_whole(at).min(axis=1) * size < 0.002
    return np.where(near[:, None], joint, plain(points, color, 0.12, size))


def printed_page(points, width, height):
    """White paper in the plane z = 0 about the origin: words as dark bars, heading, picture."""
    across, up, _ = points.T
    x = across / width + 0.5
    y = 0.5 - up / height
    lines = up / LINE
    row = whole_below(lines)
    word = whole_below((across + 0.31 * row * LINE) / (2.1 * LINE))
    ink = LATTICE[row & 63, word & 63, 3] > 0.22
    ink &= np.mod(lines, 1.0) < 0.5
    ink &= between(x, 0.1, 0.9) & between(y, 0.18, 0.93)
    ink |= between(x, 0.2, 0.8) & between(y, 0.075, 0.125)
    picture = between(x, 0.52, 0.88) & between(y, 0.55, 0.8)
    shades = 0.25 + 0.5 * value_noise(points, 0.02)
    return np.select([picture, ink], [shades, 0.12], 0.86)[:, None]


def between(values, low, high):
    """Which values lie within two limits."""
    return (values > low) & (values < high)


def poster(points, width, height, colors):
    """A picture: hills under a sky with a sun, in the plane z = 0 about the origin."""
    sky, sun, far, near = colors
    across, up, _ = points.T
    x = across / width + 0.5
    y = up / height + 0.5
    out = (0.7 + 0.4 * y)[:, None] * sky
    from_sun = np.hypot(across - 0.2 * width, up - 0.2 * height)
    far_hills = 0.45 + 0.12 * np.sin(7 * x + 1)
    near_hills = 0.25 + 0.08 * np.sin(11 * x)
    inside = between(x, 0.03, 0.97) & between(y, 0.02, 0.98)
    out[from_sun < 0.11 * width] = sun
    out[y < far_hills] = far
    out[y < near_hills] = near
    out[~inside] = 0.85
    return out


def book_spines(points, seed):
    """Coloured backs of books side by side along x, 35 mm each."""
    rng = np.random.default_rng(seed)
    tones = rng.uniform(0.1, 0.6, (64, 1))
    palette = tones * (0.55 + rng.uniform(0.0, 0.6, (64, 3)))
    at = points[:, 0] / 0.035
    color = palette[whole_below(at) & 63]
    label = between(np.mod(points[:, 2], 0.3), 0.19, 0.225)
    color[label] = 0.75
    color[from_whole(at) < 0.05] = 0.04  # the gaps between books
    return color


def chessboard(points, board, dark, light, ring=0.5):
    """A dark board with its chessboard, if it has one.

    The square diagonally before the first inner corner is light. The outermost squares are `ring`
    squares wide: only inner corners count, so that all may be larger.
    """
    grey = np.full(len(points), float(dark))
    pattern = board.pattern
    if pattern is not None:
        at = (points[:, :2] - pattern.origin) / pattern.square
        end = [pattern.columns - 1 + ring, pattern.rows - 1 + ring]
        inside = between(at, -ring, end).all(axis=1)
        even = whole_below(at).sum(axis=1) % 2 == 0
        grey[inside & even] = light
    return grey[:, None]
