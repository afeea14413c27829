"""Poses of stations that agree best with all pairs of them."""

from collections.abc import Iterable, Mapping

import numpy as np
from scipy.linalg import block_diag
from scipy.spatial.transform import RigidTransform, Rotation

from lrfcal_lib.fit.gauss_newton import gauss_newton

SMALL = 1e-6  # of differences that stand for derivatives: radians, metres


class Edge:
    """What one pair says: ``T_first_second`` and the (6, 6) covariance of its turn and shift."""

    def __init__(
        self, first: int, second: int, T: RigidTransform, covariance: np.ndarray
    ) -> None:
        self.first = first
        self.second = second
        self.T = T
        self.covariance = covariance
        self.whiten = np.linalg.cholesky(np.linalg.inv(covariance)).T

    def miss(self, poses: Mapping[int, RigidTransform]) -> np.ndarray:
        """Turn and shift (6,) by which poses of the stations differ from it."""
        T = poses[self.first].inv() * poses[self.second]
        turn = (T.rotation * self.T.rotation.inv()).as_rotvec()
        return np.concatenate([turn, T.translation - self.T.translation])


def connected(edges: Iterable[Edge], station: int) -> dict[int, RigidTransform]:
    """Rough poses of all stations that edges lead to, in the frame of one, along the best edges.

    Parameters
    ----------
    edges : iterable of Edge
    station : int

    Returns
    -------
    dict of int to RigidTransform
        The one itself first.
    """
    left = sorted(edges, key=lambda edge: np.trace(edge.covariance))
    poses = {station: RigidTransform.identity()}
    grown = True
    while grown:
        grown = False
        for edge in left:
            if (edge.first in poses) == (edge.second in poses):
                continue
            if edge.first in poses:
                poses[edge.second] = poses[edge.first] * edge.T
            else:
                poses[edge.first] = poses[edge.second] * edge.T.inv()
            grown = True
            break
    return {n: poses[n] for n in sorted(poses, key=lambda n: (n != station, n))}


def solved(edges: list[Edge], station: int) -> tuple[dict[int, RigidTransform], np.ndarray]:
    """The poses that make the misses of all edges small, each by its covariance.

    Parameters
    ----------
    edges : list of Edge
        Between stations that they connect.
    station : int
        Whose frame the poses are in.

    Returns
    -------
    poses : dict of int to RigidTransform
    response : ndarray, shape (6 n, 6 e)
        Of turn and shift of each, in the order of `poses`, to those of the edges; zeros for
        `station`.
    """
    start = connected(edges, station)
    free = [number for number in start if number != station]

    def residuals(poses):
        misses = [edge.whiten @ edge.miss(poses) for edge in edges]
        return np.concatenate([np.zeros(0), *misses])

    def move(poses, step):
        """Poses with increments ``[w, v]`` of the free stations: R <- exp(w) R, t <- t + v."""
        moved = dict(poses)
        for number, part in zip(free, step.reshape(-1, 6), strict=True):
            turn = Rotation.from_rotvec(part[:3]) * poses[number].rotation
            shift = poses[number].translation + part[3:]
            moved[number] = RigidTransform.from_components(shift, turn)
        return moved

    size = 6 * len(free)
    response = np.zeros((size + 6, 6 * len(edges)))
    if not free:
        return start, response
    poses, _ = gauss_newton(residuals, move, start, size)
    columns = []
    for step in SMALL * np.eye(size):
        change = residuals(move(poses, step)) - residuals(move(poses, -step))
        columns.append(change / (2 * SMALL))
    J = np.stack(columns, axis=1)
    whiten = block_diag(*(edge.whiten for edge in edges))
    response[6:] = np.linalg.pinv(J) @ whiten
    return poses, response
