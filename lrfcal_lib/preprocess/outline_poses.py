"""A dark board without pattern in an image: its outline, and all poses that explain it."""

from dataclasses import replace

import cv2
import numpy as np
from scipy.spatial.transform import RigidTransform

from lrfcal_lib.model.board import Board, corners_of_lines
from lrfcal_lib.model.camera import CameraModel, pinhole
from lrfcal_lib.model.geometry import (
    length_of,
    unit_vector,
)
from lrfcal_lib.preprocess.edges_in_image import EdgeNotSeen
from lrfcal_lib.preprocess.intrinsics import opencv_poses
from lrfcal_lib.preprocess.pattern_in_image import grey
from lrfcal_lib.preprocess.pose_from_lines import pose_from_edges

LEAST_AREA_SHARE = 0.002  # of the image
LEAST_FILL = 0.9  # of the polygon by the dark region, and the other way round
DARKNESS = np.array([0.4, 0.6, 0.8, 1.0, 1.2])  # thresholds, in units of Otsu's
BLUR_PX = 1.0
# a pose explains the outline when its corners fall this near, or within 4 sigma
EXACT_PX = 0.5
EXACT_CHI2 = 16  # a corner
SAME_POSE = 1e-3  # radians


def find_polygon(image: np.ndarray, n_corners: int, model: CameraModel) -> np.ndarray:
    """Corners of the largest dark convex polygon, to about a pixel.

    Parameters
    ----------
    image : ndarray of uint8, shape (h, w) or (h, w, 3)
    n_corners : int
    model : CameraModel
        Says how large the image is.

    Returns
    -------
    ndarray, shape (n_corners, 2)
        Recorded pixels, in the turning sense right to down.

    Raises
    ------
    EdgeNotSeen
        If no dark region looks like such a polygon, or if it is cut by the image border.
    """
    picture = cv2.GaussianBlur(grey(image), (0, 0), BLUR_PX)
    level = cv2.threshold(picture, 0, 255, cv2.THRESH_BINARY + cv2.THRESH_OTSU)[0]
    contours = []
    for threshold in DARKNESS * level:
        dark = (picture < threshold).astype(np.uint8)
        contours += cv2.findContours(dark, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)[0]
    why = (
        f"no dark region with {n_corners} straight edges in the image: the board must stand out "
        "from the rest"
    )
    for contour in sorted(contours, key=cv2.contourArea, reverse=True):
        if cv2.contourArea(contour) <= LEAST_AREA_SHARE * picture.size:
            break
        corners = _polygon(contour, n_corners)
        if corners is None:
            continue
        if model.shows(contour, 1).all():
            return corners
        why = "the dark board is cut by the image border"
    raise EdgeNotSeen(why)


def outline_poses(edges, board: Board, model: CameraModel, view) -> list:
    """All poses of a board that explain the sides of a polygon, most frontal first.

    The printed side (z of the board) faces the camera. Three lines are six equations for six
    unknowns: nearly every picture of a triangle can be any of its three turned versions, and each
    of them in up to four poses. The list keeps them all; only other knowledge (a start value, the
    LRF, another camera) can choose. A polygon with more sides is over-determined and leaves one or
    two.

    Parameters
    ----------
    edges : sequence of ImageEdge
        In the turning sense of :func:`find_polygon`.
    board : Board
    model : CameraModel
    view : BoardView
        Says whose image it is.

    Returns
    -------
    list of BoardView
        With a pose, its covariance and named edges.
    """
    # seen from the printed side x to y turns left, in the image (v down) that is the other way
    # round
    sides = edges[::-1]
    flat = board.points()
    views: list = []
    for shift in range(len(sides)):
        turned = sides[shift:] + sides[:shift]
        named = tuple(
            replace(edge, name=name) for edge, name in zip(turned, board.edges, strict=True)
        )
        corners = corners_of_lines([edge.line for edge in named])
        # three corners have up to four poses
        _, *solved = cv2.solveP3P(
            flat[:3], corners[:3], model.matrix, None, cv2.SOLVEPNP_P3P
        )
        for start in opencv_poses(*solved):
            if frontal(start) <= 0:
                continue
            try:
                pose, covariance, chi2 = pose_from_edges(named, board, model, start)
            except np.linalg.LinAlgError:  # sides that bear wrong names
                continue
            off = length_of(pinhole(pose.apply(flat), model) - corners).max()
            exact = off < EXACT_PX or chi2 < EXACT_CHI2 * len(corners)
            known = any(
                pose.rotation.approx_equal(other.T_camera_board.rotation, SAME_POSE)
                for other in views
            )
            if exact and not known:
                explained = replace(
                    view, T_camera_board=pose, covariance=covariance, edges=named
                )
                views.append(explained)
    return sorted(views, key=lambda each: -frontal(each.T_camera_board))


def frontal(pose: RigidTransform) -> float:
    """Cosine between the board's z axis and the direction to the camera.

    1 seen from the front, below 0 from behind.
    """
    normal = pose.rotation.as_matrix()[:, 2]
    return -normal @ unit_vector(pose.translation)


def _polygon(contour, n_corners):
    """The polygon around a contour; None where the region does not fill it or has other corners."""
    most = cv2.contourArea(contour) / LEAST_FILL
    hull = cv2.convexHull(contour)
    if cv2.contourArea(hull) > most or len(hull) < n_corners:
        return None
    if n_corners == 3:
        corners = cv2.minEnclosingTriangle(hull)[1]
    else:
        corners = cv2.approxPolyN(hull, n_corners, None, -1.0, True)
    area = cv2.contourArea(corners, True)  # above 0 clockwise
    if abs(area) > most:
        return None
    corners = corners.reshape(-1, 2)
    return corners if area > 0 else corners[::-1]
