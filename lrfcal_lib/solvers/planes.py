"""Scan points on board faces, compressed: all that a plane constraint can use of n points is a 4 x 4 triangle.

The distance of point i from the camera's plane is ``e_i = [p_i, 1] . h`` with ``h = [R^T n, n . (t - b)]``, so by a QR
decomposition of the weighted rows ``[p_i, 1]`` the sum of squares is that of the four numbers ``A h``, whatever the
pose.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lrfcal_lib.geometry import DegenerateGeometry, hat
from lrfcal_lib.solvers.checks import check_count, check_finite
from lrfcal_lib.solvers.least_squares import Block

SIGMA_FLOOR = 1e-4  # metres; no printed board is flatter, and a board along the beam has no range noise across it


@dataclass(frozen=True)
class PlaneSets:
    """Face points by placement, padded to the same number.

    Attributes
    ----------
    placements : ndarray of int, shape (p,)
    points : ndarray, shape (..., p, n, 3)
        Source frame, metres; padded rows are zero.
    covariance : ndarray, shape (..., p, n, 3, 3)
    used : ndarray of bool, shape (p, n)
    boards : ndarray, shape (..., p, 3, 4)
        ``T_camera_board``.
    board_covariance : ndarray, shape (..., p, 6, 6)
    """

    placements: np.ndarray
    points: np.ndarray
    covariance: np.ndarray
    used: np.ndarray
    boards: np.ndarray
    board_covariance: np.ndarray

    @property
    def count(self):
        """Number of points of each placement, shape (p,)."""
        return self.used.sum(axis=1)


def plane_sets(obs, least=3):
    """Group the face points of the placements whose board pose the camera knows.

    Parameters
    ----------
    obs : CameraObservations
    least : int
        Number of placements needed.

    Returns
    -------
    PlaneSets

    Raises
    ------
    DegenerateGeometry
        With fewer than `least` such placements.
    ValueError
        When something is not finite.
    """
    check_finite(obs, "plane")
    placements = np.intersect1d(obs.placements, obs.plane_placement)
    check_count(len(placements), least, "placements with a board pose and points on the board", obs.camera)
    rows = [np.flatnonzero(obs.plane_placement == placement) for placement in placements]
    width = max(4, max(len(r) for r in rows))
    index, used = np.zeros((len(rows), width), int), np.zeros((len(rows), width), bool)
    for i, r in enumerate(rows):
        index[i, : len(r)], used[i, : len(r)] = r, True
    points = np.where(used[..., None], obs.plane_points[index], 0.0)
    which = [int(np.flatnonzero(obs.placements == placement)[0]) for placement in placements]
    return PlaneSets(
        placements,
        points,
        obs.plane_covariance[index],
        used,
        obs.board_poses[which][:, :3],
        obs.board_covariance[which],
    )


def compress(sets, weights):
    """Triangles of the weighted rows ``[p, 1]``, shape (..., p, 4, 4).

    Parameters
    ----------
    sets : PlaneSets
    weights : ndarray, broadcastable to (..., p, n)
        Reciprocal standard deviations.
    """
    rows = np.concatenate([sets.points, np.ones(sets.points.shape[:-1] + (1,))], axis=-1)
    return np.linalg.qr(rows * (weights * sets.used)[..., None], mode="r")


def correct_and_compress(sets, pose):
    """Compress points that were moved onto the camera's planes by their noise, with what that leaves as residuals.

    A point's noise is in its residual and in its row of the Jacobian alike; rows of the moved points are free of the
    bias (see :mod:`lrfcal_lib.solvers.least_squares`).

    Parameters
    ----------
    sets : PlaneSets
    pose : ndarray, shape (..., 3, 4)
        Where the points are moved to; to be renewed when the pose has changed.

    Returns
    -------
    triangles : ndarray, shape (..., p, 4, 4)
    offset : ndarray, shape (..., p, 4)
        Residuals are ``A h + offset``; at `pose` they are what the moved rows see of the raw distances.
    rest : ndarray, shape (...)
        Chi-square of the raw distances that they do not see.
    """
    across = (np.swapaxes(pose[..., None, :, :3], -1, -2) @ sets.boards[..., :, 2:3])[..., 0]
    last = np.sum(sets.boards[..., 2] * (pose[..., None, :, 3] - sets.boards[..., 3]), axis=-1)
    distance = (np.sum(sets.points * across[..., None, :], axis=-1) + last[..., None]) * sets.used
    weights = range_weights(sets, pose) * sets.used
    pull = (sets.covariance @ across[..., None, :, None])[..., 0]
    moved = sets.points - pull * (distance * weights**2)[..., None]
    rows = np.concatenate([moved, np.ones(moved.shape[:-1] + (1,))], axis=-1) * weights[..., None]
    basis, triangles = np.linalg.qr(rows)
    seen = (np.swapaxes(basis, -1, -2) @ (weights * distance)[..., None])[..., 0]
    plane = np.concatenate([across, last[..., None]], axis=-1)
    rest = np.sum((weights * distance) ** 2, axis=(-1, -2)) - np.sum(seen**2, axis=(-1, -2))
    return triangles, seen - (triangles @ plane[..., None])[..., 0], rest


def range_weights(sets, pose):
    """Reciprocal standard deviations of the point-plane distances from the points' covariance, shape (..., p, n)."""
    across = (np.swapaxes(pose[..., None, :, :3], -1, -2) @ sets.boards[..., :, 2:3])[..., 0]
    spread = sets.covariance @ across[..., None, :, None]
    variance = np.sum(spread[..., 0] * across[..., None, :], axis=-1)
    return 1.0 / np.sqrt(variance + SIGMA_FLOOR**2)


def equal_weights(sets, pose):
    """One common weight for all points: the root mean square of their noise (plain least squares)."""
    variance = range_weights(sets, pose) ** -2.0
    total = np.sum(variance * sets.used, axis=(-1, -2), keepdims=True) / sets.used.sum()
    return np.broadcast_to(total**-0.5, variance.shape)


def plane_block(pose, triangles, boards, whitener=None, count=None, offset=0.0):
    """Distances of compressed points from the planes of boards with known poses.

    Parameters
    ----------
    pose : ndarray, shape (..., 3, 4)
        ``T_camera_source``.
    triangles : ndarray, shape (..., p, 4, 4)
    boards : ndarray, shape (..., p, 3, 4)
    whitener : ndarray, shape (..., p, 4, 4), optional
        From :func:`board_whitener`; none when the boards' poses count as exact.
    count : ndarray, shape (p,), optional
        Number of points of each placement, for losses on raw triangles.
    offset : ndarray, shape (..., p, 4), optional
        See :func:`correct_and_compress`.

    Returns
    -------
    Block
        ``4 p`` residuals in standard deviations; a loss judges a placement as a whole.
    """
    residuals, by_pose, _ = plane_terms(pose[..., None, :, :], triangles, boards, offset)
    shape = residuals.shape[:-2]
    whitener = np.broadcast_to(np.eye(4) if whitener is None else whitener, residuals.shape + (4,))
    count = None if count is None else np.maximum(count, 1)
    return Block(residuals.reshape(shape + (-1,)), by_pose.reshape(shape + (-1, 6)), whitener, count)


def board_whitener(pose, triangles, boards, board_covariance):
    """Whiteners (..., p, 4, 4) for errors of the boards' poses, common to all points of a placement."""
    _, _, by_board = plane_terms(pose[..., None, :, :], triangles, boards)
    covariance = np.eye(4) + by_board @ board_covariance @ np.swapaxes(by_board, -1, -2)
    return np.linalg.inv(np.linalg.cholesky(covariance))


def plane_terms(pose, triangles, boards, offset=0.0):
    """Residuals ``A h + offset`` and their Jacobians by the pose and by the board's pose.

    Parameters
    ----------
    pose, boards : ndarray, shape (..., 3, 4)
    triangles : ndarray, shape (..., 4, 4)
    offset : ndarray, shape (..., 4), optional

    Returns
    -------
    residuals : ndarray, shape (..., 4)
    by_pose, by_board : ndarray, shape (..., 4, 6)
    """
    normal = boards[..., 2]
    between = pose[..., 3] - boards[..., 3]
    turned = np.swapaxes(pose[..., :3], -1, -2)
    top, last = (turned @ normal[..., None])[..., 0], np.sum(normal * between, axis=-1, keepdims=True)
    residuals = (triangles @ np.concatenate([top, last], axis=-1)[..., None])[..., 0] + offset
    spin = turned @ hat(normal)
    normal = np.broadcast_to(normal, top.shape)[..., None, :]
    moment = np.cross(normal[..., 0, :], between)[..., None, :]
    upper = np.concatenate([spin, np.zeros_like(spin)], axis=-1)
    by_pose = np.concatenate([upper, np.concatenate([np.zeros_like(normal), normal], axis=-1)], axis=-2)
    by_board = np.concatenate([-upper, np.concatenate([moment, -normal], axis=-1)], axis=-2)
    return residuals, triangles @ by_pose, triangles @ by_board


def check_normals(sets, camera, least=0.02):
    """Refuse boards whose normals do not span space, naming what stays open.

    Parameters
    ----------
    sets : PlaneSets
    camera : str
    least : float
        Smallest accepted spread of the normals (root mean square component, about radians).
    """
    normals = sets.boards[:, :, 2]
    _, spread, axes = np.linalg.svd(normals)
    spread = np.append(spread, np.zeros(3))[:3] / np.sqrt(len(normals))
    directions = ["({:.2f}, {:.2f}, {:.2f})".format(*(a + 0.0)) for a in axes]
    if spread[1] < least:
        raise DegenerateGeometry(
            f"camera '{camera}': all {len(normals)} boards are parallel: the rotation about "
            f"their normal {directions[0]} and the translation along {directions[1]} and {directions[2]} stay "
            "unobservable; tilt the board in both directions"
        )
    if spread[2] < least:
        raise DegenerateGeometry(
            f"camera '{camera}': the boards turn about one axis only: the translation along {directions[2]} "
            "of the camera frame stays unobservable; tilt the board in both directions"
        )
