"""The pose of a board from the corners of its pattern and the edges of its stated outline together.

The pattern fills a part of the board only. Its corners alone leave the tilt of a distant board uncertain, and sometimes
undecided between two poses that mirror each other in depth; the outline reaches farther.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from lrfcal_lib.camera import project
from lrfcal_lib.preprocess.adjustment import SIGMA_FLOOR_PX
from lrfcal_lib.preprocess.pattern import pose_adjustment, raised_points
from lrfcal_lib.preprocess.silhouette import line_residuals, pose_from_edges

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
    starts.append(
        pose_adjustment(pixels, board.pattern, model, relief, start=mirrored_pose(pose, board.pattern))[:2]
    )
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
