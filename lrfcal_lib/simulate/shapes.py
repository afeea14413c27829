"""Triangle meshes of simple bodies: (vertices (n, 3), faces (m, 3)) in metres."""

from __future__ import annotations

import numpy as np


def polygon(corners):
    """A flat convex sheet of no thickness in the plane z = 0.

    Parameters
    ----------
    corners : array_like, shape (n, 2)

    Returns
    -------
    vertices : ndarray, shape (n, 3)
    faces : ndarray of int, shape (n - 2, 3)
    """
    corners = np.asarray(corners, float)
    fan = np.arange(1, len(corners) - 1)
    return np.column_stack([corners, np.zeros(len(corners))]), np.stack([0 * fan, fan, fan + 1], axis=1)


def rectangle(width, height):
    """A sheet about the origin in the plane z = 0."""
    w, h = width / 2, height / 2
    return polygon([[-w, -h], [w, -h], [w, h], [-w, h]])


def grid_surface(points):
    """A sheet through a grid of points, shape (rows, columns, 3)."""
    points = np.asarray(points, float)
    rows, columns = points.shape[:2]
    first = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
    low = np.stack([first, first + 1, first + columns], axis=1)
    high = np.stack([first + 1, first + columns + 1, first + columns], axis=1)
    return points.reshape(-1, 3), np.concatenate([low, high])


def box(size):
    """A box about the origin with edges along the axes.

    Parameters
    ----------
    size : array_like, shape (3,)
        Metres.
    """
    signs = np.array([[x, y, z] for z in (-1, 1) for y in (-1, 1) for x in (-1, 1)], float)
    quads = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]]
    faces = [[q[0], q[i], q[i + 1]] for q in quads for i in (1, 2)]
    return signs * np.asarray(size, float) / 2, np.array(faces)


def lathe(radius, height, sides=48):
    """A body of revolution about z.

    Parameters
    ----------
    radius, height : array_like, shape (n,)
        The outline from below to above; a radius of zero closes an end.
    sides : int

    Returns
    -------
    vertices, faces
    """
    turn = np.linspace(0, 2 * np.pi, sides + 1)
    radius, height = np.asarray(radius, float)[:, None], np.asarray(height, float)[:, None]
    points = np.stack([radius * np.cos(turn), radius * np.sin(turn), height + 0 * turn], axis=-1)
    return grid_surface(points)


def cylinder(radius, height, sides=48, top=None):
    """A closed cylinder about z from z = 0 upwards; `top` is the upper radius of a cone."""
    return lathe([0, radius, radius if top is None else top, 0], [0, 0, height, height], sides)


def sphere(radius, sides=48):
    """A ball about the origin."""
    turn = np.linspace(-np.pi / 2, np.pi / 2, sides // 2)
    return lathe(radius * np.cos(turn), radius * np.sin(turn), sides)


def rod(start, end, radius, sides=12):
    """A thin round bar between two points.

    Parameters
    ----------
    start, end : array_like, shape (3,)
    radius : float
        Metres.
    sides : int
    """
    start, end = np.asarray(start, float), np.asarray(end, float)
    length = np.linalg.norm(end - start)
    z = (end - start) / length
    x = np.cross(z, [1.0, 0.0, 0.0] if abs(z[0]) < 0.9 else [0.0, 1.0, 0.0])
    x /= np.linalg.norm(x)
    vertices, faces = cylinder(radius, length, sides)
    return start + vertices @ np.stack([x, np.cross(z, x), z]), faces


def curtain(width, height, depth, folds):
    """A hanging cloth in the plane y = 0 with sine-shaped folds along x.

    Parameters
    ----------
    width, height, depth : float
        Metres; the depth is from trough to crest.
    folds : int
    """
    s = np.linspace(-0.5, 0.5, 24 * folds)
    z = np.linspace(0.0, height, 5)[:, None]
    wave = depth / 2 * np.sin(2 * np.pi * folds * s) * (0.7 + 0.3 * z / height)
    return grid_surface(np.stack(np.broadcast_arrays(width * s, wave, z), axis=-1))
