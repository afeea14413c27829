"""The wide search for the edges of a board whose outline nobody measured: votes around its pattern, over all images."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import gaussian_filter1d, maximum_filter1d, uniform_filter1d

from lrfcal_lib.camera import pinhole
from lrfcal_lib.preprocess import edges as strips

STEP = 0.02  # of the search, in squares
NEAREST, FARTHEST = 1.1, 6.0  # squares outside the outermost inner corners
SIDES = ("top", "right", "bottom", "left")
SIDE_NORMALS = np.array([[0, -1], [1, 0], [0, 1], [-1, 0]], float)


class OutlineNotSeen(ValueError):
    """The images do not show where a board ends (a sheet on a wall, a background as bright as the board)."""


def wide_distances(pattern):
    """Distances outside the outermost inner corners at which edges are looked for, metres."""
    return np.arange(NEAREST, FARTHEST, STEP) * pattern.square


def edge_votes(image, board, model, pose):
    """Share of the profiles that agree on an edge, by side of the pattern and distance outside it.

    Parameters
    ----------
    image : ndarray of uint8
    board : Board
        Its pattern has four sides: top (y least), right, bottom, left.
    model : CameraModel
    pose : RigidTransform
        ``T_camera_board``.

    Returns
    -------
    ndarray, shape (4, n)
        At :func:`wide_distances`; NaN where less than 30 % of the profiles lie inside the image.
    """
    pattern = board.pattern
    distances = wide_distances(pattern)
    slopes = np.linspace(-0.025, 0.025, 11) * 4  # the profiles stand four steps apart
    out = []
    for side in range(4):
        points = _side_grid(pattern, side, distances)
        uv = pinhole(pose.apply(points.reshape(-1, 3)), model).reshape(*points.shape[:2], 2)
        strip = strips.sample(image, model, np.nan_to_num(uv, nan=-1e6))
        height = strips.step_contrast(strip, 1.5, along=3)
        column, place, _ = strips.peaks(height, 8.0)
        votes = strips.vote(column, place, np.ones(len(column)), height.shape, slopes, 1).max(axis=0)
        seen = np.isfinite(strip[..., 0]).sum(axis=1)
        out.append(np.where(seen > 0.3 * height.shape[1], votes / np.maximum(seen, 1), np.nan))
    return np.stack(out)


def _side_grid(pattern, side, distances):
    """Board points of a strip outside one side of the pattern, shape (n_distances, n_profiles, 3)."""
    size = np.array([pattern.columns - 1, pattern.rows - 1]) * pattern.square
    normal = SIDE_NORMALS[side]
    along = np.abs(normal[::-1])
    s = np.arange(-pattern.square, size @ along + pattern.square, 4 * STEP * pattern.square)
    base = np.asarray(pattern.origin) + np.maximum(normal, 0) * size
    xy = base + s[None, :, None] * along + distances[:, None, None] * normal
    return np.concatenate([xy, np.zeros(xy.shape[:2] + (1,))], axis=-1)


def outer_peak(votes, least=0.45, quiet=0.1, width=4):
    """Place of the board's edge in the votes of one side: the last line before the clutter begins.

    Parameters
    ----------
    votes : ndarray, shape (n,)
        Share of profiles; NaN outside the image.
    least : float
        Share that makes a line.
    quiet : float
        The board between two of its lines (the border of the sheet, the edge) shows fewer votes than this.
    width : int
        Samples around a line that belong to it.

    Returns
    -------
    int
        -1 if there is none.
    """
    votes = np.nan_to_num(np.asarray(votes, float))
    best, start = -1, 0
    for i in np.nonzero(votes >= least)[0]:
        if votes[i] < votes[max(i - width, 0) : i + width + 1].max():
            continue
        gap = votes[start : max(i - 2 * width, start)]
        if gap.size and gap.mean() > quiet:
            break
        best, start = int(i), int(i) + 2 * width
    return best


def widest_lines(votes, board):
    """Board lines of the edges seen in the votes of one view, NaN where a side shows none; shape (4, 3)."""
    distances = wide_distances(board.pattern)
    places = [outer_peak(v) for v in votes]
    return side_lines(board.pattern, [distances[p] if p >= 0 else np.nan for p in places])


def side_lines(pattern, distances):
    """Board lines parallel to the sides of the pattern, at distances outside the outermost inner corners.

    Parameters
    ----------
    pattern : Chessboard
    distances : sequence of 4 floats
        Top, right, bottom, left; metres.

    Returns
    -------
    ndarray, shape (4, 3)
    """
    size = np.array([pattern.columns - 1, pattern.rows - 1]) * pattern.square
    base = np.asarray(pattern.origin) + np.maximum(SIDE_NORMALS, 0) * size
    offset = -np.sum(base * SIDE_NORMALS, axis=1) - np.asarray(distances, float)
    return np.column_stack([SIDE_NORMALS, offset])


def resolve_turns(votes, up, first):
    """Which views see the pattern turned by 180 deg against the others.

    Parameters
    ----------
    votes : ndarray, shape (v, 4, n)
        Of :func:`edge_votes`, one row a view.
    up : ndarray, shape (v,)
        Component of the board's y axis down the image: most views keep y down.
    first : ndarray of int, shape (v,)
        The first of the views that are turned alike, see :func:`lrfcal_lib.preprocess.turns.alike`.

    Returns
    -------
    ndarray of bool, shape (v,)
    """
    up = np.asarray(up)
    # edges move by a few millimetres from view to view: widen the peaks before comparing
    wide = uniform_filter1d(np.nan_to_num(np.asarray(votes, float)), 9, axis=-1)
    both = np.stack([wide, wide[:, [2, 3, 0, 1]]])
    turned = np.bincount(first, up)[first] < 0
    rows = np.arange(len(votes))
    for _ in range(50):
        mean = both[turned.astype(int), rows].mean(axis=0)
        score = np.sum(both * mean, axis=(2, 3))
        new = np.bincount(first, score[1] - score[0])[first] > 0
        if np.array_equal(new, turned):
            break
        turned = new
    kept_down = np.where(turned, -up, up)
    return turned if np.mean(kept_down > 0) >= 0.5 else ~turned


def common_lines(votes, board):
    """Board lines of the edges that many views agree on.

    Parameters
    ----------
    votes : ndarray, shape (v, 4, n)
        Turned alike.
    board : Board

    Returns
    -------
    ndarray, shape (4, 3)

    Raises
    ------
    OutlineNotSeen
        If the views do not agree on a side.
    """
    distances = wide_distances(board.pattern)
    # an edge moves by a few millimetres between placements
    wide = maximum_filter1d(np.nan_to_num(votes, nan=-1.0), 7, axis=-1)
    wide[wide < 0] = np.nan
    places = []
    for side in range(4):
        enough = np.isfinite(wide[:, side]).sum(axis=0) >= min(3, len(votes))
        mean = np.full(len(distances), np.nan)
        mean[enough] = np.nanmean(wide[:, side][:, enough], axis=0)
        smooth = gaussian_filter1d(np.nan_to_num(mean), 1.0)
        places.append(outer_peak(smooth, least=0.5, quiet=0.2, width=6))
        if places[-1] < 0:
            raise OutlineNotSeen(
                f"the images do not agree on the {SIDES[side]} edge of board '{board.name}': give the corners of the "
                "board or pick edges by hand"
            )
    return side_lines(board.pattern, distances[places])
