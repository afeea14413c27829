"""The board in one image: its pose and its straight outer edges, with a pattern or plain."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import PurePath

import cv2
import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from lrfcal_lib.model.board import corners_of_lines
from lrfcal_lib.model.camera import pinhole, pinhole_jacobian, project, undistort
from lrfcal_lib.model.geometry import hat
from lrfcal_lib.preprocess.edges_in_image import (
    FULL_CONTRAST,
    EdgeNotSeen,
    ImageEdge,
    board_line,
    edge_votes,
    picked_edge,
    refine_edge,
    sample,
    side_lines,
    step_contrast,
    widest_lines,
)
from lrfcal_lib.preprocess.intrinsics import SIGMA_FLOOR_PX
from lrfcal_lib.preprocess.pattern_in_image import (
    PatternNotFound,
    find_pattern,
    first_pose,
    grey,
    mirror_pattern,
    pose_adjustment,
    raised_points,
    turn_pattern,
)

LEAST_AREA_SHARE = 0.002  # of the image
LEAST_FILL = 0.9  # of the polygon by the dark region, and the other way round
SEARCH_PX = 4.0
EXACT_PX = 0.5  # a pose explains the outline when its corners fall this near (or within 4 sigma)


class OutlineNotFound(ValueError):
    """No dark region with straight edges in the image."""


def find_polygon(image, n_corners):
    """Corners of the largest dark region that is a convex polygon, to about a pixel.

    Parameters
    ----------
    image : ndarray of uint8, shape (h, w) or (h, w, 3)
    n_corners : int

    Returns
    -------
    ndarray, shape (n_corners, 2)
        Recorded pixels; the turning sense is that of x to y in the image (right to down).

    Raises
    ------
    OutlineNotFound
        If no dark region looks like such a polygon, or if it is cut by the image border.
    """
    picture = cv2.GaussianBlur(grey(image), (0, 0), 1.0)
    level = cv2.threshold(picture, 0, 255, cv2.THRESH_BINARY + cv2.THRESH_OTSU)[0]
    best, best_area, cut = None, LEAST_AREA_SHARE * picture.size, False
    for threshold in np.array([0.4, 0.6, 0.8, 1.0, 1.2]) * level:
        dark = (picture < threshold).astype(np.uint8)
        for contour in cv2.findContours(dark, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)[0]:
            area = cv2.contourArea(contour)
            if area <= best_area:
                continue
            corners = _polygon(contour, area, n_corners)
            touches = corners is not None and _touches_border(contour, picture.shape)
            cut |= touches
            if corners is not None and not touches:
                best, best_area = corners, area
    if best is None:
        raise OutlineNotFound(
            "the dark board is cut by the image border"
            if cut
            else f"no dark region with {n_corners} straight edges in the image: the board must stand out from the rest"
        )
    return best


def _polygon(contour, area, n_corners):
    """The polygon around a contour, None when the region is not filled by it or has other corners."""
    hull = cv2.convexHull(contour)
    if area < LEAST_FILL * cv2.contourArea(hull) or len(hull) < n_corners:
        return None
    if n_corners == 3:
        corners = cv2.minEnclosingTriangle(hull)[1]
        corners = None if corners is None else corners.reshape(-1, 2)
    else:
        corners = cv2.approxPolyN(hull, n_corners, None, -1.0, True).reshape(-1, 2)
    if corners is None or len(corners) != n_corners or area < LEAST_FILL * cv2.contourArea(corners.astype(np.float32)):
        return None
    corners = corners.astype(float)
    x, y = corners.T
    turn = np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y)
    return corners if turn > 0 else corners[::-1]


def _touches_border(contour, shape):
    low, high = contour.reshape(-1, 2).min(axis=0), contour.reshape(-1, 2).max(axis=0)
    return bool(np.any(low <= 1) or high[0] >= shape[1] - 2 or high[1] >= shape[0] - 2)


def polygon_edges(image, model, corners):
    """Sides of a polygon refined to sub-pixel lines.

    Parameters
    ----------
    image : ndarray of uint8
    model : CameraModel
    corners : ndarray, shape (n, 2)
        Recorded pixels.

    Returns
    -------
    list of ImageEdge
        Side i from corner i to corner i + 1, nameless.

    Raises
    ------
    EdgeNotSeen
        If one side cannot be fitted: without all sides there is no pose.
    """
    ideal = undistort(corners, model)
    middle = ideal.mean(axis=0)
    edges = []
    for a, b in zip(ideal, np.roll(ideal, -1, axis=0), strict=True):
        inset = 0.04 * (b - a)
        edges.append(refine_edge(image, model, "", a + inset, b - inset, (a + b) / 2 - middle, SEARCH_PX))
    return edges


def board_poses(edges, board, model):
    """All poses of a board that explain the sides of a polygon.

    Parameters
    ----------
    edges : sequence of ImageEdge
        In the turning sense of :func:`find_polygon`; names are ignored.
    board : Board
        With known corners.
    model : CameraModel

    Returns
    -------
    list of (RigidTransform, ndarray of shape (6, 6), tuple of ImageEdge)
        ``T_camera_board``, its covariance and the edges with their names, most frontal first. The printed side (z of
        the board) faces the camera.

    Notes
    -----
    Three lines are six equations for six unknowns: nearly every picture of a triangle can be any of its three turned
    versions, and each of them in up to four poses. The list keeps them all; only other knowledge (a start value, the
    LRF, another camera) can choose. A polygon with more sides is over-determined and leaves one or two.
    """
    # seen from the printed side x to y turns left, in the image (v down) that is the other way round
    sides = list(edges)[::-1]
    found = []
    for shift in range(len(sides)):
        turned = sides[shift:] + sides[:shift]
        named = tuple(_named(edge, name) for edge, name in zip(turned, board.edges, strict=True))
        corners = corners_of_lines(np.stack([e.line for e in named]))
        for start in _start_poses(board, corners, model):
            pose, covariance, chi2 = pose_from_edges(named, board, model, start)
            if _explains(pose, board, model, corners, chi2) and not _known(pose, found):
                found.append((pose, covariance, named))
    return sorted(found, key=lambda item: -frontal(item[0]))


def _named(edge, name):
    return ImageEdge(name, edge.line, edge.covariance, edge.centre, edge.ends, edge.n_points, edge.rms_px, edge.picked)


def _start_poses(board, corners, model):
    flat = np.column_stack([board.known_corners(), np.zeros(len(board.edges))])
    image = np.ascontiguousarray(corners, float)
    if len(flat) == 3:
        out = cv2.solveP3P(flat, image, model.matrix, None, cv2.SOLVEPNP_P3P)
    else:
        out = cv2.solvePnPGeneric(flat, image, model.matrix, None, flags=cv2.SOLVEPNP_IPPE)
    poses = [
        RigidTransform.from_components(t.ravel(), Rotation.from_rotvec(w.ravel()))
        for w, t in zip(out[1], out[2], strict=True)
    ]
    return [p for p in poses if p.translation[2] > 0 and frontal(p) > 0]


def frontal(pose):
    """Cosine between the board's z axis and the direction to the camera: 1 seen from the front, below 0 from behind."""
    return float(-pose.rotation.as_matrix()[:, 2] @ pose.translation / np.linalg.norm(pose.translation))


def _known(pose, found):
    return any((pose.rotation * p.rotation.inv()).magnitude() < 1e-3 for p, _, _ in found)


def _explains(pose, board, model, corners, chi2):
    flat = np.column_stack([board.known_corners(), np.zeros(len(board.edges))])
    off = np.linalg.norm(pinhole(pose.apply(flat), model) - corners, axis=1).max()
    return bool(frontal(pose) > 0 and (off < EXACT_PX or chi2 < 16 * len(corners)))


def pose_from_edges(edges, board, model, start, rounds=15, covariance=None):
    """Pose of a board from its image lines by whitened Gauss-Newton.

    Parameters
    ----------
    edges : sequence of ImageEdge
        Named; three or more, unless a covariance is given.
    board : Board
        With known corners.
    model : CameraModel
    start : RigidTransform
        ``T_camera_board``.
    rounds : int
    covariance : ndarray, shape (6, 6), optional
        Of ``[w, v]`` of `start`, where that is an observation of its own (the pattern's corners).

    Returns
    -------
    pose : RigidTransform
    covariance : ndarray, shape (6, 6)
    chi2 : float
        Sum of the squared whitened residuals.
    """
    pose = start
    white = np.zeros((0, 6)) if covariance is None else np.linalg.inv(np.linalg.cholesky(covariance))
    for _ in range(rounds):
        residual, jacobian = _all_residuals(edges, board, model, pose, start, white)
        step = np.linalg.lstsq(jacobian, -residual, rcond=1e-12)[0]
        turn = Rotation.from_rotvec(step[:3])
        pose = RigidTransform.from_components(pose.translation + step[3:], turn * pose.rotation)
        if np.abs(step).max() < 1e-12:
            break
    residual, jacobian = _all_residuals(edges, board, model, pose, start, white)
    return pose, np.linalg.pinv(jacobian.T @ jacobian, hermitian=True), float(residual @ residual)


def _all_residuals(edges, board, model, pose, start, white):
    """Residuals of the lines, then those of the start pose."""
    residual, jacobian = line_residuals(edges, board, model, pose)
    moved = np.r_[(pose.rotation * start.rotation.inv()).as_rotvec(), pose.translation - start.translation]
    return np.r_[residual, white @ moved], np.concatenate([jacobian, white])


def line_residuals(edges, board, model, pose):
    """Whitened distances of every edge's two corners from its image line, and their derivatives by [w, v]."""
    corners = board.known_corners()
    residuals, rows = [], []
    for edge in edges:
        i = board.edges.index(edge.name)
        ends = np.column_stack([corners[[i, (i + 1) % len(corners)]], [0.0, 0.0]])
        turned = pose.rotation.apply(ends)
        p_camera = turned + pose.translation
        uv = pinhole(p_camera, model)
        lever = (uv - edge.centre) @ [edge.line[1], -edge.line[0]]
        design = np.column_stack([np.ones(2), lever])
        white = np.linalg.inv(np.linalg.cholesky(design @ edge.covariance @ design.T))
        by_point = edge.line[:2] @ pinhole_jacobian(p_camera, model)
        by_pose = np.concatenate([-np.einsum("ni,nij->nj", by_point, hat(turned)), by_point], axis=1)
        residuals.append(white @ (uv @ edge.line[:2] + edge.line[2]))
        rows.append(white @ by_pose)
    return np.concatenate(residuals), np.concatenate(rows)


AGREE_CHI2 = 18.4  # an edge disagrees with a pose beyond this: 1 in 10000 true ones (two degrees of freedom)


def pose_with_edges(pose, covariance, pixels, edges, board, model, relief=None):
    """Pose of a board from the corners of its pattern and its edges, weighted by their covariances.

    Parameters
    ----------
    pose : RigidTransform
        ``T_camera_board`` from the corners alone.
    covariance : ndarray, shape (6, 6)
        Of ``[w, v]``.
    pixels : ndarray, shape (k, 2)
        Recorded pixels of the corners, NaN where one is not to be used.
    edges : sequence of ImageEdge
        Their covariances hold the systematic part of 0.1 px, so a sharp edge does not outweigh all corners.
    board : Board
        With known corners and a pattern.
    model : CameraModel
    relief : ndarray, shape (k,), optional
        Heights of the pattern's corners, metres.

    Returns
    -------
    T_camera_board : RigidTransform
    covariance : ndarray, shape (6, 6)

    Notes
    -----
    Least squares of ``|d|^2_P + sum_e |r_e|^2_S``: `d` is the increment from the pose of the corners (covariance P),
    `r_e` the distances of the edge's two board corners from its image line. Edges that the corners contradict stay
    out. The same starts from the pose mirrored in depth, and the pose that explains everything better is taken.
    """
    if not edges:
        return pose, covariance
    starts = [(pose, covariance)]
    starts.append(pose_adjustment(pixels, board.pattern, model, relief, start=mirrored_pose(pose, board.pattern))[:2])
    squares = np.array([_corner_squares(p, pixels, board, model, relief) for p, _ in starts])
    variance = max(squares.min() / np.isfinite(pixels).sum(), SIGMA_FLOOR_PX**2)
    # no agreement of the edges makes up for corners that fit worse than this
    possible = (squares - squares.min()) / variance <= AGREE_CHI2 * len(edges)
    found, costs = [], []
    for start in np.flatnonzero(possible):
        found.append(_joined(*starts[start], edges, board, model))
        off = [_edge_chi2(e, board, model, found[-1][0]) for e in edges]
        corners = _corner_squares(found[-1][0], pixels, board, model, relief) / variance
        costs.append(corners + np.minimum(off, AGREE_CHI2).sum())
    return found[int(np.argmin(costs))]


def mirrored_pose(pose, pattern):
    """The pose that shows nearly the same picture from far away: every point mirrored in depth about the pattern.

    Parameters
    ----------
    pose : RigidTransform
        ``T_camera_board``.
    pattern : Chessboard

    Returns
    -------
    RigidTransform
    """
    middle = pattern.points().mean(axis=0)
    at = pose.apply(middle)
    sight = at / np.linalg.norm(at)
    mirror = np.eye(3) - 2 * np.outer(sight, sight)
    rotation = Rotation.from_matrix(mirror @ pose.rotation.as_matrix() @ np.diag([1.0, 1.0, -1.0]))
    return RigidTransform.from_components(at - rotation.apply(middle), rotation)


def _joined(pose, covariance, edges, board, model):
    agreeing = agreeing_edges(edges, board, model, pose, covariance)
    if not agreeing:
        return pose, covariance
    return pose_from_edges(agreeing, board, model, pose, covariance=covariance)[:2]


def _corner_squares(pose, pixels, board, model, relief):
    seen = np.isfinite(pixels).all(axis=1)
    off = (pixels - project(pose.apply(raised_points(board.pattern, relief)), model))[seen]
    return float(np.nan_to_num(np.sum(off**2), nan=np.inf))


def _edge_chi2(edge, board, model, pose):
    residual = line_residuals([edge], board, model, pose)[0]
    return residual @ residual


def agreeing_edges(edges, board, model, pose, covariance, limit=AGREE_CHI2):
    """Edges that lie where a pose expects them, within its uncertainty and theirs.

    Parameters
    ----------
    edges : sequence of ImageEdge
    board : Board
        With known corners.
    model : CameraModel
    pose : RigidTransform
        ``T_camera_board``.
    covariance : ndarray, shape (6, 6)
    limit : float
        Of the chi-square of an edge (two degrees of freedom).

    Returns
    -------
    list of ImageEdge
    """
    out = []
    for edge in edges:
        residual, jacobian = line_residuals([edge], board, model, pose)
        expected = np.eye(2) + jacobian @ covariance @ jacobian.T
        if residual @ np.linalg.solve(expected, residual) < limit:
            out.append(edge)
    return out


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
            return _with_edges(
                _view_pattern(view, image, board, model, lines, picks, pixels, relief), board, model, relief
            )
        orders = pattern_orders(find_pattern(image, board.pattern), board, lines)
        views = [_view_pattern(view, image, board, model, lines, picks, p, relief) for p in orders]
        best = views[0] if lines is None else max(views, key=lambda v: _support(v, board, model, lines))
        return _with_edges(best, board, model, relief)
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


def _with_edges(view, board, model, relief):
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
