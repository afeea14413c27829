"""Edge lengths of boards in the cloud by least squares."""

from dataclasses import dataclass, field

import numpy as np

from lrfcal_lib.model import geometry
from lrfcal_lib.model.board import corners_of_lines
from lrfcal_lib.model.camera import line_distance
from lrfcal_lib.model.geometry import fit_line

STEP = 1e-6  # of shifts and turns of lines, metres and radians: for derivatives of lengths


@dataclass(frozen=True)
class MeasuredBoard:
    """The outline of a board as the cloud shows it.

    Attributes
    ----------
    T_platform_plane : ndarray, shape (4, 4)
        Origin in the middle of the face, z along the normal towards the sensor.
    lines, corners : dict of str to ndarray, shapes (3,) and (2,)
        Sides that were measured, ``a x + b y + c = 0`` in the plane, metres, and where an edge
        meets the one before it.
    lengths, scatter, sigma : dict of str to float
        Metres: edges of which both ends are measured; rms distances of points from the lines (least
        squares only); standard deviations of the lengths, by least squares from that scatter alone.
    """

    T_platform_plane: np.ndarray
    lines: dict[str, np.ndarray]
    corners: dict[str, np.ndarray]
    lengths: dict[str, float]
    scatter: dict[str, float] = field(default_factory=dict)
    sigma: dict[str, float] = field(default_factory=dict)

    def corner_point(self, name: str) -> np.ndarray:
        """The corner where an edge starts, shape (3,), in the frame of the cloud."""
        return (
            self.T_platform_plane[:3, 3]
            + self.T_platform_plane[:3, :2] @ self.corners[name]
        )


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
    if not sides:
        return MeasuredBoard(pose, {}, {}, {})
    lines = {}
    middles = []
    variances = []  # of shift and turn
    for name, points in sides.items():
        flat = (points - pose[:3, 3]) @ pose[:3, :2]
        middle, direction, rms = fit_line(flat)
        normal = direction[::-1] * [1.0, -1.0]
        lines[name] = np.append(normal, -normal @ middle)
        middles.append(middle)
        shift = rms**2 / max(len(flat) - 1, 1)
        spread = np.mean(((flat - middle) @ direction) ** 2)
        variances += [shift, shift / max(spread, 1e-12)]
    corners, lengths, sigma = sized(lines, np.array(middles), np.diag(variances), edges)
    scatter = {name: fit_line(points)[2] for name, points in sides.items()}
    return MeasuredBoard(pose, lines, corners, lengths, scatter, sigma)


def plane_frame(points: np.ndarray) -> np.ndarray:
    """A frame (4, 4) in the plane of points: origin in their middle, z towards their origin."""
    away, distance, _ = geometry.fit_plane(points)
    normal = -away
    centre = np.nanmean(points, axis=0)
    pose = np.eye(4)
    pose[:3, :2] = geometry.plane_axes(normal).T
    pose[:3, 2] = normal
    pose[:3, 3] = centre - normal * (normal @ centre + distance)
    return pose


def sized(
    lines: dict[str, np.ndarray],
    middle: np.ndarray,
    covariance: np.ndarray,
    edges: tuple[str, ...],
) -> tuple[dict[str, np.ndarray], dict[str, float], dict[str, float]]:
    """Corners and lengths of an outline, and how well the lengths are known.

    Parameters
    ----------
    lines : dict of str to ndarray, shape (3,)
        Sides by name.
    middle : ndarray, shape (s, 2)
        Points of the sides, about which they turn, metres.
    covariance : ndarray, shape (2 s, 2 s)
        Of shift and turn of every side, metres and radians.
    edges : tuple of str
        All of the board in order around it.

    Returns
    -------
    corners : dict of str to ndarray, shape (2,)
        Where an edge meets the one before it, of two known neighbours.
    lengths, sigma : dict of str to float
        Of edges between two corners, and their standard deviations.
    """
    straight = np.array(list(lines.values()))
    index = [edges.index(name) for name in lines]

    def outline(known):
        """Corners (..., E, 2) and lengths (..., E) with lines (..., s, 3); NaN where some miss."""
        every = np.full((*known.shape[:-2], len(edges), 3), np.nan)
        every[..., index, :] = known
        corners = corners_of_lines(every)
        along = np.roll(corners, -1, axis=-2) - corners
        return corners, np.linalg.norm(along, axis=-1)

    corners, lengths = outline(straight)
    steps = STEP * np.eye(len(covariance)).reshape(len(covariance), -1, 2)
    _, after = outline(moved_lines(straight, middle, steps))
    J = (after - lengths).T / STEP
    sigma = np.sqrt(np.vecdot(J @ covariance, J))
    return (
        _known(edges, corners),
        _known(edges, lengths.tolist()),
        _known(edges, sigma.tolist()),
    )


def _known(edges, values):
    """What is not NaN, by edge."""
    rows = zip(edges, values, strict=True)
    return {name: value for name, value in rows if not np.isnan(value).any()}


def moved_lines(lines: np.ndarray, middle: np.ndarray, step: np.ndarray) -> np.ndarray:
    """Lines (s, 3) shifted outwards and turned about points (s, 2) of them by steps (..., s, 2)."""
    cosine = np.cos(step[..., 1])
    sine = np.sin(step[..., 1])
    a = lines[:, 0]
    b = lines[:, 1]
    normals = np.stack([cosine * a - sine * b, sine * a + cosine * b], axis=-1)
    at = line_distance(middle, lines) - step[..., 0] - np.vecdot(normals, middle)
    return np.concatenate([normals, at[..., None]], axis=-1)
