"""Residuals of one camera: projected points from image lines, equations (16), (19) and (20), points
from planes.
"""

from dataclasses import replace

import cv2
import numpy as np
from scipy.spatial.transform import RigidTransform

from lrfcal_lib.fit.least_squares import Block
from lrfcal_lib.fit.result import Solution
from lrfcal_lib.model.camera import (
    CameraModel,
    line_distance,
    line_through,
    mirrored,
    project,
    undistort,
)
from lrfcal_lib.model.geometry import (
    cross,
    gradient_by_pose,
    pose_array,
    pose_parameters,
    pose_transform,
    rotate_and_move,
    unit_vector,
)
from lrfcal_lib.model.observations import CameraObservations

# metres; no printed board is flatter, and a board along the beam has no range noise across it
SIGMA_FLOOR = 1e-4
FEWEST_CORNERS = 6  # of a pattern, for its pose


def line_block(pose: np.ndarray, obs: CameraObservations) -> Block:
    """Distances d(e, ab) of projected crossings from their image lines, equations (19) and (20).

    Undistorted pixels with the sign of the line; behind the camera, too, see
    :func:`lrfcal_lib.model.camera.mirrored`. The whitener holds the crossing's covariance,
    projected, and the line's; `corrected` is the Jacobian without what errors of the crossings put
    into it (:func:`noise_correction`).

    Parameters
    ----------
    pose : ndarray, shape (..., 3, 4)
        ``T_camera_source``.
    obs : CameraObservations
    """
    lines = obs.crossing_lines
    rotated, moved = rotate_and_move(pose, obs.crossing_points)  # (16)
    residuals = line_distance(mirrored(moved, obs.model), lines)
    # of l K q / z by the point q, pixels a metre
    gradients = lines @ obs.model.matrix / moved[..., 2:]
    gradients[..., 2] -= residuals / moved[..., 2]
    jacobian = gradient_by_pose(rotated, gradients)
    noise = moved_noise(pose, gradients, obs.crossing_covariance)
    variance = np.vecdot(gradients, noise) + obs.crossing_line_sigma**2
    shift = noise * (residuals / variance)[..., None]
    correction = noise_correction(rotated, moved, gradients, shift)
    return Block(
        residuals, jacobian, 1 / np.sqrt(variance), corrected=jacobian - correction
    )


def sight_block(pose: np.ndarray, points: np.ndarray, normals: np.ndarray) -> Block:
    """Distances of points from planes through the camera centre, metres.

    Parameters
    ----------
    pose : ndarray, shape (..., 3, 4)
        ``T_camera_source``.
    points : ndarray, shape (..., n, 3)
        Source frame, metres.
    normals : ndarray, shape (..., n, 3)
        Of the planes, see :func:`sight_normals`; over the standard deviation of distances for
        distances in that.
    """
    rotated, moved = rotate_and_move(pose, points)
    residuals = np.vecdot(normals, moved)
    jacobian = gradient_by_pose(rotated, np.broadcast_to(normals, rotated.shape))
    return Block(residuals, jacobian)


def sight_normals(lines: np.ndarray, model: CameraModel) -> np.ndarray:
    """Normals of the planes through the camera centre and image lines.

    Parameters
    ----------
    lines : ndarray, shape (..., 3)
        Undistorted pixels.
    model : CameraModel

    Returns
    -------
    ndarray, shape (..., 3)
        Unit vectors, camera frame.
    """
    return unit_vector(lines @ model.matrix)


def edge_residuals_px(obs: CameraObservations, transform: RigidTransform) -> np.ndarray:
    """Signed distances of the projected crossings from their image lines, equation (20).

    Parameters
    ----------
    obs : CameraObservations
    transform : RigidTransform
        ``T_camera_source``.

    Returns
    -------
    ndarray, shape (n,)
        Undistorted pixels; positive outside the board.
    """
    return line_block(pose_array(transform), obs).residuals


def plane_residuals_m(obs: CameraObservations, transform: RigidTransform) -> np.ndarray:
    """Signed distances of the board-face points from the planes the camera sees.

    Parameters
    ----------
    obs : CameraObservations
    transform : RigidTransform
        ``T_camera_source``.

    Returns
    -------
    ndarray, shape (m,)
        Metres, along the board's z; NaN for placements whose board pose the camera does not know.
    """
    out = np.full(len(obs.plane_points), np.nan)
    row, known = np.nonzero(obs.placements[:, None] == obs.plane_placement)
    boards = obs.board_poses[row]
    away = transform.apply(obs.plane_points[known]) - boards[:, :3, 3]
    out[known] = np.vecdot(boards[:, :3, 2], away)
    return out


def under_intrinsics(obs: CameraObservations, solution: Solution) -> CameraObservations:
    """The observations as they are under the intrinsics of a solution, where it has refined them.

    Two points of each image line beside its crossing are distorted with the old model and
    undistorted with the new one; poses of boards whose pattern was seen are those that fit it.
    """
    model = solution.model
    if model is None:
        return obs
    lines = obs.crossing_lines
    uv = mirrored(solution.transform.apply(obs.crossing_points), obs.model)
    foot = uv - line_distance(uv, lines)[:, None] * lines[:, :2]
    along = lines[:, [1, 0]] * [10.0, -10.0]
    sights = obs.model.sights(np.stack([foot + along, foot - along]))
    moved = line_through(*undistort(project(sights, obs.model), model))
    boards = obs.board_poses.copy()
    for pose, pixels in zip(boards, obs.pattern_pixels, strict=True):
        good = np.isfinite(pixels).all(axis=1)
        if good.sum() >= FEWEST_CORNERS:
            _, rotvec, shift = cv2.solvePnP(
                obs.pattern_points[good],
                pixels[good],
                model.matrix,
                model.distortion,
                cv2.Rodrigues(pose[:3, :3])[0],
                pose[:3, 3:].copy(),
                useExtrinsicGuess=True,
            )
            pose[:3] = np.hstack([cv2.Rodrigues(rotvec)[0], shift])
    return replace(obs, model=model, crossing_lines=moved, board_poses=boards)


def read_pose(pose: np.ndarray) -> tuple[RigidTransform, np.ndarray]:
    """Transform and parameters of a pose state.

    Parameters
    ----------
    pose : ndarray, shape (..., 3, 4)

    Returns
    -------
    transform : RigidTransform
    parameters : ndarray, shape (..., 6)
        Rotation vector and translation, radians and metres.
    """
    return pose_transform(pose, proper=True), pose_parameters(pose)


def noise_correction(
    rotated: np.ndarray,
    point: np.ndarray,
    gradient: np.ndarray,
    shift: np.ndarray,
) -> np.ndarray:
    """What errors in the points take from Jacobian rows by the pose: the weighted residual times
    half the change of the variance.

    Parameters
    ----------
    rotated, point : ndarray, shape (..., n, 3)
        ``R p`` and ``R p + t``, metres.
    gradient : ndarray, shape (..., n, 3)
        Of a scalar ``l . pinhole(q)`` by the moved point q.
    shift : ndarray, shape (..., n, 3)
        The direction in which the noise pulls the point, see :func:`moved_noise`, times the
        weighted residual.

    Returns
    -------
    ndarray, shape (..., n, 6)
    """
    # the gradient itself changes with the depth
    depth = point[..., 2:]
    by_shift = -gradient * shift[..., 2:] / depth
    by_shift[..., 2] -= np.vecdot(gradient, shift) / depth[..., 0]
    by_turn = cross(shift, gradient) + cross(rotated, by_shift)
    return np.concatenate([by_turn, by_shift], axis=-1)


def moved_noise(
    pose: np.ndarray, gradient: np.ndarray, covariance: np.ndarray
) -> np.ndarray:
    """``R C R^T a``: where the noise of points pulls scalars of the moved points.

    Parameters
    ----------
    pose : ndarray, shape (..., 3, 4)
    gradient : ndarray, shape (..., n, 3)
        ``a``, by the moved points.
    covariance : ndarray, shape (..., n, 3, 3)
        Of the points in the source frame, square metres.

    Returns
    -------
    ndarray, shape (..., n, 3)
    """
    rotation = pose[..., :3]
    return np.vecmat(gradient @ rotation, covariance) @ rotation.mT
