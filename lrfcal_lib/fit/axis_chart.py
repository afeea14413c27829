"""The tilt axis as four numbers: two angles and two offsets, and what is stated about them."""

import numpy as np

from lrfcal_lib.fit.result import PlatformPrior
from lrfcal_lib.model import geometry
from lrfcal_lib.model.geometry import hat, move_pose, pose_transform

PRIOR_FREEDOM = 3.0  # of Student's t: what is stated about the axis yields to the data
# of the increments [w, v] of T_head_lrf: what the gauge leaves
AXIS_COLUMNS = np.array([1, 2, 4, 5])


def chart_parameters(head: np.ndarray) -> np.ndarray:
    """The axis of a head pose as four numbers.

    Parameters
    ----------
    head : ndarray, shape (3, 4)
        ``T_head_lrf``.

    Returns
    -------
    ndarray, shape (4,)
        Angles out of and within the scan plane (radians), minus y and z of the axis' foot (metres).
    """
    axis = geometry.axis_of(pose_transform(head))
    x, y, z = axis.direction
    return np.r_[np.arctan2(z, x), np.arctan2(-y, x), -axis.foot[1:]]


def prior_terms(head: np.ndarray, prior: PlatformPrior) -> tuple[np.ndarray, np.ndarray]:
    """Differences from the prior in the chart, and their Jacobian by the chart's increments.

    The direction is compared by ``R0 R^T e_x``, the offset by the foot points, both in the prior's
    head frame.

    Parameters
    ----------
    head : ndarray, shape (3, 4)
        ``T_head_lrf``.
    prior : PlatformPrior

    Returns
    -------
    residuals : ndarray, shape (4,)
        Radians and metres.
    jacobian : ndarray, shape (4, 4)
    """
    reference = geometry.pose_array(
        geometry.head_from_axis(geometry.axis_of(prior.T_head_lrf))
    )
    turn = reference[:, :3] @ head[:, :3].T
    along = turn[:, 0]
    arm = np.array([0.0, head[1, 3], head[2, 3]])
    r = np.r_[along[2], -along[1], (turn @ arm)[1:] - reference[1:, 3]]
    J = np.zeros((4, 4))
    # of R^T e_x and R^T t by w_y, w_z
    by_turn = turn @ hat(np.array([[1.0, 0.0, 0.0], arm]))[..., 1:]
    J[:2, :2] = by_turn[0, [2, 1]] * [[1.0], [-1.0]]
    J[2:, :2] = by_turn[1, 1:]
    J[2:, 2:] = turn[1:, 1:]
    return r, J


def move_head(head: np.ndarray, step: np.ndarray) -> np.ndarray:
    """Move a head pose in the chart.

    Parameters
    ----------
    head : ndarray, shape (..., 3, 4)
    step : ndarray, shape (..., 4)
        See `AXIS_COLUMNS`, radians and metres.
    """
    delta = np.zeros(step.shape[:-1] + (6,))
    delta[..., AXIS_COLUMNS] = step
    return move_pose(head, delta)
