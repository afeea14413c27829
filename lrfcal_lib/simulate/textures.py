"""Solid textures: functions of points in a thing's own frame that give the albedo (share of light returned).

Every function here makes a texture ``f(points (n, 3)) -> albedo (n, 3)`` in red, green, blue, 0 to 1.
"""

from __future__ import annotations

import numpy as np

_SIZE = 64
_LATTICE = np.random.default_rng(20091001).random((_SIZE,) * 3)


def value_noise(points, cell):
    """Smooth noise between 0 and 1 from random values on a lattice.

    Parameters
    ----------
    points : ndarray, shape (n, 3)
        Metres.
    cell : float or array_like, shape (3,)
        Side of a lattice cell, metres.

    Returns
    -------
    ndarray, shape (n,)
    """
    at = points / cell
    low = np.floor(at).astype(np.int64)
    f = at - low
    f = f * f * (3 - 2 * f)
    i, j = low & (_SIZE - 1), (low + 1) & (_SIZE - 1)
    out = 0.0
    for corner in np.ndindex(2, 2, 2):
        pick = [(j if c else i)[:, axis] for axis, c in enumerate(corner)]
        weight = np.prod([f[:, axis] if c else 1 - f[:, axis] for axis, c in enumerate(corner)], axis=0)
        out = out + weight * _LATTICE[tuple(pick)]
    return out


def plain(color, rough=0.0, cell=0.15):
    """One colour, with a soft variation of the share `rough`."""
    color = np.asarray(color, float)

    def _texture(points):
        if not rough:
            return np.broadcast_to(color, points.shape)
        return color * (1 + rough * (value_noise(points, cell) - 0.5))[:, None]

    return _texture


def wood(color, cell=(0.5, 0.03, 0.03)):
    """Grain along x."""
    color = np.asarray(color, float)

    def _texture(points):
        return color * (0.8 + 0.4 * value_noise(points, np.asarray(cell)))[:, None]

    return _texture


def planks(color, width=0.18, length=1.4):
    """A wooden floor: boards along y with dark joints."""
    grain = wood(color, (0.03, 0.6, 1.0))

    def _texture(points):
        row = np.floor(points[:, 0] / width)
        shifted = points[:, 1] / length + 0.37 * row
        tone = _LATTICE[row.astype(int) & 63, np.floor(shifted).astype(int) & 63, 7]
        joint = np.minimum(np.abs(points[:, 0] / width - np.round(points[:, 0] / width)) * width, 1.0)
        dark = np.where(joint < 0.002, 0.55, 1.0)
        return grain(points) * ((0.85 + 0.3 * tone) * dark)[:, None]

    return _texture


def stripes(first, second, period, axis=0):
    """Two colours in turn along an axis."""
    colors = np.array([first, second], float)

    def _texture(points):
        return colors[np.floor(2 * points[:, axis] / period).astype(int) & 1]

    return _texture


def tiles(color, joint, size):
    """Square tiles in x and z with lighter or darker joints of 4 mm."""
    color, joint = np.asarray(color, float), np.asarray(joint, float)

    def _texture(points):
        at = points[:, [0, 2]] / size
        near = np.abs(at - np.round(at)).min(axis=1) * size < 0.002
        return np.where(near[:, None], joint, color * (0.94 + 0.12 * value_noise(points, size))[:, None])

    return _texture


def printed_page(width, height, heading=0.1, line=0.0055):
    """Lines of text on white paper in the plane z = 0 about the origin: words as dark bars, a heading, a picture."""

    def _texture(points):
        x, y = points[:, 0] / width + 0.5, 0.5 - points[:, 1] / height
        row = np.floor(points[:, 1] / line).astype(int)
        word = np.floor((points[:, 0] + 0.31 * row * line) / (2.1 * line)).astype(int)
        ink = (_LATTICE[row & 63, word & 63, 3] > 0.22) & (np.mod(points[:, 1] / line, 1.0) < 0.5)
        ink &= (x > 0.1) & (x < 0.9) & (y > 0.18) & (y < 0.93)
        ink |= (np.abs(y - heading) < 0.025) & (x > 0.2) & (x < 0.8)
        picture = (x > 0.52) & (x < 0.88) & (y > 0.55) & (y < 0.8)
        shade = 0.25 + 0.5 * value_noise(points, 0.02)
        grey = np.where(picture, shade, np.where(ink, 0.12, 0.86))
        return np.repeat(grey[:, None], 3, axis=1)

    return _texture


def poster(width, height, colors):
    """A picture: hills under a sky with a sun, in the plane z = 0 about the origin."""
    sky, sun, far, near = np.asarray(colors, float)

    def _texture(points):
        x, y = points[:, 0] / width + 0.5, points[:, 1] / height + 0.5
        out = sky * (0.7 + 0.4 * y)[:, None]
        disc = np.hypot(points[:, 0] - 0.2 * width, points[:, 1] - 0.2 * height) < 0.11 * width
        out = np.where(disc[:, None], sun, out)
        out = np.where((y < 0.45 + 0.12 * np.sin(7 * x + 1))[:, None], far, out)
        out = np.where((y < 0.25 + 0.08 * np.sin(11 * x))[:, None], near, out)
        rim = (np.abs(x - 0.5) > 0.47) | (np.abs(y - 0.5) > 0.48)
        return np.where(rim[:, None], 0.85, out)

    return _texture


def book_spines(seed, pitch=0.035):
    """Coloured backs of books side by side along x."""
    rng = np.random.default_rng(seed)
    palette = rng.uniform(0.1, 0.6, (64, 1)) * (0.55 + rng.uniform(0.0, 0.6, (64, 3)))

    def _texture(points):
        at = points[:, 0] / pitch
        book = np.floor(at).astype(int) & 63
        gap = np.abs(at - np.round(at)) < 0.05
        label = (np.mod(points[:, 2], 0.3) > 0.19) & (np.mod(points[:, 2], 0.3) < 0.225)
        color = np.where(label[:, None], 0.75, palette[book])
        return np.where(gap[:, None], 0.04, color)

    return _texture


def chessboard(board, dark, light, ring=0.5):
    """A dark board with a chessboard printed on it.

    Parameters
    ----------
    board : Board
        With a pattern, or plain.
    dark, light : float
        Albedo of the board with its dark squares, and of the light squares.
    ring : float
        Width of the outermost squares as a share of a square: the inner corners count, so that the outer ring may be
        narrower and the squares larger.

    Returns
    -------
    callable
        Of points in the board frame.

    Notes
    -----
    The square diagonally before the first inner corner is light.
    """
    pattern = board.pattern

    def _texture(points):
        grey = np.full(len(points), float(dark))
        if pattern is not None:
            at = (points[:, :2] - np.asarray(pattern.origin)) / pattern.square
            last = np.array([pattern.columns, pattern.rows]) - 1
            inside = np.all((at > -ring) & (at < last + ring), axis=1)
            even = np.floor(at).astype(int).sum(axis=1) % 2 == 0
            grey[inside & even] = light
        return np.repeat(grey[:, None], 3, axis=1)

    return _texture
