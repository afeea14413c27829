"""Edge lengths of boards in the cloud by least squares."""

from dataclasses import dataclass, field, replace

import numpy as np

from lrfcal_lib.model.board import corners_of_lines, side_lengths
from lrfcal_lib.model.camera import line_distance, line_through
from lrfcal_lib.model.geometry import fit_line, fit_plane, plane_axes

STEP = 1e-6  # of shifts and turns of lines, metres and radians: for derivatives of lengths


@dataclass(frozen=True)
class MeasuredBoard:
    """The outline of a board as the cloud shows it.

    Attributes
    ----------
    T_platform_plane : ndarray, shape (3, 4)
        Origin in the middle of the face, z along the normal towards the sensor.
    lines : ndarray, shape (E, 3)
        Sides, ``a x + b y + c = 0`` in the plane, metres, NaN where one was not measured.
    corners : dict of str to ndarray, shape (2,)
        Where an edge meets the one before it.
    lengths, scatter, sigma : dict of str to float
        Metres: edges of which both ends are measured; rms distances of points from the lines (least
        squares only); standard deviations of the lengths, by least squares from that scatter alone.
    """

    T_platform_plane: np.ndarray
    lines: np.ndarray
    corners: dict[str, np.ndarray]
    lengths: dict[str, float]
    scatter: dict[str, float] = field(default_factory=dict)
    sigma: dict[str, float] = field(default_factory=dict)

    def corner_point(self, name: str) -> np.ndarray:
        """The corner where an edge starts, shape (3,), in the frame of the cloud."""
        pose = self.T_platform_plane[:3]
        return pose[:, 3] + pose[:, :2] @ self.corners[name]


def measure_board(
    face: np.ndarray, sides: dict[str, np.ndarray], edges: tuple[str, ...]
) -> MeasuredBoard:
    """Measure a board's outline in a cloud: plane of the face, lines through sides, corners.

    Parameters
    ----------
    face : ndarray, shape (n, 3)
        Metres.
    sides : dict of str to ndarray, shape (k, 3)
        Points of edges by name, metres.
    edges : tuple of str
        All of them in order around the board.

    Returns
    -------
    MeasuredBoard
        Standard deviations are those of the points about the lines alone.
    """
    pose = plane_frame(face)
    lines = np.full((len(edges), 3), np.nan)
    middles = np.zeros((len(edges), 2))
    variances = np.zeros((len(edges), 2))  # of shift and turn
    scatter = {}
    for name, points in sides.items():
        row = edges.index(name)
        flat = (points - pose[:, 3]) @ pose[:, :2]
        middle, direction, rms = fit_line(flat)
        lines[row] = line_through(middle, middle + direction)
        middles[row] = middle
        shift = rms**2 / max(len(flat) - 1, 1)
        spread = np.mean(((flat - middle) @ direction) ** 2)
        variances[row] = shift, shift / max(spread, 1e-12)
        scatter[name] = fit_line(points)[2]
    board = bounded(pose, edges, lines, middles, np.diag(variances.ravel()))
    return replace(board, scatter=scatter)


def plane_frame(points: np.ndarray) -> np.ndarray:
    """A frame (3, 4) in the plane of points: origin in their middle, z towards their origin."""
    away, distance, _ = fit_plane(points)
    normal = -away
    centre = np.nanmean(points, axis=0)
    origin = centre - normal * (normal @ centre + distance)
    return np.column_stack([*plane_axes(normal), normal, origin])


def bounded(
    pose: np.ndarray,
    edges: tuple[str, ...],
    lines: np.ndarray,
    middle: np.ndarray,
    covariance: np.ndarray,
) -> MeasuredBoard:
    """The board that lines bound: its corners and lengths, and how well the lengths are known.

    Parameters
    ----------
    pose : ndarray, shape (3, 4)
        ``T_platform_plane``.
    edges : tuple of str
        E of them, in order around the board.
    lines : ndarray, shape (E, 3)
        Sides in the plane, NaN where one was not measured.
    middle : ndarray, shape (E, 2)
        Points of the sides, about which they turn, metres.
    covariance : ndarray, shape (2 E, 2 E)
        Of shift and turn of every side, metres and radians.

    Returns
    -------
    MeasuredBoard
        Its corners are those of two known neighbours, its lengths those between two corners.
    """
    corners = corners_of_lines(lines)
    lengths = side_lengths(corners)
    steps = STEP * np.eye(len(covariance)).reshape(len(covariance), -1, 2)
    after = corners_of_lines(moved_lines(lines, middle, steps))
    J = (side_lengths(after) - lengths).T / STEP
    sigma = np.sqrt(np.vecdot(J @ covariance, J))
    return MeasuredBoard(
        T_platform_plane=pose,
        lines=lines,
        corners=_known(edges, corners),
        lengths=_known(edges, lengths.tolist()),
        sigma=_known(edges, sigma.tolist()),
    )


def _known(edges, values):
    """What is not NaN, by edge."""
    rows = zip(edges, values, strict=True)
    return {name: value for name, value in rows if not np.isnan(value).any()}


def moved_lines(lines: np.ndarray, middle: np.ndarray, step: np.ndarray) -> np.ndarray:
    """Lines (s, 3) shifted outwards and turned about points (s, 2) of them by steps (..., s, 2)."""
    normals = lines[:, :2]
    along = normals[:, ::-1] * [-1, 1]
    turn = step[..., 1:]
    turned = np.cos(turn) * normals + np.sin(turn) * along
    at = line_distance(middle, lines) - step[..., 0] - np.vecdot(turned, middle)
    return np.concatenate([turned, at[..., None]], axis=-1)
