"""The board in one image: its pose and its straight outer edges, with a pattern or plain."""

from dataclasses import dataclass, replace
from itertools import compress

import numpy as np
from scipy.spatial.transform import RigidTransform

from lrfcal_lib.fit.covariance import solve_each
from lrfcal_lib.model.board import Board, corners_of_lines, side_ends
from lrfcal_lib.model.camera import CameraModel, line_distance, undistort
from lrfcal_lib.model.geometry import length_of, pose_array
from lrfcal_lib.preprocess.edges_in_image import (
    FULL_CONTRAST,
    EdgeNotSeen,
    ImageEdge,
    on_board,
    picked_edge,
    refine_edge,
    sample,
    step_contrast,
)
from lrfcal_lib.preprocess.intrinsics import board_pose
from lrfcal_lib.preprocess.outline_poses import find_polygon, outline_poses
from lrfcal_lib.preprocess.pose_from_lines import line_residuals, pose_from_edges

SEARCH_PX = 4.0  # to both sides of the outline of a dark board
OUTLINE_INSET = 0.04  # share of a side of that outline left out at both ends
SAME_NAMES_PX = 10.0  # from picks to the edges of their names
# an edge disagrees with a pose beyond this: 1 in 10000 true ones (two degrees of freedom)
AGREE_CHI2 = 18.4
# half width of the narrow search, metres: edges sit within 1-3 mm (sd) in the sheet's frame
WINDOW = 0.010
LEAST_REACH_PX = 3.0
MOST_REACH_PX = 40.0
PREDICTION_SIGMA = 0.005  # of an edge on the board, metres
CORNER_INSET = 0.03  # share of an edge left out at both ends: corners curl and are torn
# samples along and across each edge when orders of corners are compared
COARSE_PROFILES = 24
COARSE_ACROSS = 25
COARSE_SMOOTH = 1.5  # samples; of the derivative of a Gaussian across the edge


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
    alternatives : tuple of BoardView
        Other poses that explain a board without pattern as well, with the names of the edges that
        go with them.
    """

    camera: str = ""
    file: str = ""
    placement: int = -1
    pitch: float = np.nan
    pixels: np.ndarray | None = None
    T_camera_board: RigidTransform | None = None
    covariance: np.ndarray | None = None
    edges: tuple[ImageEdge, ...] = ()
    rejected: tuple[tuple[str, str], ...] = ()
    reason: str = ""
    alternatives: tuple = ()

    def edge(self, name: str) -> ImageEdge | None:
        """The edge of that name, None without one."""
        return next((e for e in self.edges if e.name == name), None)


def view_board(
    image: np.ndarray,
    board: Board,
    model: CameraModel,
    view: BoardView = BoardView(),
    picks=None,
    *,
    lines: np.ndarray | None = None,
    relief: np.ndarray | float = 0.0,
) -> BoardView:
    """Find the board, its pose and its straight edges in one image.

    Parameters
    ----------
    image : ndarray of uint8, shape (h, w) or (h, w, 3)
    board : Board
        With a pattern, or with known corners.
    model : CameraModel
        For images of this size.
    view : BoardView
        Says whose image it is; for a board with a pattern it has the `pixels` of its corners, in
        the right order.
    picks : dict of str to ndarray, shape (2, 2), optional
        Ends of edges picked by hand (recorded pixels), which override the detector.
    lines, relief : ndarray
        For a board with a pattern: the outline (E, 3) that predicts its edges (without it none are
        looked for), and the heights of the corners (k,), metres.

    Returns
    -------
    BoardView
        An image that cannot be used is no error: `reason` says why.
    """
    picked = {name: undistort(ends, model) for name, ends in (picks or {}).items()}
    if board.pattern is None:
        return _view_plain(view, image, board, model, picked)
    view = _view_pattern(view, image, board, model, picked, lines, relief)
    if board.corners is None:
        return view
    pose, covariance = pose_with_edges(view, board, model)
    return replace(view, T_camera_board=pose, covariance=covariance)


def order_scores(
    image: np.ndarray, board: Board, model: CameraModel, poses: RigidTransform
) -> np.ndarray:
    """How well the known outline of the board fits one image, for every order of its corners.

    Parameters
    ----------
    image : ndarray of uint8, shape (h, w) or (h, w, 3)
    board : Board
    model : CameraModel
    poses : RigidTransform
        Rough ``T_camera_board``, a stack of one for every order.

    Returns
    -------
    ndarray, shape (n,)
        From a few coarse profiles across the outline.
    """
    lines = board.lines()
    offset = np.linspace(-2, 2, COARSE_ACROSS) * PREDICTION_SIGMA
    along = np.linspace(0, 1, COARSE_PROFILES)
    ends = side_ends(board.known_corners(), CORNER_INSET)
    on_edges = np.column_stack([1 - along, along]) @ ends
    xy = on_edges + offset[:, None, None, None] * lines[:, None, :2]
    flat = xy.reshape(COARSE_ACROSS, -1, 2)
    uv = np.concatenate([on_board(flat, pose, model) for pose in poses], axis=1)
    height = step_contrast(sample(image, model, uv), COARSE_SMOOTH, along=1)
    expected = np.exp(-0.5 * (offset / PREDICTION_SIGMA) ** 2)
    weight = height / (height + FULL_CONTRAST) * expected[:, None]
    of_profiles = weight.max(axis=0).reshape(len(poses), -1, COARSE_PROFILES)
    return np.median(of_profiles, axis=2).sum(axis=1)


def pose_with_edges(view, board, model: CameraModel) -> tuple[RigidTransform, np.ndarray]:
    """Pose of a board from the corners of its pattern and its edges, weighted by their covariances.

    Least squares of ``|d|^2_P + sum_e |r_e|^2_S``: `d` is the increment from the pose of the
    corners (covariance P), `r_e` the distances of the edge's two board corners from its image line;
    their covariance holds the systematic part of 0.1 px, so a sharp edge does not outweigh all
    corners. Edges that the corners contradict stay out.

    Parameters
    ----------
    view : BoardView
        With the pose from the corners alone.
    board : Board
        With a pattern.
    model : CameraModel

    Returns
    -------
    pose : RigidTransform
        ``T_camera_board``.
    covariance : ndarray, shape (6, 6)
    """
    pose = view.T_camera_board
    covariance = view.covariance
    if not view.edges:
        return pose, covariance
    misses, by_pose = line_residuals(view.edges, board, model, pose_array(pose))
    expected = np.eye(2) + by_pose @ covariance @ by_pose.mT
    chi2 = np.vecdot(misses, solve_each(expected, misses))
    agreeing = list(compress(view.edges, chi2 < AGREE_CHI2))
    if not agreeing:
        return pose, covariance
    return pose_from_edges(agreeing, board, model, pose, covariance)[:2]


def _view_pattern(view, image, board, model, picked, lines, relief):
    """The view with the pose from the pattern's corners, and the edges near it."""
    pose, covariance, used = board_pose(view.pixels, board.pattern, model, relief)
    pixels = np.where(used[:, None], view.pixels, np.nan)
    view = replace(view, pixels=pixels, T_camera_board=pose, covariance=covariance)
    if lines is None:
        unknown = [(name, "the outline of the board is not known") for name in board.edges]
        return replace(view, rejected=tuple(unknown))
    inner = undistort(np.nanmean(pixels, axis=0), model)
    ends = side_ends(corners_of_lines(lines), CORNER_INSET)
    middle = ends.mean(axis=1, keepdims=True)
    beside = middle + WINDOW * lines[:, None, :2]
    places = on_board(np.concatenate([ends, middle, beside], axis=1), pose, model)
    edges = []
    rejected = []
    for name, (a, b, middle_px, beside_px) in zip(board.edges, places, strict=True):
        if name in picked:
            edges.append(picked_edge(name, picked[name], inner))
            continue
        window = length_of(beside_px - middle_px)
        reach = np.clip(window, LEAST_REACH_PX, MOST_REACH_PX)
        prior = max(window / WINDOW * PREDICTION_SIGMA, 1.0)
        outward = middle_px - inner
        try:
            edges.append(refine_edge(image, model, name, a, b, outward, reach, prior))
        except EdgeNotSeen as error:
            rejected.append((name, str(error)))
    return replace(view, edges=tuple(edges), rejected=tuple(rejected))


def _view_plain(view, image, board, model, picked):
    """The view of a dark board without pattern, with a view for every other pose."""
    try:
        sides = _sides(image, board, model, picked)
    except EdgeNotSeen as error:
        return replace(view, reason=str(error))
    views = []
    for found in outline_poses(sides, board, model, view):
        inner = np.mean([edge.centre for edge in found.edges], axis=0)
        edges = {edge.name: edge for edge in found.edges}
        off = [line_distance(ends, edges[name].line) for name, ends in picked.items()]
        if np.abs(off).max(initial=0.0) >= SAME_NAMES_PX:
            continue
        edges |= {name: picked_edge(name, ends, inner) for name, ends in picked.items()}
        views.append(replace(found, edges=tuple(edges.values())))
    if not views:
        reason = f"no pose of board '{board.name}' explains the outline in the image"
        return replace(view, reason=reason)
    return replace(views[0], alternatives=tuple(views[1:]))


def _sides(image, board, model, picked):
    """Sides of a plain board in the turning sense of the image, from picks of all or the detector.

    `picked` are ends by name, undistorted pixels.
    """
    if set(picked) == set(board.edges):
        inner = np.mean(list(picked.values()), axis=(0, 1))
        return [picked_edge(name, picked[name], inner) for name in board.edges][::-1]
    corners = undistort(find_polygon(image, len(board.edges), model), model)
    middle = corners.mean(axis=0)
    return [
        refine_edge(image, model, "", a, b, (a + b) / 2 - middle, SEARCH_PX)
        for a, b in side_ends(corners, OUTLINE_INSET)
    ]
