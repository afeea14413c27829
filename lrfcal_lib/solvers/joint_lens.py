"""What errors of the intrinsics do to the joint estimate, which takes them as known.

A principal point that is a pixel off turns the camera, a focal length that is too long moves every board away: all
images of a camera err alike, so neither noise nor the scatter over placements shows it.
"""

from __future__ import annotations

import numpy as np

from lrfcal_lib.camera import project_jacobians
from lrfcal_lib.solvers.joint_blocks import pad, view_block
from lrfcal_lib.solvers.least_squares import whiten

LENS = 9  # intrinsics of a camera, see CameraModel.parameters
LEAST_CORNERS = 6


def pose_by_intrinsics(T_camera_board, corners, model):
    """How the pose of a board that fits given pixels changes with the intrinsics.

    Parameters
    ----------
    T_camera_board : RigidTransform
    corners : ndarray, shape (k, 3)
        Of the pattern, board frame, metres.
    model : CameraModel

    Returns
    -------
    ndarray, shape (6, 9)
        Derivative of the increments ``[w, v]`` by the intrinsics; zeros with fewer than six corners.
    """
    if len(corners) < LEAST_CORNERS:
        return np.zeros((6, LENS))
    turned = T_camera_board.rotation.apply(corners)
    by_point, by_lens = project_jacobians(turned + T_camera_board.translation, model)
    by_pose = np.concatenate([np.cross(turned[:, None, :], by_point), by_point], axis=-1)
    return -np.linalg.lstsq(by_pose.reshape(-1, 6), by_lens.reshape(-1, LENS), rcond=None)[0]


def lens_covariance(obs, found, data, unknowns):
    """Covariance of the shared unknowns from the covariances of the intrinsics.

    Parameters
    ----------
    obs : JointObservations
        With `view_lens` and `lens_covariance`.
    found : Solution
        Of the joint estimate, with ``jacobian`` and ``covariance`` of all blocks.
    data : JointData
    unknowns : Unknowns

    Returns
    -------
    ndarray, shape (c, c)
        Zeros where the intrinsics are taken to be exact.
    """
    c = unknowns.shared
    total = np.zeros((c, c))
    if len(obs.view_camera) == 0 or not np.any(obs.lens_covariance):
        return total
    J = whiten(view_block(found.state, data, unknowns))[1]
    lens = pad({"lens": obs.view_lens, "placement": obs.view_placement}, len(obs.placements))["lens"]
    whitener = view_block(found.state, data, unknowns).whitener
    weighted = np.sqrt(found.weights[..., None]) * found.jacobian
    hessian = np.swapaxes(weighted, -1, -2) @ weighted
    inverse = np.linalg.pinv(hessian[:, c:, c:], rcond=1e-13, hermitian=True)
    reduced = J[..., :c] - J[..., c:] @ inverse @ hessian[:, c:, :c]
    finite = np.where(np.isfinite(found.covariance), found.covariance, 0.0)
    for camera, spread in enumerate(obs.lens_covariance):
        mine = (data.view["used"] & (data.view["camera"] == camera))[..., None, None]
        shift = (whitener @ (lens * mine)).reshape(J.shape[:2] + (LENS,))
        gain = finite @ np.sum(np.swapaxes(reduced, -1, -2) @ shift, axis=0)
        total = total + gain @ spread @ gain.T
    return total
