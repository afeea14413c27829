"""The outline of a board that nobody measured, from images of the pattern on it.

A wide search finds straight edges parallel to the sides of the pattern, and which way round the
board is in every image; the narrow search then finds each edge, and the outline is their median.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import gaussian_filter1d, maximum_filter1d, uniform_filter1d
from scipy.spatial.transform import RigidTransform

from lrfcal_lib.fit.padding import medians
from lrfcal_lib.fit.robust import NORMAL
from lrfcal_lib.model.board import (
    Board,
    Chessboard,
    corners_of_lines,
    side_ends,
    side_lengths,
)
from lrfcal_lib.model.camera import CameraModel, line_distance, line_through
from lrfcal_lib.model.geometry import DegenerateGeometry, unit_lines, unit_vector
from lrfcal_lib.preprocess.edges_in_image import (
    on_board,
    peaks,
    sample,
    step_contrast,
    vote,
)

STEP = 0.02  # of the wide search, in squares
APART = 4  # steps between profiles
# squares outside the outermost inner corners
NEAREST = 1.1
FARTHEST = 6.0
STEEPEST_SLOPE = 0.025  # of an edge against the side of the pattern
SLOPES = 11
SMOOTH_STEPS = 1.5  # of the derivative of a Gaussian across the edge
AVERAGED_PROFILES = 3  # along the edge
LEAST_CONTRAST = 8.0  # grey levels (norm over the colours) that make a step
LEAST_SHARE = 0.3  # of the profiles that must lie inside the image
# steps: an edge moves by a few millimetres between placements
MOVES_WITHIN = 9
MOVES_BETWEEN = 7
LEAST_VOTES = 0.5  # share of the profiles that agree on an edge
QUIET = 0.2  # mean share between two lines of a board
LINE_WIDTH = 6  # steps of a line of a board in the votes
TURN_ROUNDS = 50
SIDES = ("top", "right", "bottom", "left")
OPPOSITE = [2, 3, 0, 1]
SIDE_NORMALS = np.array([[0, -1], [1, 0], [0, 1], [-1, 0]], float)


@dataclass(frozen=True)
class Outline:
    """The outer edges of a board, measured in the scale of its pattern.

    Attributes
    ----------
    board : Board
        With its corners filled in.
    line_sd : ndarray, shape (E,)
        Standard deviation over the views of an edge's offset at its middle, metres.
    length_sd : dict of str to float
        Standard deviation of an edge's length over the views that show it with both neighbours (NaN
        below two), metres.
    n_lengths : dict of str to int
        Views that show the edge with both neighbours.
    """

    board: Board
    line_sd: np.ndarray
    length_sd: dict[str, float]
    n_lengths: dict[str, int]


def edge_votes(
    image: np.ndarray, pattern: Chessboard, model: CameraModel, pose: RigidTransform
) -> np.ndarray:
    """Share of the profiles that agree on an edge, by side and distance from the pattern.

    Parameters
    ----------
    image : ndarray of uint8, shape (h, w) or (h, w, 3)
    pattern : Chessboard
    model : CameraModel
    pose : RigidTransform
        ``T_camera_board``.

    Returns
    -------
    ndarray, shape (4, n)
        For the sides SIDES and :func:`_distances`; NaN where less than 30 % of the profiles lie
        inside the image.
    """
    distances = _distances(pattern)
    slopes = np.linspace(-STEEPEST_SLOPE, STEEPEST_SLOPE, SLOPES) * APART
    size = _size(pattern)
    square = pattern.square
    shares = []
    for normal in SIDE_NORMALS:
        along = np.abs(normal[::-1])
        s = np.arange(-square, size @ along + square, APART * STEP * square)
        corner = pattern.origin + np.maximum(normal, 0) * size
        xy = corner + np.outer(s, along) + distances[:, None, None] * normal
        strip = sample(image, model, on_board(xy, pose, model))
        height = step_contrast(strip, SMOOTH_STEPS, along=AVERAGED_PROFILES)
        column, place, _ = peaks(height, LEAST_CONTRAST)
        alike = np.ones_like(place)
        votes = vote(column, place, alike, height.shape, slopes).max(axis=0)
        visible = np.isfinite(strip[..., 0]).sum(axis=1)
        share = votes / np.maximum(visible, 1)
        share[visible <= LEAST_SHARE * len(s)] = np.nan
        shares.append(share)
    return np.stack(shares)


def turned_views(votes: np.ndarray, up: np.ndarray, leader: Sequence[int]) -> np.ndarray:
    """Which views see the pattern turned by 180 deg against the others.

    Parameters
    ----------
    votes : ndarray, shape (v, 4, n)
        Of :func:`edge_votes`.
    up : ndarray, shape (v,)
        Component of the board's y axis down the image: most views keep y down.
    leader : sequence of int, length v
        The first of the views that are turned alike, see
        :func:`lrfcal_lib.preprocess.turns.alike`.

    Returns
    -------
    ndarray of bool, shape (v,)
    """
    wide = uniform_filter1d(np.nan_to_num(votes), MOVES_WITHIN, axis=-1)
    opposite = wide[:, OPPOSITE]
    turned = np.bincount(leader, up)[leader] < 0
    for _ in range(TURN_ROUNDS):
        mean = np.where(turned[:, None, None], opposite, wide).mean(axis=0)
        gain = np.sum((opposite - wide) * mean, axis=(1, 2))
        turned = np.bincount(leader, gain)[leader] > 0
    upright = np.where(turned, -up, up) > 0
    return turned if np.mean(upright) >= 0.5 else ~turned


def common_lines(votes: np.ndarray, board) -> tuple[np.ndarray | None, str]:
    """Sides of a board that views turned alike agree on.

    Parameters
    ----------
    votes : ndarray, shape (v, 4, n)
        Of :func:`edge_votes`.
    board : Board
        With a pattern.

    Returns
    -------
    lines : ndarray, shape (4, 3), or None
        Board-frame lines, unit normals out of the board.
    unseen : str
        Names the first edge that they do not agree on, as with a sheet on a wall, or a background
        as bright.
    """
    wide = maximum_filter1d(np.nan_to_num(votes, nan=-1.0), MOVES_BETWEEN, axis=-1)
    visible = wide >= 0
    count = visible.sum(axis=0)
    mean = wide.sum(axis=0, where=visible) / np.maximum(count, 1)
    mean[count < min(3, len(votes))] = 0
    places = list(map(_outer_peak, gaussian_filter1d(mean, 1.0)))
    if None in places:
        return None, (
            f"the images do not agree on the {SIDES[places.index(None)]} edge of board "
            f"'{board.name}': give the corners of the board or pick edges by hand"
        )
    return side_lines(board.pattern, _distances(board.pattern)[places]), ""


def side_lines(pattern: Chessboard, distances) -> np.ndarray:
    """Board lines parallel to the sides of the pattern.

    Parameters
    ----------
    pattern : Chessboard
    distances : ndarray, shape (4,)
        Outside the outermost inner corners: top, right, bottom, left; metres.

    Returns
    -------
    ndarray, shape (4, 3)
    """
    corner = pattern.origin + np.maximum(SIDE_NORMALS, 0) * _size(pattern)
    offset = -np.vecdot(corner, SIDE_NORMALS) - distances
    return np.column_stack([SIDE_NORMALS, offset])


def measure_outline(views, board: Board, models: dict[str, CameraModel]) -> Outline:
    """Outer edges of the board from all images of all cameras.

    Median over the views of the edge's offset at two places; the spread is 1.4826 times the median
    deviation. A board bends between placements, so the spread is its own, not the noise of the
    images.

    Parameters
    ----------
    views : sequence of BoardView
        That show the board.
    board : Board
    models : dict of str to CameraModel
        By camera.

    Returns
    -------
    Outline

    Raises
    ------
    DegenerateGeometry
        Names an edge that was found in no image.
    """
    lines = np.full((len(views), len(board.edges), 3), np.nan)
    for of_view, view in zip(lines, views, strict=True):
        pose = view.T_camera_board.as_matrix()
        pixels_of_board = models[view.camera].matrix @ pose[:3, [0, 1, 3]]
        for edge in view.edges:
            row = board.edges.index(edge.name)
            of_view[row] = unit_lines(edge.line @ pixels_of_board)
    unseen = np.isnan(lines).all(axis=(0, 2))
    if unseen.any():
        raise DegenerateGeometry(
            f"edge '{board.edges[unseen.argmax()]}' of board '{board.name}' was found in none of "
            f"{len(views)} images: pick it by hand in edges.csv or give the corners of the board"
        )
    middle = np.nanmedian(lines, axis=0)
    ends = side_ends(corners_of_lines(middle))
    normals = unit_vector(middle[:, :2])
    # where every line crosses the normals raised at the two ends of its edge
    cosine = np.vecdot(lines[..., :2], normals)
    offsets = -line_distance(ends, lines[:, :, None]) / cosine[..., None]
    ends += np.nanmedian(offsets, axis=0)[..., None] * normals[:, None]
    fitted = line_through(ends[:, 0], ends[:, 1])
    lengths = side_lengths(corners_of_lines(lines)).T
    return Outline(
        board=replace(board, corners=corners_of_lines(fitted)),
        line_sd=_spread(offsets.mean(axis=2).T),
        length_sd=dict(zip(board.edges, _spread(lengths), strict=True)),
        n_lengths=dict(zip(board.edges, np.isfinite(lengths).sum(axis=1), strict=True)),
    )


def _distances(pattern):
    """Distances (n,) outside the outermost inner corners at which edges are looked for, metres."""
    return np.arange(NEAREST, FARTHEST, STEP) * pattern.square


def _size(pattern):
    """Width and height of the grid of inner corners, metres."""
    return np.array([pattern.columns - 1, pattern.rows - 1]) * pattern.square


def _outer_peak(votes):
    """Place of the board's edge in the votes (n,) of one side; None without one.

    It is the last line before the clutter begins. Two lines of a board (the border of the sheet,
    the edge) are quiet in between.
    """
    best = None
    start = 0
    highest = votes >= maximum_filter1d(votes, 2 * LINE_WIDTH + 1)
    for i in np.flatnonzero(highest & (votes >= LEAST_VOTES)):
        gap = votes[start : max(i - 2 * LINE_WIDTH, start)]
        if gap.size and gap.mean() > QUIET:
            break
        best = i
        start = best + 2 * LINE_WIDTH
    return best


def _spread(values):
    """Standard deviations (k,) about the medians of rows (k, n); NaN below two known values."""
    known = np.isfinite(values)
    misses = np.abs(values - medians(values, known)[:, None])
    return np.where(known.sum(axis=1) > 1, NORMAL * medians(misses, known), np.nan)
