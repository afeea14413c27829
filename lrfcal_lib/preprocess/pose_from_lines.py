"""The pose of a board from image lines of its edges."""

import numpy as np
from scipy.spatial.transform import RigidTransform

from lrfcal_lib.fit.covariance import inverse_root
from lrfcal_lib.model.board import Board, side_ends
from lrfcal_lib.model.camera import CameraModel, line_distance, pinhole, pinhole_jacobian
from lrfcal_lib.model.geometry import (
    gradient_by_pose,
    move_pose,
    pose_array,
    pose_step,
    pose_transform,
    rotate_and_move,
)

ROUNDS = 15  # of Gauss-Newton
SETTLED = 1e-12  # a smaller step (radians, metres) is the last


def pose_from_edges(
    edges, board: Board, model: CameraModel, start: RigidTransform, covariance=None
) -> tuple[RigidTransform, np.ndarray, float]:
    """Pose of a board from image lines: three, unless the start is an observation.

    Parameters
    ----------
    edges : sequence of ImageEdge
    board : Board
    model : CameraModel
    start : RigidTransform
        ``T_camera_board``.
    covariance : ndarray, shape (6, 6), optional
        Of ``[w, v]`` of the start, where that is an observation.

    Returns
    -------
    pose : RigidTransform
    covariance : ndarray, shape (6, 6)
    chi2 : float

    Raises
    ------
    numpy.linalg.LinAlgError
        If the lines lead to a pose behind the camera.
    """
    white = np.zeros((0, 6))
    if covariance is not None:
        white = inverse_root(covariance)

    def system(pose):
        misses, by_pose = line_residuals(edges, board, model, pose)
        moved = pose_step(start, pose_transform(pose))
        residuals = np.r_[misses.ravel(), white @ moved]
        return residuals, np.concatenate([by_pose.reshape(-1, 6), white])

    # plain Gauss-Newton: the weights of the lines move along with the pose, so that no sum of
    # squares falls steadily, which the minimiser asks for
    pose = pose_array(start)
    residuals, jacobian = system(pose)
    for _ in range(ROUNDS):
        step = np.linalg.lstsq(jacobian, -residuals, rcond=1e-12)[0]
        pose = move_pose(pose, step)
        residuals, jacobian = system(pose)
        if np.abs(step).max() < SETTLED:
            break
    reached = np.linalg.pinv(jacobian.T @ jacobian, hermitian=True)
    return pose_transform(pose), reached, residuals @ residuals


def line_residuals(edges, board: Board, model: CameraModel, pose):
    """Those of :func:`line_misses` for every edge's two corners."""
    sides = [board.edges.index(edge.name) for edge in edges]
    return line_misses(edges, side_ends(board.points())[sides], model, pose)


def line_misses(edges, points, model: CameraModel, pose):
    """Whitened distances of board points from image lines, and their derivatives.

    Parameters
    ----------
    edges : sequence of ImageEdge
        E of them.
    points : ndarray, shape (E, n, 3)
        Board frame, metres.
    model : CameraModel
    pose : ndarray, shape (3, 4)
        ``T_camera_board``.

    Returns
    -------
    misses : ndarray, shape (E, n)
    by_pose : ndarray, shape (E, n, 6)
        By ``[w, v]``.
    """
    lines = np.stack([edge.line for edge in edges])
    turned, p_camera = rotate_and_move(pose, points)
    uv = pinhole(p_camera, model)
    distance = line_distance(uv, lines[:, None])
    by_point = np.vecmat(lines[:, None, :2], pinhole_jacobian(p_camera, model))
    by_pose = gradient_by_pose(turned, by_point)
    centres = np.stack([edge.centre for edge in edges])
    covariance = np.stack([edge.covariance for edge in edges])
    along = lines[:, [1, 0]] * [1, -1]
    lever = np.matvec(uv - centres[:, None], along)
    design = np.stack([np.ones_like(lever), lever], axis=2)  # by offset and angle of a line
    white = inverse_root(design @ covariance @ design.mT)
    return np.matvec(white, distance), white @ by_pose
