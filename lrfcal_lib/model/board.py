"""The calibration board: outline, edges, printed pattern."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from lrfcal_lib.model.geometry import (
    cross,
    length_of,
    unit_lines,
)

UNIT_SQUARE = np.array([[0, 0], [1, 0], [1, 1], [0, 1]])  # its corners in order


@dataclass(frozen=True)
class Chessboard:
    """A printed chessboard.

    Attributes
    ----------
    columns, rows : int
        Inner corners along x and y of the board frame.
    square : float
        Side of a square, metres.
    origin : tuple of float
        Board coordinates of the first inner corner, metres.
    """

    columns: int
    rows: int
    square: float
    origin: tuple[float, float] = (0.0, 0.0)

    def points(self):
        """Inner corners row by row in the board frame, shape (rows * columns, 3), metres."""
        squares = np.mgrid[: self.columns, : self.rows].T.reshape(-1, 2)
        return np.insert(squares * self.square + self.origin, 2, 0.0, axis=1)

    def grid(self, corners: ArrayLike) -> np.ndarray:
        """What belongs to the inner corners, (rows * columns, 2), as (rows, columns, 2)."""
        return np.reshape(corners, (self.rows, self.columns, 2))

    def outline(self) -> np.ndarray:
        """Corners of the printed squares together, shape (4, 2), metres."""
        first = np.subtract(self.origin, self.square)
        size = np.multiply(self.square, [self.columns + 1, self.rows + 1])
        return first + size * UNIT_SQUARE


@dataclass(frozen=True)
class Board:
    """A flat board with straight edges.

    Attributes
    ----------
    name : str
    edges : tuple of str
        Names of the straight edges in order around the outline (x to y in the board frame).
    corners : ndarray, shape (n_edges, 2), or None
        Outline in the board frame, metres: edge i runs from corner i to corner i + 1. None where
        the outline was never measured; :mod:`lrfcal_lib.preprocess.survey` then measures it in the
        scale of the pattern.
    pattern : Chessboard or None
    features : tuple of str
        The two edges that equations (7) to (14) call 1 and 2.
    """

    name: str
    edges: tuple[str, ...]
    corners: np.ndarray | None = None
    pattern: Chessboard | None = None
    features: tuple[str, str] = ("", "")

    def lines(self):
        """Edges as board-frame lines, see :func:`outline_lines`; ValueError where the outline is
        not known.
        """
        return outline_lines(self.known_corners())

    def lengths(self):
        """Edge lengths in metres, keyed by edge name."""
        return dict(zip(self.edges, side_lengths(self.known_corners()), strict=True))

    def points(self):
        """Corners of the outline in space, board frame, metres, shape (n, 3)."""
        return np.insert(self.known_corners(), 2, 0.0, axis=1)

    def outline(self):
        """Corners of the outline, of the printed squares where nobody has measured it, metres,
        shape (n, 2); ValueError where there are none.
        """
        if self.corners is None and self.pattern is not None:
            return self.pattern.outline()
        return self.known_corners()

    def known_corners(self):
        """Corners of the outline, metres, shape (n, 2); ValueError where nobody has
        measured them.
        """
        if self.corners is None:
            raise ValueError(
                f"the outline of board '{self.name}' is not known: measure it from images first"
            )
        return np.asarray(self.corners, float)


def outline_lines(corners: ArrayLike) -> np.ndarray:
    """Lines ``a x + b y + c = 0`` of a polygon's sides, unit normals outwards.

    Parameters
    ----------
    corners : array_like, shape (n, 2)
        Metres.

    Returns
    -------
    ndarray, shape (n, 3)
        Row i from corner i to i + 1.
    """
    points = np.insert(corners, 2, 1.0, axis=1)
    lines = cross(points, np.roll(points, -1, axis=0))
    twice_area = lines[:, 2].sum()
    return -np.sign(twice_area) * unit_lines(lines)


def corners_of_lines(lines: ArrayLike) -> np.ndarray:
    """Corners of a polygon from its sides: corner i is where side i - 1 meets side i.

    Parameters
    ----------
    lines : array_like, shape (..., n, 3)
        ``(a, b, c)`` of ``a x + b y + c = 0``.

    Returns
    -------
    ndarray, shape (..., n, 2)
    """
    points = cross(np.roll(lines, 1, axis=-2), lines)
    return points[..., :2] / points[..., 2:]


def side_lengths(corners: np.ndarray) -> np.ndarray:
    """Lengths of the sides of polygons.

    Parameters
    ----------
    corners : ndarray, shape (..., n, k)

    Returns
    -------
    ndarray, shape (..., n)
        From corner i to i + 1.
    """
    return length_of(np.roll(corners, -1, axis=-2) - corners)


def side_ends(corners: np.ndarray, inset: float = 0.0) -> np.ndarray:
    """Both ends of every side of a polygon, side i from corner i to i + 1.

    Parameters
    ----------
    corners : ndarray, shape (n, k)
    inset : float
        Share of a side left out at either end.

    Returns
    -------
    ndarray, shape (n, 2, k)
    """
    ends = np.stack([corners, np.roll(corners, -1, axis=0)], axis=1)
    return ends + inset * (ends[:, ::-1] - ends)


def triangle_board(
    ab: float = 0.315,
    ac: float = 0.380,
    name: str = "triangle",
    pattern: Chessboard | None = None,
) -> Board:
    """The paper's board: a triangle with its right angle A in the origin, B on +x and C on +y.

    The paper states 315, 380 and 491 mm; a right angle makes the third edge 493.58 mm (the stated
    one closes at 89.4 deg), so the exact right angle is used here. Edges are ``ab``, ``bc``,
    ``ca``.

    Parameters
    ----------
    ab, ac : float
        Lengths of the two legs, metres.
    name : str
    pattern : Chessboard, optional
    """
    corners = np.array([[0.0, 0.0], [ab, 0.0], [0.0, ac]])
    return Board(name, ("ab", "bc", "ca"), corners, pattern, ("ab", "ca"))
