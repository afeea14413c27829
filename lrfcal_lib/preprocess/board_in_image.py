"""The board in one image: its pose and its straight outer edges, with a pattern or plain."""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from lrfcal_lib.model.board import corners_of_lines
from lrfcal_lib.model.camera import line_distance, pinhole, pinhole_jacobian, project, undistort
from lrfcal_lib.model.geometry import (
    gradient_by_pose,
    move_pose,
    pose_array,
    pose_transform,
    rotate_points,
)
from lrfcal_lib.preprocess import edges_in_image
from lrfcal_lib.preprocess.edges_in_image import (
    EdgeNotSeen,
    ImageEdge,
    board_line,
    on_board,
    picked_edge,
    refine_edge,
)
from lrfcal_lib.preprocess.intrinsics import SIGMA_FLOOR_PX, board_pose, raised_points
from lrfcal_lib.preprocess.pattern_in_image import grey

LEAST_AREA_SHARE = 0.002  # of the image
LEAST_FILL = 0.9  # of the polygon by the dark region, and the other way round
SEARCH_PX = 4.0
EXACT_PX = 0.5  # a pose explains the outline when its corners fall this near (or within 4 sigma)
SAME_NAMES_PX = 10.0  # from picks to the edges of their names
# an edge disagrees with a pose beyond this: 1 in 10000 true ones (two degrees of freedom)
AGREE_CHI2 = 18.4
# half width of the narrow search, metres: edges sit within 1-3 mm (sd) in the sheet's frame
WINDOW = 0.010
PREDICTION_SIGMA = 0.005  # of an edge on the board, metres
POSE_ROUNDS = 15  # of Gauss-Newton
CORNER_INSET = 0.03  # share of an edge left out at both ends: corners curl and are torn
# samples along and across each edge when orders of corners are compared
COARSE_PROFILES = 24
COARSE_ACROSS = 25
THIN_PROFILES = 150  # of an edge where orders are compared by the narrow search
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

    def edge(self, name):
        """The edge of that name, None if it was not seen."""
        return next((e for e in self.edges if e.name == name), None)


def view_board(image, board, model, view=None, picks=None, *, lines=None, relief=None):
    """Find the board, its pose and its straight edges in one image.

    Parameters
    ----------
    image : ndarray of uint8, shape (h, w) or (h, w, 3)
    board : Board
        With a pattern, or with known corners.
    model : CameraModel
    view : BoardView, optional
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
    view = view or BoardView()
    picks = picks or {}
    if image.shape[:2] != (model.height, model.width):
        size = f"the image is {image.shape[1]} x {image.shape[0]}"
        return replace(
            view, reason=f"{size}, the intrinsics are for {model.width} x {model.height} pixels"
        )
    if board.pattern is None:
        try:
            found = _views_plain(view, image, board, model, picks)
        except EdgeNotSeen as error:
            return replace(view, reason=str(error))
        if not found:
            return replace(
                view, reason=f"no pose of board '{board.name}' explains the outline in the image"
            )
        return replace(found[0], alternatives=tuple(found[1:]))
    view = _view_pattern(view, image, board, model, picks, lines, relief)
    if board.corners is None:
        return view
    pose, covariance = pose_with_edges(view, board, model, relief)
    return replace(view, T_camera_board=pose, covariance=covariance)


def _view_pattern(view, image, board, model, picks, lines, relief, most=np.inf):
    """The view with the pose from the pattern's corners and the edges near it, each by `most`
    profiles or fewer.
    """
    pose, covariance, used = board_pose(view.pixels, board.pattern, model, relief)
    pixels = np.where(used[:, None], view.pixels, np.nan)
    view = replace(view, pixels=pixels, T_camera_board=pose, covariance=covariance)
    if lines is None:
        return replace(
            view,
            rejected=tuple((name, "the outline of the board is not known") for name in board.edges),
        )
    inner = undistort(np.nanmean(pixels, axis=0), model)
    corners = corners_of_lines(lines)
    edges = []
    rejected = []
    for name, line, start, end in zip(
        board.edges, lines, corners, np.roll(corners, -1, axis=0), strict=True
    ):
        if name in picks:
            edges.append(picked_edge(name, undistort(picks[name], model), inner))
            continue
        inset = CORNER_INSET * (end - start)
        middle = (start + end) / 2
        uv = on_board(
            np.stack([start + inset, end - inset, middle, middle + WINDOW * line[:2]]), pose, model
        )
        scale = np.linalg.norm(uv[3] - uv[2]) / WINDOW
        reach = np.clip(scale * WINDOW, 3.0, 40.0), max(scale * PREDICTION_SIGMA, 1.0)
        try:
            edges.append(refine_edge(image, model, name, uv[0], uv[1], uv[2] - inner, *reach, most))
        except EdgeNotSeen as error:
            rejected.append((name, str(error)))
    return replace(view, edges=tuple(edges), rejected=tuple(rejected))


def order_scores(image, board, model, orders, poses):
    """How well the known outline of the board fits one image, for every order of the pattern's
    corners.

    `orders` are the corners (n, k, 2) in each order, `poses` a stack of n rough ``T_camera_board``.
    The scores are those of a few coarse profiles across the outline; orders that they cannot tell
    apart are compared by the edges that the narrow search finds with a few more.
    """
    lines = board.lines()
    start = corners_of_lines(lines)
    end = np.roll(start, -1, axis=0)
    score = np.zeros(len(orders))
    across = (np.linspace(-2, 2, COARSE_ACROSS) * PREDICTION_SIGMA)[:, None, None, None]
    along = np.linspace(CORNER_INSET, 1 - CORNER_INSET, COARSE_PROFILES)[:, None]
    xy = start[:, None] + along * (end - start)[:, None] + across * lines[:, None, :2]
    uv = np.stack(
        [on_board(xy.reshape(COARSE_ACROSS, -1, 2), pose, model) for pose in poses], axis=1
    )
    strip = edges_in_image.sample(image, model, uv.reshape(COARSE_ACROSS, -1, 2))
    height = edges_in_image.step_contrast(strip, 1.5, along=1)
    expected = np.exp(-0.5 * (across[..., 0, 0] / PREDICTION_SIGMA) ** 2)
    weight = height / (height + edges_in_image.FULL_CONTRAST) * expected
    coarse = np.median(weight.max(axis=0).reshape(len(orders), len(lines), -1), axis=2).sum(axis=1)
    likely = np.flatnonzero(coarse >= CLEAR_SHARE * coarse.max())
    if len(likely) == 1:
        return coarse
    for i in likely:
        # profiles that found an edge count less the farther it lies from where the outline puts it
        view = _view_pattern(
            BoardView(pixels=orders[i]), image, board, model, {}, lines, None, THIN_PROFILES
        )
        for edge in view.edges:
            k = board.edges.index(edge.name)
            seen = board_line(view, edge, model)
            off = np.mean((np.stack([start[k], end[k]]) @ seen[:2] + seen[2]) ** 2)
            score[i] += edge.n_points / (1 + off / PREDICTION_SIGMA**2)
    return coarse.max() * score / max(score.max(), 1e-9)


def pose_with_edges(view, board, model, relief=None):
    """Pose of a board and its covariance from the corners of its pattern and its edges, weighted by
    their covariances.

    `view` has the pose from the corners alone. Least squares of ``|d|^2_P + sum_e |r_e|^2_S``: `d`
    is the increment from that pose (covariance P), `r_e` the distances of the edge's two board
    corners from its image line; their covariance holds the systematic part of 0.1 px, so a sharp
    edge does not outweigh all corners. Edges that the corners contradict stay out. The same starts
    from the pose mirrored in depth, and the pose that explains everything better is taken.
    """
    first = view.T_camera_board, view.covariance
    if not view.edges:
        return first
    mirrored = mirrored_pose(view.T_camera_board, board.pattern)
    starts = [first, board_pose(view.pixels, board.pattern, model, relief, start=mirrored)[:2]]
    seen = np.isfinite(view.pixels).all(axis=1)
    points = raised_points(board.pattern, relief)

    def squares(pose):
        off = (view.pixels - project(pose.apply(points), model))[seen]
        return float(np.nan_to_num(np.sum(off**2), nan=np.inf))

    fits = np.array([squares(pose) for pose, _ in starts])
    variance = max(fits.min() / (2 * seen.sum()), SIGMA_FLOOR_PX**2)
    found = []
    costs = []
    # no agreement of the edges makes up for corners that fit worse than this
    for k in np.flatnonzero((fits - fits.min()) / variance <= AGREE_CHI2 * len(view.edges)):
        pose, covariance = starts[k]
        residual, jacobian = line_residuals(view.edges, board, model, pose_array(pose))
        expected = np.eye(2) + jacobian @ covariance @ np.swapaxes(jacobian, 1, 2)
        chi2 = np.sum(residual * np.linalg.solve(expected, residual[..., None])[..., 0], axis=1)
        agreeing = [edge for edge, off in zip(view.edges, chi2, strict=True) if off < AGREE_CHI2]
        found.append(
            pose_from_edges(agreeing, board, model, pose, covariance)[:2] if agreeing else starts[k]
        )
        off = np.sum(
            line_residuals(view.edges, board, model, pose_array(found[-1][0]))[0] ** 2, axis=1
        )
        costs.append(squares(found[-1][0]) / variance + np.minimum(off, AGREE_CHI2).sum())
    return found[int(np.argmin(costs))]


def mirrored_pose(pose, pattern):
    """The pose that shows nearly the same picture from far away: every point mirrored in depth
    about the pattern.
    """
    middle = pattern.points().mean(axis=0)
    at = pose.apply(middle)
    sight = at / np.linalg.norm(at)
    mirror = np.eye(3) - 2 * np.outer(sight, sight)
    rotation = Rotation.from_matrix(mirror @ pose.rotation.as_matrix() @ np.diag([1.0, 1.0, -1.0]))
    return RigidTransform.from_components(at - rotation.apply(middle), rotation)


def pose_from_edges(edges, board, model, start, covariance=None):
    """Pose from image lines (three, unless the start is an observation with a covariance),
    covariance, chi-square.
    """
    white = (
        np.zeros((0, 6)) if covariance is None else np.linalg.inv(np.linalg.cholesky(covariance))
    )
    start = pose = pose_array(start)
    step = np.ones(6)
    rounds = POSE_ROUNDS
    # plain Gauss-Newton: the weights of the lines move along with the pose, so that no sum of
    # squares falls steadily
    while True:
        residual, jacobian = line_residuals(edges, board, model, pose)
        turn = Rotation.from_matrix(pose[:, :3] @ start[:, :3].T)
        moved = np.r_[turn.as_rotvec(), pose[:, 3] - start[:, 3]]
        residual = np.r_[residual.ravel(), white @ moved]
        jacobian = np.concatenate([jacobian.reshape(-1, 6), white])
        if rounds == 0 or np.abs(step).max() < 1e-12:
            break
        if not np.isfinite(jacobian).all():
            raise np.linalg.LinAlgError("no pose explains these lines")
        step = np.linalg.lstsq(jacobian, -residual, rcond=1e-12)[0]
        rounds = rounds - 1
        pose = move_pose(pose, step)
    return (
        pose_transform(pose),
        np.linalg.pinv(jacobian.T @ jacobian, hermitian=True),
        float(residual @ residual),
    )


def line_residuals(edges, board, model, pose):
    """Those of :func:`line_misses` for every edge's two corners."""
    i = np.array([board.edges.index(e.name) for e in edges])
    flat = board.points()
    return line_misses(edges, flat[np.stack([i, (i + 1) % len(flat)], axis=1)], model, pose)


def line_misses(edges, points, model, pose):
    """Whitened distances (E, n) of board points (E, n, 3) from image lines, derivatives by [w,
    v] (E, n, 6).
    """
    line, centre, covariance = (
        np.stack([getattr(e, k) for e in edges]) for k in ("line", "centre", "covariance")
    )
    turned = rotate_points(pose, points)
    p_camera = turned + pose[:, 3]
    uv = pinhole(p_camera, model)
    lever = np.einsum(
        "enk,ek->en", uv - centre[:, None], np.stack([line[:, 1], -line[:, 0]], axis=1)
    )
    design = np.stack([np.ones_like(lever), lever], axis=2)
    white = np.linalg.inv(np.linalg.cholesky(design @ covariance @ np.swapaxes(design, 1, 2)))
    off = np.einsum("enk,ek->en", uv, line[:, :2]) + line[:, 2:]
    by_point = np.einsum("ek,enkj->enj", line[:, :2], pinhole_jacobian(p_camera, model))
    return (white @ off[..., None])[..., 0], white @ gradient_by_pose(turned, by_point)


def _views_plain(view, image, board, model, picks):
    """Views of a dark board without pattern, one for each pose that its outline (or picks of
    all its edges) allows.
    """
    ends = {name: undistort(uv, model) for name, uv in picks.items()}
    if set(picks) == set(board.edges):
        inner = undistort(np.mean([picks[n] for n in board.edges], axis=(0, 1)), model)
        # sides in the turning sense of the image
        sides = [picked_edge(name, ends[name], inner) for name in board.edges][::-1]
    else:
        corners = undistort(find_polygon(image, len(board.known_corners())), model)
        middle = corners.mean(axis=0)
        sides = [
            refine_edge(
                image,
                model,
                "",
                a + 0.04 * (b - a),
                b - 0.04 * (b - a),
                (a + b) / 2 - middle,
                SEARCH_PX,
            )
            for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True)
        ]
    found = []
    for pose, covariance, edges in board_poses(sides, board, model):
        if all(
            np.abs(line_distance(ends[e.name], e.line)).max() < SAME_NAMES_PX
            for e in edges
            if e.name in ends
        ):
            inner = np.mean([e.centre for e in edges], axis=0)
            edges = tuple(
                picked_edge(e.name, ends[e.name], inner) if e.name in ends else e for e in edges
            )
            found.append(replace(view, T_camera_board=pose, covariance=covariance, edges=edges))
    return found


def find_polygon(image, n_corners):
    """Corners (n, 2) of the largest dark convex polygon, to about a recorded pixel, in the turning
    sense right to down.

    EdgeNotSeen if no dark region looks like such a polygon, or if it is cut by the image border.
    """
    picture = cv2.GaussianBlur(grey(image), (0, 0), 1.0)
    level = cv2.threshold(picture, 0, 255, cv2.THRESH_BINARY + cv2.THRESH_OTSU)[0]
    best = None
    best_area = LEAST_AREA_SHARE * picture.size
    cut = False
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
                best = corners
                best_area = area
    if best is None and cut:
        raise EdgeNotSeen("the dark board is cut by the image border")
    if best is None:
        why = "the board must stand out from the rest"
        raise EdgeNotSeen(f"no dark region with {n_corners} straight edges in the image: {why}")
    return best


def _polygon(contour, area, n_corners):
    """The polygon around a contour, None when the region is not filled by it or has other
    corners.
    """
    hull = cv2.convexHull(contour)
    if area < LEAST_FILL * cv2.contourArea(hull) or len(hull) < n_corners:
        return None
    triangle = n_corners == 3
    corners = (
        cv2.minEnclosingTriangle(hull)[1]
        if triangle
        else cv2.approxPolyN(hull, n_corners, None, -1.0, True)
    )
    if (
        corners is None
        or corners.size != 2 * n_corners
        or area < LEAST_FILL * cv2.contourArea(corners)
    ):
        return None
    corners = corners.reshape(-1, 2).astype(float)
    return corners if cv2.contourArea(corners.astype(np.float32), True) > 0 else corners[::-1]


def board_poses(edges, board, model):
    """All poses of a board that explain the sides of a polygon (in the turning sense of
    :func:`find_polygon`).

    Returns a list of (``T_camera_board``, covariance, edges with their names), most frontal first.
    The printed side (z of the board) faces the camera. Three lines are six equations for six
    unknowns: nearly every picture of a triangle can be any of its three turned versions, and each
    of them in up to four poses. The list keeps them all; only other knowledge (a start value, the
    LRF, another camera) can choose. A polygon with more sides is over-determined and leaves one or
    two.
    """
    # seen from the printed side x to y turns left, in the image (v down) that is the other way
    # round
    sides = list(edges)[::-1]
    found = []
    flat = board.points()
    for shift in range(len(sides)):
        turned = sides[shift:] + sides[:shift]
        named = tuple(
            replace(edge, name=name) for edge, name in zip(turned, board.edges, strict=True)
        )
        corners = np.ascontiguousarray(corners_of_lines([e.line for e in named]))
        if len(flat) == 3:
            out = cv2.solveP3P(flat, corners, model.matrix, None, cv2.SOLVEPNP_P3P)
        else:
            out = cv2.solvePnPGeneric(flat, corners, model.matrix, None, flags=cv2.SOLVEPNP_IPPE)
        for w, t in zip(out[1], out[2], strict=True):
            start = RigidTransform.from_components(t.ravel(), Rotation.from_rotvec(w.ravel()))
            if start.translation[2] <= 0 or frontal(start) <= 0:
                continue
            try:
                pose, covariance, chi2 = pose_from_edges(named, board, model, start)
            except np.linalg.LinAlgError:  # sides that bear wrong names
                continue
            off = np.linalg.norm(pinhole(pose.apply(flat), model) - corners, axis=1).max()
            known = any((pose.rotation * p.rotation.inv()).magnitude() < 1e-3 for p, _, _ in found)
            if frontal(pose) > 0 and (off < EXACT_PX or chi2 < 16 * len(corners)) and not known:
                found.append((pose, covariance, named))
    return sorted(found, key=lambda item: -frontal(item[0]))


def frontal(pose):
    """Cosine between the board's z axis and the direction to the camera: 1 seen from the front,
    below 0 from behind.
    """
    return float(
        -pose.rotation.as_matrix()[:, 2] @ pose.translation / np.linalg.norm(pose.translation)
    )
