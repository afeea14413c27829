"""A plain dark board without a printed pattern: its outline in the image and the poses that explain it."""

from __future__ import annotations

import cv2
import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from lrfcal_lib.board import corners_of_lines
from lrfcal_lib.camera import pinhole, pinhole_jacobian, undistort
from lrfcal_lib.geometry import hat
from lrfcal_lib.preprocess.edges import ImageEdge, refine_edge
from lrfcal_lib.preprocess.pattern import grey

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
