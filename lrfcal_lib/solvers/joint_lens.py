"""What errors of the intrinsics, which all images share, do to the joint estimate.

Equations (18) and (19), to first order.
"""

from typing import NamedTuple

import numpy as np
from scipy.linalg import block_diag
from scipy.spatial.transform import RigidTransform

from lrfcal_lib.fit.covariance import pseudo_inverse
from lrfcal_lib.fit.result import Solution
from lrfcal_lib.model.camera import LENS, CameraModel, project_jacobians
from lrfcal_lib.model.geometry import among, gradient_by_pose
from lrfcal_lib.model.observations import JointObservations
from lrfcal_lib.solvers.joint_model import JointData, Unknowns
from lrfcal_lib.solvers.joint_residuals import view_block

LEAST_CORNERS = 6  # of a pattern, for the derivative of its pose by the intrinsics


def pose_by_intrinsics(
    T_camera_board: RigidTransform, corners: np.ndarray, model: CameraModel
) -> np.ndarray:
    """How the pose of a board that fits given pixels changes with the intrinsics.

    Parameters
    ----------
    T_camera_board : RigidTransform
    corners : ndarray, shape (k, 3)
        Those of the pattern that were seen, board frame, metres.
    model : CameraModel

    Returns
    -------
    ndarray, shape (6, 9)
        Derivative of the increments ``[w, v]`` of T_camera_board; zeros with fewer than six
        corners.
    """
    if len(corners) < LEAST_CORNERS:
        return np.zeros((6, LENS))
    turned = T_camera_board.rotation.apply(corners)
    by_point, by_lens = project_jacobians(turned + T_camera_board.translation, model)
    by_pose = gradient_by_pose(turned[:, None], by_point)
    return -np.linalg.lstsq(by_pose.reshape(-1, 6), by_lens.reshape(-1, LENS))[0]


class LensShare(NamedTuple):
    """What errors of the intrinsics do; zeros where they are exact.

    Attributes
    ----------
    covariance : ndarray, shape (c, c)
        Of the shared unknowns, from those of the intrinsics.
    counted : ndarray, shape (c, c)
        What the scatter of views that these errors cause has added to the covariance through the
        scale of views, as far as that exceeds the stated noise: the intrinsics would count twice.
    scatter : float
        Of views in stated standard deviations: what no unknown can take up of the error that all
        views of a camera share.
    """

    covariance: np.ndarray
    counted: np.ndarray
    scatter: float


def lens_share(
    obs: JointObservations, found: Solution, data: JointData, unknowns: Unknowns
) -> LensShare:
    """The LensShare of a solution."""
    c = unknowns.shared
    if not np.any(obs.lens_covariance):
        exact = np.zeros((c, c))
        return LensShare(exact, exact, 0.0)
    block = view_block(found.state, data, unknowns)
    J = block.white_jacobian
    J_own = J[..., c:]
    by_lens = among(data.view["lens"], data.view["camera"][..., None], len(obs.cameras))
    shift = block.whitened(by_lens.reshape(*J.shape[:2], -1))
    spread = block_diag(*obs.lens_covariance)
    hessian = found.jacobian.mT @ found.jacobian
    own = pseudo_inverse(hessian[:, c:, c:])
    reduced = J[..., :c] - J_own @ own @ hessian[:, c:, :c]
    finite = np.nan_to_num(found.covariance, posinf=0.0, neginf=0.0)
    gain = finite @ np.sum(reduced.mT @ shift, axis=0)
    left = shift - reduced @ gain - J_own @ (own @ (J_own.mT @ shift))
    square = np.sum(left @ spread * left)
    level = data.levels.view_scale**2
    information = np.sum(reduced.mT @ reduced, axis=0)
    taken = np.sum((J_own @ own) * J_own) + np.sum(information * finite)
    # rows that are left to show it
    square *= level / max(6 * len(obs.view_camera) - taken, 1.0)
    share = np.clip(level - 1, 0, square) / level
    counted = share * finite @ information @ finite
    return LensShare(gain @ spread @ gain.T, counted, np.sqrt(square))
