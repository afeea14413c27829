"""The board in one image: its pose and its straight outer edges, with a pattern or plain."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from lrfcal_lib.model.board import corners_of_lines
from lrfcal_lib.model.camera import line_distance, pinhole, pinhole_jacobian, project, undistort
from lrfcal_lib.model.geometry import apply_pose, gradient_by_pose, move_pose, pose_array, pose_transform, rotate_points
from lrfcal_lib.preprocess.edges_in_image import (
    FULL_CONTRAST,
    EdgeNotSeen,
    ImageEdge,
    board_line,
    picked_edge,
    refine_edge,
    sample,
    step_contrast,
)
from lrfcal_lib.preprocess.intrinsics import SIGMA_FLOOR_PX, board_pose, raised_points
from lrfcal_lib.preprocess.pattern_in_image import grey

LEAST_AREA_SHARE = 0.002  # of the image
LEAST_FILL = 0.9  # of the polygon by the dark region, and the other way round
SEARCH_PX = 4.0
EXACT_PX = 0.5  # a pose explains the outline when its corners fall this near (or within 4 sigma)
SAME_NAMES_PX = 10.0  # from picks to the edges of their names
POSE_ROUNDS = 15  # of Gauss-Newton
AGREE_CHI2 = 18.4  # an edge disagrees with a pose beyond this: 1 in 10000 true ones (two degrees of freedom)
WINDOW = 0.010  # half width of the narrow search, metres: edges sit within 1-3 mm (sd) in the sheet's frame
PREDICTION_SIGMA = 0.005  # of an edge on the board, metres
CORNER_INSET = 0.03  # share of an edge left out at both ends: corners curl and are torn
COARSE_PROFILES, COARSE_ACROSS = 24, 25  # samples along and across each edge when orders of corners are compared
CLEAR_SHARE = 0.7  # an order with less than this share of the best score is ruled out


class OutlineNotFound(ValueError):
    """No dark region with straight edges in the image."""


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

    def edge(self, name):
        """The edge of that name, None if it was not seen."""
        return next((e for e in self.edges if e.name == name), None)


def view_board(image, board, model, view=None, picks=None, *, pixels=None, lines=None, relief=None, guess=None):
    """Find the board, its pose and its straight edges in one image.

    Parameters
    ----------
    image : ndarray of uint8, shape (h, w) or (h, w, 3)
    board : Board
        With a pattern, or with known corners.
    model : CameraModel
    view : BoardView, optional
        Says whose image it is.
    picks : dict of str to ndarray, shape (2, 2), optional
        Ends of edges picked by hand (recorded pixels), which override the detector.
    pixels, lines, relief : ndarray
        For a board with a pattern: its corners (k, 2) in the right order, the outline (E, 3) that predicts its edges
        (without it none are looked for), and the heights of the corners (k,), metres.
    guess : RigidTransform, optional
        Rough ``T_camera_board``; chooses between the poses of a board without pattern.

    Returns
    -------
    BoardView
        An image that cannot be used is no error: `reason` says why.
    """
    view, picks = view or BoardView(), picks or {}
    if image.shape[:2] != (model.height, model.width):
        size = f"the image is {image.shape[1]} x {image.shape[0]}"
        return replace(view, reason=f"{size}, the intrinsics are for {model.width} x {model.height} pixels")
    if board.pattern is None:
        try:
            return _view_plain(view, image, board, model, picks, guess)
        except (OutlineNotFound, EdgeNotSeen) as error:
            return replace(view, reason=str(error))
    view = _view_pattern(view, image, board, model, picks, pixels, lines, relief)
    if board.corners is None:
        return view
    pose, covariance = pose_with_edges(view, board, model, relief)
    return replace(view, T_camera_board=pose, covariance=covariance)


def _view_pattern(view, image, board, model, picks, pixels, lines, relief):
    """The view with the pose from the pattern's corners, and the edges around it."""
    pose, covariance, used = board_pose(pixels, board.pattern, model, relief)
    pixels = np.where(used[:, None], pixels, np.nan)
    view = replace(view, pixels=pixels, T_camera_board=pose, covariance=covariance)
    if lines is None:
        return replace(view, rejected=tuple((name, "the outline of the board is not known") for name in board.edges))
    inner, corners, edges, rejected = undistort(np.nanmean(pixels, axis=0), model), corners_of_lines(lines), [], []
    for name, line, start, end in zip(board.edges, lines, corners, np.roll(corners, -1, axis=0), strict=True):
        try:
            found = _pick(name, picks[name], inner, model) if name in picks else None
            edges.append(found or _predicted_edge(image, model, pose, name, start, end, line, inner))
        except EdgeNotSeen as error:
            rejected.append((name, str(error)))
    return replace(view, edges=tuple(edges), rejected=tuple(rejected))


def _pick(name, ends, inner, model):
    start, end = undistort(ends, model)
    return picked_edge(name, start, end, (start + end) / 2 - inner)


def _predicted_edge(image, model, pose, name, start, end, line, inner):
    """Narrow search around an edge drawn on the board."""
    inset, middle = CORNER_INSET * (end - start), (start + end) / 2
    on_board = np.stack([start + inset, end - inset, middle, middle + WINDOW * line[:2]])
    uv = pinhole(pose.apply(np.column_stack([on_board, np.zeros(4)])), model)
    if not np.isfinite(uv).all():
        raise EdgeNotSeen("it passes behind the camera")
    scale = np.linalg.norm(uv[3] - uv[2]) / WINDOW
    half_width = np.clip(scale * WINDOW, 3.0, 40.0)
    return refine_edge(image, model, name, uv[0], uv[1], uv[2] - inner, half_width, max(scale * PREDICTION_SIGMA, 1.0))


def order_scores(image, board, model, orders, poses):
    """How well the known outline of the board fits one image, for every order of the pattern's corners.

    `orders` are the corners (n, k, 2) in each order, `poses` a stack of n rough ``T_camera_board``. The scores are
    those of a few coarse profiles across the outline; orders that they cannot tell apart are compared by the edges that
    the full search finds.
    """
    lines = board.lines()
    corners = corners_of_lines(lines)
    across = (np.linspace(-2, 2, COARSE_ACROSS) * PREDICTION_SIGMA)[:, None, None, None]
    along = np.linspace(CORNER_INSET, 1 - CORNER_INSET, COARSE_PROFILES)[:, None]
    start, way = corners[:, None], (np.roll(corners, -1, axis=0) - corners)[:, None]
    xy = start + along * way + across * lines[:, None, :2]
    points = np.column_stack([xy.reshape(-1, 2), np.zeros(xy.size // 2)])
    uv = np.nan_to_num(pinhole(apply_pose(pose_array(poses), points), model), nan=-1e6)
    strip = sample(image, model, np.moveaxis(uv.reshape(len(orders), COARSE_ACROSS, -1, 2), 0, 1))
    height = step_contrast(strip.reshape(COARSE_ACROSS, -1, strip.shape[-1]), 1.5, along=1)
    weight = height / (height + FULL_CONTRAST) * np.exp(-0.5 * (across[..., 0, 0] / PREDICTION_SIGMA) ** 2)
    scores = np.median(weight.max(axis=0).reshape(len(orders), len(lines), -1), axis=2).sum(axis=1)
    likely = np.flatnonzero(scores >= CLEAR_SHARE * scores.max())
    if len(likely) > 1:
        views = [_view_pattern(BoardView(), image, board, model, {}, orders[i], lines, None) for i in likely]
        support = np.array([_support(view, board, model, lines) for view in views])
        scores, coarse = np.zeros(len(orders)), scores.max()
        scores[likely] = coarse * support / max(support.max(), 1e-9)
    return scores


def _support(view, board, model, lines):
    """Profiles that found an edge, each counting less the farther its edge lies from where the outline puts it."""
    corners, score = corners_of_lines(lines), 0.0
    for edge in view.edges:
        i = board.edges.index(edge.name)
        seen = board_line(view, edge, model)
        off = np.sqrt(np.mean((corners[[i, (i + 1) % len(corners)]] @ seen[:2] + seen[2]) ** 2))
        score += edge.n_points / (1 + (off / PREDICTION_SIGMA) ** 2)
    return score


def pose_with_edges(view, board, model, relief=None):
    """Pose of a board and its covariance from the corners of its pattern and its edges, weighted by their covariances.

    `view` has the pose from the corners alone. Least squares of ``|d|^2_P + sum_e |r_e|^2_S``: `d` is the increment
    from that pose (covariance P), `r_e` the distances of the edge's two board corners from its image line; their
    covariance holds the systematic part of 0.1 px, so a sharp edge does not outweigh all corners. Edges that the
    corners contradict stay out. The same starts from the pose mirrored in depth, and the pose that explains everything
    better is taken.
    """
    first = view.T_camera_board, view.covariance
    if not view.edges:
        return first
    mirrored = mirrored_pose(view.T_camera_board, board.pattern)
    starts = [first, board_pose(view.pixels, board.pattern, model, relief, start=mirrored)[:2]]
    seen, points = np.isfinite(view.pixels).all(axis=1), raised_points(board.pattern, relief)

    def squares(pose):
        off = (view.pixels - project(pose.apply(points), model))[seen]
        return float(np.nan_to_num(np.sum(off**2), nan=np.inf))

    fits = np.array([squares(pose) for pose, _ in starts])
    variance = max(fits.min() / (2 * seen.sum()), SIGMA_FLOOR_PX**2)
    found, costs = [], []
    # no agreement of the edges makes up for corners that fit worse than this
    for k in np.flatnonzero((fits - fits.min()) / variance <= AGREE_CHI2 * len(view.edges)):
        pose, covariance = starts[k]
        residual, jacobian = line_residuals(view.edges, board, model, pose_array(pose))
        expected = np.eye(2) + jacobian @ covariance @ np.swapaxes(jacobian, 1, 2)
        chi2 = np.sum(residual * np.linalg.solve(expected, residual[..., None])[..., 0], axis=1)
        agreeing = [edge for edge, off in zip(view.edges, chi2, strict=True) if off < AGREE_CHI2]
        found.append(pose_from_edges(agreeing, board, model, pose, covariance)[:2] if agreeing else starts[k])
        off = np.sum(line_residuals(view.edges, board, model, pose_array(found[-1][0]))[0] ** 2, axis=1)
        costs.append(squares(found[-1][0]) / variance + np.minimum(off, AGREE_CHI2).sum())
    return found[int(np.argmin(costs))]


def mirrored_pose(pose, pattern):
    """The pose that shows nearly the same picture from far away: every point mirrored in depth about the pattern."""
    middle = pattern.points().mean(axis=0)
    at = pose.apply(middle)
    sight = at / np.linalg.norm(at)
    mirror = np.eye(3) - 2 * np.outer(sight, sight)
    rotation = Rotation.from_matrix(mirror @ pose.rotation.as_matrix() @ np.diag([1.0, 1.0, -1.0]))
    return RigidTransform.from_components(at - rotation.apply(middle), rotation)


def pose_from_edges(edges, board, model, start, covariance=None):
    """Pose of a board from its image lines, its covariance, and chi-square.

    Three or more edges, unless the start pose is an observation of its own (the pattern's corners) with a covariance.
    """
    white = np.zeros((0, 6)) if covariance is None else np.linalg.inv(np.linalg.cholesky(covariance))
    start = pose = pose_array(start)

    def whole(pose):
        residual, jacobian = line_residuals(edges, board, model, pose)
        turned = Rotation.from_matrix(pose[:, :3] @ start[:, :3].T).as_rotvec()
        residual = np.r_[residual.ravel(), white @ np.r_[turned, pose[:, 3] - start[:, 3]]]
        return residual, np.concatenate([jacobian.reshape(-1, 6), white])

    for _ in range(POSE_ROUNDS):
        residual, jacobian = whole(pose)
        step = np.linalg.lstsq(jacobian, -residual, rcond=1e-12)[0]
        pose = move_pose(pose, step)
        if np.abs(step).max() < 1e-12:
            break
    residual, jacobian = whole(pose)
    return pose_transform(pose), np.linalg.pinv(jacobian.T @ jacobian, hermitian=True), float(residual @ residual)


def line_residuals(edges, board, model, pose):
    """Whitened distances (E, 2) of every edge's two corners from its image line, derivatives by [w, v] (E, 2, 6)."""
    line, centre, covariance = (np.stack([getattr(e, k) for e in edges]) for k in ("line", "centre", "covariance"))
    i = np.array([board.edges.index(e.name) for e in edges])
    flat = np.column_stack([board.known_corners(), np.zeros(len(board.edges))])
    ends = flat[np.stack([i, (i + 1) % len(flat)], axis=1)]
    turned = rotate_points(pose, ends)
    p_camera = turned + pose[:, 3]
    uv = pinhole(p_camera, model)
    lever = np.einsum("enk,ek->en", uv - centre[:, None], np.stack([line[:, 1], -line[:, 0]], axis=1))
    design = np.stack([np.ones_like(lever), lever], axis=2)
    white = np.linalg.inv(np.linalg.cholesky(design @ covariance @ np.swapaxes(design, 1, 2)))
    off = np.einsum("enk,ek->en", uv, line[:, :2]) + line[:, 2:]
    by_point = np.einsum("ek,enkj->enj", line[:, :2], pinhole_jacobian(p_camera, model))
    return (white @ off[..., None])[..., 0], white @ gradient_by_pose(turned, by_point)


def _view_plain(view, image, board, model, picks, guess):
    """The view of a dark board without pattern, whose outline (or picks of all its edges) tells the pose."""
    if set(picks) == set(board.edges):
        inner = undistort(np.mean([picks[n] for n in board.edges], axis=(0, 1)), model)
        picked = {name: _pick(name, picks[name], inner, model) for name in board.edges}
        # sides in the turning sense of the image; board_poses tries every start, picks know the names
        found = board_poses(list(picked.values())[::-1], board, model)
        found = [item for item in found if all(np.allclose(e.centre, picked[e.name].centre) for e in item[2])]
    else:
        corners = undistort(find_polygon(image, len(board.known_corners())), model)
        middle, sides = corners.mean(axis=0), zip(corners, np.roll(corners, -1, axis=0), strict=True)
        edges = [
            refine_edge(image, model, "", a + 0.04 * (b - a), b - 0.04 * (b - a), (a + b) / 2 - middle, SEARCH_PX)
            for a, b in sides
        ]
        ends = {name: undistort(uv, model) for name, uv in picks.items()}
        found = [
            item
            for item in board_poses(edges, board, model)
            if all(np.abs(line_distance(ends[e.name], e.line)).max() < SAME_NAMES_PX for e in item[2] if e.name in ends)
        ]
    if not found:
        return replace(view, reason=f"no pose of board '{board.name}' explains the outline in the image")
    if guess is not None:
        found.sort(key=lambda item: (item[0].rotation * guess.rotation.inv()).magnitude())
    (pose, covariance, edges), others = found[0], tuple(p for p, _, _ in found[1:])
    inner = np.mean([e.centre for e in edges], axis=0)
    edges = tuple(_pick(e.name, picks[e.name], inner, model) if e.name in picks else e for e in edges)
    return replace(view, T_camera_board=pose, covariance=covariance, edges=edges, alternatives=others)


def find_polygon(image, n_corners):
    """Corners (n, 2) of the largest dark region that is a convex polygon, to about a pixel (recorded pixels).

    The turning sense is that of x to y in the image (right to down). OutlineNotFound if no dark region looks like such
    a polygon, or if it is cut by the image border.
    """
    picture = cv2.GaussianBlur(grey(image), (0, 0), 1.0)
    level = cv2.threshold(picture, 0, 255, cv2.THRESH_BINARY + cv2.THRESH_OTSU)[0]
    best, best_area, cut = None, LEAST_AREA_SHARE * picture.size, False
    for threshold in np.array([0.4, 0.6, 0.8, 1.0, 1.2]) * level:
        dark = (picture < threshold).astype(np.uint8)
        for contour in cv2.findContours(dark, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)[0]:
            area = cv2.contourArea(contour)
            corners = _polygon(contour, area, n_corners) if area > best_area else None
            if corners is None:
                continue
            border = contour.reshape(-1, 2)
            if np.any(border <= 1) or np.any(border >= np.array(picture.shape[::-1]) - 2):
                cut = True
            else:
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
    corners = (
        cv2.minEnclosingTriangle(hull)[1] if n_corners == 3 else cv2.approxPolyN(hull, n_corners, None, -1.0, True)
    )
    corners = None if corners is None else corners.reshape(-1, 2)
    if corners is None or len(corners) != n_corners or area < LEAST_FILL * cv2.contourArea(corners.astype(np.float32)):
        return None
    corners = corners.astype(float)
    x, y = corners.T
    turn = np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y)
    return corners if turn > 0 else corners[::-1]


def board_poses(edges, board, model):
    """All poses of a board that explain the sides of a polygon (in the turning sense of :func:`find_polygon`).

    Returns a list of (``T_camera_board``, covariance, edges with their names), most frontal first. The printed side (z
    of the board) faces the camera. Three lines are six equations for six unknowns: nearly every picture of a triangle
    can be any of its three turned versions, and each of them in up to four poses. The list keeps them all; only other
    knowledge (a start value, the LRF, another camera) can choose. A polygon with more sides is over-determined and
    leaves one or two.
    """
    # seen from the printed side x to y turns left, in the image (v down) that is the other way round
    sides, found = list(edges)[::-1], []
    flat = np.column_stack([board.known_corners(), np.zeros(len(board.edges))])
    for shift in range(len(sides)):
        turned = sides[shift:] + sides[:shift]
        named = tuple(replace(edge, name=name) for edge, name in zip(turned, board.edges, strict=True))
        corners = np.ascontiguousarray(corners_of_lines([e.line for e in named]))
        if len(flat) == 3:
            out = cv2.solveP3P(flat, corners, model.matrix, None, cv2.SOLVEPNP_P3P)
        else:
            out = cv2.solvePnPGeneric(flat, corners, model.matrix, None, flags=cv2.SOLVEPNP_IPPE)
        for w, t in zip(out[1], out[2], strict=True):
            start = RigidTransform.from_components(t.ravel(), Rotation.from_rotvec(w.ravel()))
            if start.translation[2] <= 0 or frontal(start) <= 0:
                continue
            pose, covariance, chi2 = pose_from_edges(named, board, model, start)
            off = np.linalg.norm(pinhole(pose.apply(flat), model) - corners, axis=1).max()
            known = any((pose.rotation * p.rotation.inv()).magnitude() < 1e-3 for p, _, _ in found)
            if frontal(pose) > 0 and (off < EXACT_PX or chi2 < 16 * len(corners)) and not known:
                found.append((pose, covariance, named))
    return sorted(found, key=lambda item: -frontal(item[0]))


def frontal(pose):
    """Cosine between the board's z axis and the direction to the camera: 1 seen from the front, below 0 from behind."""
    return float(-pose.rotation.as_matrix()[:, 2] @ pose.translation / np.linalg.norm(pose.translation))
