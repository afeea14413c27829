"""The tilt axis as four numbers: two angles and two offsets, and what is stated about them.

Equations (1) and (2) in the unknowns that data can show.
"""

from collections.abc import Callable

import numpy as np

from lrfcal_lib.fit.result import PlatformPrior
from lrfcal_lib.model.geometry import (
    POSE,
    axis_of,
    head_from_axis,
    move_pose,
    pose_array,
    pose_transform,
)

PRIOR_FREEDOM = 3.0  # of Student's t: what is stated about the axis yields to the data
# of the increments [w, v] of T_head_lrf: what the gauge leaves
AXIS_COLUMNS = np.array([1, 2, 4, 5])
SMALL = 1e-6  # of the differences that stand for derivatives: radians, metres


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
    axis = axis_of(pose_transform(head))
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
    axis = axis_of(prior.T_head_lrf)
    reference = pose_array(head_from_axis(axis))

    def differences(heads):
        """Those of heads (k, 3, 4), shape (k, 4)."""
        turn = reference[:, :3] @ heads[..., :3].mT
        arm = heads[..., 3] * [0.0, 1.0, 1.0]
        away = np.matvec(turn, arm) - reference[:, 3]
        return np.column_stack([turn[:, 2, 0], -turn[:, 1, 0], away[:, 1:]])

    return by_chart(differences, head)


def by_chart(function: Callable, head: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Values at a head pose, and their derivatives by the chart from differences.

    Parameters
    ----------
    function : callable
        Of heads (k, 3, 4), shape (k, m).
    head : ndarray, shape (3, 4)

    Returns
    -------
    values : ndarray, shape (m,)
    derivatives : ndarray, shape (m, 4)
    """
    steps = SMALL * np.vstack([np.zeros(4), np.eye(4), -np.eye(4)])
    here, ahead, behind = np.split(function(move_head(head, steps)), [1, 5])
    return here[0], (ahead - behind).T / (2 * SMALL)


def move_head(head: np.ndarray, step: np.ndarray) -> np.ndarray:
    """Move a head pose in the chart.

    Parameters
    ----------
    head : ndarray, shape (..., 3, 4)
    step : ndarray, shape (..., 4)
        See `AXIS_COLUMNS`, radians and metres.
    """
    return move_pose(head, step @ np.eye(POSE)[AXIS_COLUMNS])
