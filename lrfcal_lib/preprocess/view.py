"""The board in one image: its pose and its straight outer edges."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import PurePath

import numpy as np
from scipy.spatial.transform import RigidTransform

from lrfcal_lib.board import corners_of_lines
from lrfcal_lib.camera import pinhole, undistort
from lrfcal_lib.preprocess.edges import (
    FULL_CONTRAST,
    EdgeNotSeen,
    ImageEdge,
    picked_edge,
    refine_edge,
    sample,
    step_contrast,
)
from lrfcal_lib.preprocess.outline import board_line
from lrfcal_lib.preprocess.pattern import (
    PatternNotFound,
    find_pattern,
    first_pose,
    mirror_pattern,
    pose_adjustment,
    turn_pattern,
)
from lrfcal_lib.preprocess.silhouette import OutlineNotFound, board_poses, find_polygon, polygon_edges
from lrfcal_lib.preprocess.together import pose_with_edges
from lrfcal_lib.preprocess.wide import edge_votes, side_lines, widest_lines

WINDOW = 0.010  # half width of the narrow search, metres: edges sit within 1-3 mm (sd) in the sheet's frame
PREDICTION_SIGMA = 0.005  # of an edge on the board, metres
CORNER_INSET = 0.03  # share of an edge left out at both ends: corners curl and are torn

COARSE_PROFILES, COARSE_ACROSS = 24, 25  # samples along and across each edge when orders of corners are compared
CLEAR_SHARE = 0.7  # an order with less than this share of the best score is ruled out


@dataclass(frozen=True)
class BoardView:
    """The board in one image.

    Attributes
    ----------
    camera, file : str
        Name of the camera, and of the image's file without its folder.
    placement : int
        -1 where the image belongs to none.
    pitch : float
        Of the platform, radians; NaN if unknown.
    pixels : ndarray, shape (k, 2), or None
        Recorded pixels of the pattern's corners, in the order of ``pattern.points()``.
    T_camera_board : RigidTransform or None
    covariance : ndarray, shape (6, 6), or None
        Of ``[w, v]`` of the pose (see :mod:`lrfcal_lib`).
    edges : tuple of ImageEdge
    rejected : tuple of (str, str)
        Edges that cannot be used and why.
    reason : str
        Why the image cannot be used; empty if it can.
    alternatives : tuple of RigidTransform
        Other poses that explain a board without pattern as well.
    votes : ndarray, shape (4, n), or None
        Wide search only: share of the profiles that agree on an edge at each distance outside the pattern.
    """

    camera: str
    file: str
    placement: int
    pitch: float
    pixels: np.ndarray | None = None
    T_camera_board: RigidTransform | None = None
    covariance: np.ndarray | None = None
    edges: tuple[ImageEdge, ...] = ()
    rejected: tuple[tuple[str, str], ...] = ()
    reason: str = ""
    alternatives: tuple = ()
    votes: np.ndarray | None = None

    def edge(self, name):
        """The edge of that name, None if it was not seen."""
        return next((e for e in self.edges if e.name == name), None)


def view_board(
    image,
    board,
    model,
    outline=None,
    picks=(),
    *,
    camera="",
    file="",
    placement=-1,
    pitch=np.nan,
    pixels=None,
    relief=None,
    guess=None,
):
    """Find the board, its pose and its straight edges in one image.

    Parameters
    ----------
    image : ndarray of uint8, shape (h, w) or (h, w, 3)
    board : Board
    model : CameraModel
    outline : Outline, optional
        Predicts the edges of a board whose corners are not known. Without it they are searched widely around the
        pattern.
    picks : sequence of EdgePick
        Edges picked by hand (``camera, file, edge`` and ``ends``, recorded pixels); those of this image override the
        detector.
    camera, file, placement, pitch
        Copied to the view.
    pixels : ndarray, shape (k, 2), optional
        Corners of the pattern where they are known already, in the right order.
    relief : ndarray, shape (k,), optional
        Heights of the pattern's corners, metres.
    guess : RigidTransform, optional
        Rough ``T_camera_board``; chooses between the poses of a board without pattern.

    Returns
    -------
    BoardView
        An image that cannot be used is no error: `reason` says why.

    Raises
    ------
    ValueError
        If a pick names an edge that the board does not have, or a board without pattern has no known corners.
    """
    view = BoardView(camera, file, placement, pitch)
    picks = _picks_of(picks, view, board)
    if image.shape[:2] != (model.height, model.width):
        sizes = (
            f"the image is {image.shape[1]} x {image.shape[0]}, the intrinsics are for {model.width} x {model.height}"
        )
        return replace(view, reason=f"{sizes} pixels")
    try:
        if board.pattern is None:
            return _view_plain(view, image, board, model, picks, guess)
        lines = _known_lines(board, outline)
        if pixels is not None:
            return _joined(_view_pattern(view, image, board, model, lines, picks, pixels, relief), board, model, relief)
        orders = pattern_orders(find_pattern(image, board.pattern), board, lines)
        views = [_view_pattern(view, image, board, model, lines, picks, p, relief) for p in orders]
        best = views[0] if lines is None else max(views, key=lambda v: _support(v, board, model, lines))
        return _joined(best, board, model, relief)
    except (PatternNotFound, OutlineNotFound, EdgeNotSeen) as error:
        return replace(view, reason=str(error))


def _picks_of(picks, view, board):
    name = PurePath(view.file).name
    mine = [p for p in picks if p.camera == view.camera and PurePath(p.file).name == name]
    for pick in mine:
        if pick.edge not in board.edges:
            raise ValueError(f"{pick.file}: picked edge '{pick.edge}' is not one of the board's edges {board.edges}")
    return {p.edge: np.asarray(p.ends, float) for p in mine}


def _known_lines(board, outline):
    if outline is not None:
        return np.asarray(outline.lines)
    return None if board.corners is None else board.lines()


def pattern_orders(pixels, board, lines):
    """Orders of the corners that a chessboard allows, those of a mirrored board frame in the second half."""
    if lines is None:
        return [pixels]
    orders = [pixels, turn_pattern(pixels)]
    if board.pattern.rows == board.pattern.columns:
        quarter = pixels.reshape(board.pattern.rows, -1, 2)[::-1].swapaxes(0, 1).reshape(-1, 2)
        orders += [quarter, turn_pattern(quarter)]
    return orders + [mirror_pattern(p, board.pattern) for p in orders]


def _support(view, board, model, lines):
    """Profiles that found an edge, each counting less the farther its edge lies from where the outline puts it."""
    corners, score = corners_of_lines(lines), 0.0
    for edge in view.edges:
        i = board.edges.index(edge.name)
        ends = corners[[i, (i + 1) % len(corners)]]
        seen = board_line(view, edge, model)
        off = np.sqrt(np.mean((ends @ seen[:2] + seen[2]) ** 2))
        score += edge.n_points / (1 + (off / PREDICTION_SIGMA) ** 2)
    return score


def _view_pattern(view, image, board, model, lines, picks, pixels, relief):
    pose, covariance, used = pose_adjustment(pixels, board.pattern, model, relief)
    pixels = np.where(used[:, None], pixels, np.nan)
    view = replace(view, pixels=pixels, T_camera_board=pose, covariance=covariance)
    votes = None
    if lines is None:
        votes = edge_votes(image, board, model, pose)
        lines = widest_lines(votes, board)
    edges, rejected = _search(image, board, model, pose, lines, picks, pixels)
    return replace(view, edges=tuple(edges), rejected=tuple(rejected), votes=votes)


def _joined(view, board, model, relief):
    """The view with the pose from corners and edges together, where the outline is stated."""
    if board.corners is None:
        return view
    joined = pose_with_edges(view.T_camera_board, view.covariance, view.pixels, view.edges, board, model, relief)
    return replace(view, T_camera_board=joined[0], covariance=joined[1])


def _search(image, board, model, pose, lines, picks, pixels):
    inner = undistort(np.nanmean(pixels, axis=0), model)
    # where a side shows no edge, its neighbours are taken to end a square outside the pattern
    around = lines if board.pattern is None else side_lines(board.pattern, np.full(4, board.pattern.square))
    corners = corners_of_lines(np.where(np.isfinite(lines), lines, around) if len(lines) == 4 else lines)
    edges, rejected = [], []
    for i, name in enumerate(board.edges):
        if name in picks:
            edges.append(_pick(name, picks[name], inner, model))
            continue
        try:
            ends = corners[[i, (i + 1) % len(corners)]]
            edges.append(_predicted_edge(image, model, pose, name, ends, lines[i], inner))
        except EdgeNotSeen as error:
            rejected.append((name, str(error)))
    return edges, rejected


def _pick(name, ends, inner, model):
    start, end = undistort(ends, model)
    return picked_edge(name, start, end, (start + end) / 2 - inner)


def _predicted_edge(image, model, pose, name, corners, line, inner):
    """Narrow search around an edge drawn on the board."""
    if not np.isfinite(line).all():
        raise EdgeNotSeen("no clear edge outside the pattern")
    inset = CORNER_INSET * (corners[1] - corners[0])
    ends = np.stack([corners[0] + inset, corners[1] - inset])
    middle = ends.mean(axis=0)
    on_board = np.concatenate([ends, [middle, middle + WINDOW * line[:2]]])
    uv = pinhole(pose.apply(np.column_stack([on_board, np.zeros(4)])), model)
    if not np.isfinite(uv).all():
        raise EdgeNotSeen("it passes behind the camera")
    scale = np.linalg.norm(uv[3] - uv[2]) / WINDOW
    half_width = np.clip(scale * WINDOW, 3.0, 40.0)
    return refine_edge(image, model, name, uv[0], uv[1], uv[2] - inner, half_width, max(scale * PREDICTION_SIGMA, 1.0))


def _view_plain(view, image, board, model, picks, guess):
    if set(picks) == set(board.edges):
        found = _poses_from_picks(picks, board, model)
    else:
        corners = find_polygon(image, len(board.known_corners()))
        found = board_poses(polygon_edges(image, model, corners), board, model)
        found = [item for item in found if _agrees(item[2], picks, model)]
    if not found:
        return replace(view, reason=f"no pose of board '{board.name}' explains the outline in the image")
    if guess is not None:
        found.sort(key=lambda item: (item[0].rotation * guess.rotation.inv()).magnitude())
    pose, covariance, edges = found[0]
    inner = np.mean([e.centre for e in edges], axis=0)
    edges = tuple(_pick(e.name, picks[e.name], inner, model) if e.name in picks else e for e in edges)
    return replace(
        view, T_camera_board=pose, covariance=covariance, edges=edges, alternatives=tuple(p for p, _, _ in found[1:])
    )


def _poses_from_picks(picks, board, model):
    inner = undistort(np.mean([picks[n] for n in board.edges], axis=(0, 1)), model)
    edges = [_pick(name, picks[name], inner, model) for name in board.edges]
    wanted = [e.name for e in edges]
    # sides in the turning sense of the image; board_poses tries every start, picks know the names
    found = board_poses(edges[::-1], board, model)
    return [item for item in found if all(np.allclose(e.centre, edges[wanted.index(e.name)].centre) for e in item[2])]


def _agrees(edges, picks, model, within=10.0):
    """Whether the edges carry the names that were picked by hand."""
    named = {e.name: e for e in edges}
    off = [np.abs(undistort(ends, model) @ named[n].line[:2] + named[n].line[2]).max() for n, ends in picks.items()]
    return all(o < within for o in off)


def order_scores(image, board, model, orders):
    """How well the known outline of the board fits one image, for every order of the pattern's corners.

    Parameters
    ----------
    image : ndarray of uint8
    board : Board
        With corners.
    model : CameraModel
    orders : sequence of ndarray, shape (k, 2)
        Of :func:`pattern_orders`.

    Returns
    -------
    ndarray
        Of a few coarse profiles across the outline; orders that they cannot tell apart are compared by the edges that
        the full search finds.
    """
    lines = board.lines()
    scores = np.array([_coarse_support(image, board, model, lines, p) for p in orders])
    likely = np.flatnonzero(scores >= CLEAR_SHARE * scores.max())
    if len(likely) > 1:
        empty, coarse = BoardView("", "", -1, np.nan), scores.max()
        views = [_view_pattern(empty, image, board, model, lines, {}, orders[i], None) for i in likely]
        support = np.array([_support(v, board, model, lines) for v in views])
        scores = np.zeros(len(orders))
        scores[likely] = coarse * support / max(support.max(), 1e-9)
    return scores


def _coarse_support(image, board, model, lines, pixels):
    """Profiles with a step near the predicted outline, counted over all its edges."""
    pose = first_pose(board.pattern.points(), pixels, model)
    if pose.translation[2] <= 0:
        return 0.0
    corners = corners_of_lines(lines)
    across = np.linspace(-2, 2, COARSE_ACROSS) * PREDICTION_SIGMA
    along = np.linspace(CORNER_INSET, 1 - CORNER_INSET, COARSE_PROFILES)
    score = 0.0
    for line, start, end in zip(lines, corners, np.roll(corners, -1, axis=0), strict=True):
        xy = start + along[:, None] * (end - start) + across[:, None, None] * line[:2]
        points = np.concatenate([xy, np.zeros(xy.shape[:2] + (1,))], axis=-1).reshape(-1, 3)
        uv = np.nan_to_num(pinhole(pose.apply(points), model), nan=-1e6).reshape(xy.shape)
        height = step_contrast(sample(image, model, uv), 1.5, along=1)
        weight = height / (height + FULL_CONTRAST) * np.exp(-0.5 * (across / PREDICTION_SIGMA) ** 2)[:, None]
        score += np.median(weight.max(axis=0))
    return score
