"""The outer edges of a board in its own frame, measured from images in the scale of the pattern."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lrfcal_lib.board import Board, corners_of_lines


@dataclass(frozen=True)
class Outline:
    """The outer edges of a board, measured in the scale of its pattern.

    Attributes
    ----------
    lines : ndarray, shape (E, 3)
        Board-frame lines ``a x + b y + c = 0``, unit normals out of the board, in the order of ``board.edges``.
    line_sd : ndarray, shape (E,)
        Standard deviation over the views of an edge's offset at its middle, metres.
    lengths : dict of str to float
        Edge lengths of the outline, metres.
    length_sd : dict of str to float
        Standard deviation of the length over the views that show the edge with both neighbours; NaN below two.
    n_views : dict of str to int
        Views that show the edge.
    n_lengths : dict of str to int
        Views that show it with both neighbours.
    board : Board
        With its corners filled in.
    """

    lines: np.ndarray
    line_sd: np.ndarray
    lengths: dict
    length_sd: dict
    n_views: dict
    n_lengths: dict
    board: Board


def measure_outline(views, board, models):
    """Outer edges of the board from all images of all cameras.

    Parameters
    ----------
    views : dict of str to sequence of BoardView
        By camera. Views of the wide search (with `votes`) must have their patterns turned alike, see
        :func:`resolve_turns`.
    board : Board
        With a pattern (or with known corners, and poses in the views).
    models : dict of str to CameraModel

    Returns
    -------
    Outline

    Raises
    ------
    ValueError
        If an edge was seen in no image, naming it.

    Notes
    -----
    Median over the views of the edge's offset at two places; the spread is 1.4826 times the median deviation. A board
    bends between placements, so the spread is its own, not the noise of the images.
    """
    usable = [(v, models[camera]) for camera, group in views.items() for v in group if not v.reason]
    seen = {n: [board_line(v, v.edge(n), m) for v, m in usable if v.edge(n) is not None] for n in board.edges}
    missing = [name for name, found in seen.items() if not found]
    if missing:
        raise ValueError(
            f"edge '{missing[0]}' of board '{board.name}' was found in none of {len(usable)} images: pick it by hand "
            "in edges.csv or give the corners of the board"
        )
    rough = np.stack([np.median(seen[name], axis=0) for name in board.edges])
    corners = corners_of_lines(rough / np.linalg.norm(rough[:, :2], axis=1, keepdims=True))
    fitted = [_median_line(seen[n], corners[[i, (i + 1) % len(corners)]]) for i, n in enumerate(board.edges)]
    lines = np.stack([line for line, _ in fitted])
    measured = Board(board.name, board.edges, corners_of_lines(lines), board.pattern, board.features)
    per_view = [edge_lengths(v, measured, m) for v, m in usable]
    lengths = {n: np.array([row[n] for row in per_view if n in row]) for n in board.edges}
    return Outline(
        lines,
        np.array([sd for _, sd in fitted]),
        {n: float(x) for n, x in measured.lengths().items()},
        {n: _spread(x) for n, x in lengths.items()},
        {n: len(seen[n]) for n in board.edges},
        {n: len(x) for n, x in lengths.items()},
        measured,
    )


def _spread(values):
    return float(1.4826 * np.median(np.abs(values - np.median(values)))) if len(values) > 1 else float("nan")


def board_line(view, edge, model):
    """The image line of an edge as a line on the board, unit normal outwards, metres; shape (3,)."""
    pose = view.T_camera_board.as_matrix()
    line = (model.matrix @ pose[:3, [0, 1, 3]]).T @ edge.line
    return line / np.hypot(line[0], line[1])


def _median_line(lines, ends):
    """Median line from its offsets at two ends, and the spread at the middle."""
    lines = np.asarray(lines)
    normal = np.median(lines[:, :2], axis=0)
    normal /= np.linalg.norm(normal)
    # where every line crosses the normals raised at the two ends
    offsets = -(lines[:, :2] @ ends.T + lines[:, 2:]) / (lines[:, :2] @ normal)[:, None]
    middle = np.median(offsets, axis=0)
    a, b = ends + middle[:, None] * normal
    along = (b - a) / np.linalg.norm(b - a)
    out = np.array([along[1], -along[0]])
    out = out if out @ normal > 0 else -out
    return np.r_[out, -out @ a], _spread(offsets.mean(axis=1)) if len(lines) > 1 else float("nan")


def edge_lengths(view, board, model):
    """Lengths of the edges whose two corners can be seen in one view.

    Parameters
    ----------
    view : BoardView
    board : Board
    model : CameraModel

    Returns
    -------
    dict of str to float
        Metres, in the scale of the board; only edges found together with both neighbours.
    """
    if view.reason:
        return {}
    lines = {e.name: board_line(view, e, model) for e in view.edges}
    out = {}
    for i, name in enumerate(board.edges):
        around = [board.edges[i - 1], name, board.edges[(i + 1) % len(board.edges)]]
        if all(n in lines for n in around):
            corners = corners_of_lines(np.stack([lines[n] for n in around]))
            out[name] = float(np.linalg.norm(corners[2] - corners[1]))
    return out


def rough_outline(lines, board):
    """An outline to predict edges with: lines without any spread."""
    corners = corners_of_lines(lines)
    rough = Board(board.name, board.edges, corners, board.pattern, board.features)
    none, unknown = dict.fromkeys(board.edges, 0), dict.fromkeys(board.edges, np.nan)
    return Outline(lines, np.full(len(lines), np.nan), rough.lengths(), unknown, none, none, rough)
