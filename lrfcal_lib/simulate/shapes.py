"""Shapes of things: corners of triangles (m, 3, 3) in the frame of the thing, metres."""

from itertools import pairwise, product

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import ArrayLike

from lrfcal_lib.model.board import UNIT_SQUARE
from lrfcal_lib.model.geometry import plane_axes, unit_vector

BOX_CORNERS = np.array(list(product((-1, 1), repeat=3)))  # of a box of 2 m about the origin


def polygon(corners: ArrayLike) -> np.ndarray:
    """A flat convex sheet of no thickness in the plane z = 0.

    Parameters
    ----------
    corners
        Shape (n, 2), metres.
    """
    first, *others = np.insert(np.asarray(corners, float), 2, 0.0, axis=1)
    return np.array([[first, *pair] for pair in pairwise(others)])


def rectangle(width: float, height: float) -> np.ndarray:
    """A sheet about the origin in the plane z = 0.

    Parameters
    ----------
    width, height
        Along x and y, metres.
    """
    return polygon((UNIT_SQUARE - 0.5) * [width, height])


def grid_surface(x, y, z):
    """A sheet through a grid of points, whose coordinates are broadcast to (rows, columns)."""
    points = np.stack(np.broadcast_arrays(x, y, z), axis=-1)
    cells = sliding_window_view(points, (2, 2), axis=(0, 1)).reshape(-1, 3, 4)
    return np.concatenate([cells[..., [0, 1, 2]], cells[..., [1, 3, 2]]]).mT


def box(size):
    """A box about the origin with edges along the axes."""
    quads = np.array(
        [
            [0, 2, 6, 4],
            [1, 5, 7, 3],
            [0, 4, 5, 1],
            [2, 3, 7, 6],
            [0, 1, 3, 2],
            [4, 6, 7, 5],
        ]
    )
    corners = BOX_CORNERS * size / 2
    return corners[quads[:, [0, 1, 2, 0, 2, 3]]].reshape(-1, 3, 3)


def lathe(radius, height, sides=48):
    """A body of revolution about z: its outline from below to above.

    A radius of zero closes an end.
    """
    turn = np.linspace(0, 2 * np.pi, sides + 1)
    x = np.outer(radius, np.cos(turn))
    y = np.outer(radius, np.sin(turn))
    return grid_surface(x, y, np.transpose([height]))


def cylinder(radius, height, sides=48):
    """A closed cylinder about z from z = 0 upwards."""
    return lathe([0, radius, radius, 0], [0, 0, height, height], sides)


def sphere(radius):
    """A ball about the origin."""
    turn = np.linspace(-np.pi / 2, np.pi / 2, 24)
    return lathe(radius * np.cos(turn), radius * np.sin(turn))


def rod(start, end, radius, sides=12):
    """A thin round bar between two points."""
    way = np.subtract(end, start)
    z = unit_vector(way)
    y, x = plane_axes(z)
    return start + cylinder(radius, np.linalg.norm(way), sides) @ [x, -y, z]


def curtain(width, height, depth, folds):
    """A hanging cloth in the plane y = 0, sine-shaped along x, `depth` from trough to crest."""
    s = np.linspace(-0.5, 0.5, 24 * folds)
    z = np.linspace(0.0, height, 5)[:, None]
    swing = 0.7 + 0.3 * z / height  # less at the top
    return grid_surface(width * s, depth / 2 * np.sin(2 * np.pi * folds * s) * swing, z)
