"""Poses of stations that agree best with all pairs of them."""

from collections.abc import Collection

import numpy as np
from scipy.linalg import block_diag
from scipy.optimize import least_squares
from scipy.spatial.transform import RigidTransform

from lrfcal_lib.fit.covariance import inverse_root
from lrfcal_lib.measure.pairs import Pair
from lrfcal_lib.model.geometry import POSE, move_pose, pose_array, pose_transform


def connected(pairs: Collection[Pair], station: int) -> dict[int, RigidTransform]:
    """Rough poses of all stations that pairs lead to, in the frame of one, along the best pairs.

    Parameters
    ----------
    pairs : collection of Pair
    station : int

    Returns
    -------
    dict of int to RigidTransform
        The one itself first.
    """
    start = {station: RigidTransform.identity()}
    poses = dict(start)
    while leads_on := [p for p in pairs if (p.first in poses) != (p.second in poses)]:
        best = min(leads_on, key=lambda pair: np.trace(pair.covariance))
        if best.first in poses:
            poses[best.second] = poses[best.first] * best.T_first_second
        else:
            poses[best.first] = poses[best.second] * best.T_first_second.inv()
    return start | dict(sorted(poses.items()))


def solved(
    pairs: list[Pair], start: dict[int, RigidTransform]
) -> tuple[dict[int, RigidTransform], np.ndarray]:
    """The poses that make the misses of all pairs small, each by its covariance.

    Parameters
    ----------
    pairs : list of Pair
        One or more, between stations that they connect.
    start : dict of int to RigidTransform
        Of :func:`connected`; the first one stays.

    Returns
    -------
    poses : dict of int to RigidTransform
    response : ndarray, shape (n, 6, 6 e)
        Of turn and shift of each, in the order of `poses`, to those of the pairs; zeros for the
        first.
    """
    begun = np.array([pose_array(T) for T in start.values()])

    def after(steps):
        """The poses after turns and shifts of all but the first."""
        moved = move_pose(begun, np.pad(steps, (POSE, 0)).reshape(-1, POSE))
        return dict(zip(start, pose_transform(moved), strict=True))

    def residuals(steps):
        poses = after(steps)
        return whiten @ np.concatenate([pair.miss(poses) for pair in pairs])

    whiten = block_diag(*(inverse_root(pair.covariance) for pair in pairs))
    nothing = np.zeros(POSE * len(start) - POSE)
    best = least_squares(residuals, nothing, jac="3-point", x_scale="jac")
    response = np.linalg.pinv(best.jac) @ whiten
    of_others = response.reshape(-1, POSE, POSE * len(pairs))
    return after(best.x), np.pad(of_others, ((1, 0), (0, 0), (0, 0)))
