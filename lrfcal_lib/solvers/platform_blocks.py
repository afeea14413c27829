"""Residuals of the platform calibration: a board of its own for every placement, and the tilt axis common to all."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lrfcal_lib.geometry import DegenerateGeometry, axis_of, fit_line, fit_plane, head_from_axis, lrf_to_platform, tilt
from lrfcal_lib.solvers.least_squares import Block
from lrfcal_lib.solvers.planes import SIGMA_FLOOR
from lrfcal_lib.solvers.pose import cross, move_pose, pose_array, pose_transform

CHART = [1, 2, 4, 5]  # of [w, v]


@dataclass(frozen=True)
class PaddedBoards:
    """Observations padded to the same number of points for every placement, and the start of each board."""

    placements: np.ndarray
    points: np.ndarray
    covariance: np.ndarray
    pitch: np.ndarray
    second: np.ndarray
    used: np.ndarray
    face: np.ndarray
    face_covariance: np.ndarray
    face_pitch: np.ndarray
    face_used: np.ndarray
    lone: np.ndarray


def chart_parameters(head):
    """The axis as angles out of and within the scan plane, and minus y, z of its foot, shape (4,)."""
    axis = axis_of(pose_transform(head))
    return np.r_[
        np.arctan2(axis.direction[2], axis.direction[0]),
        np.arctan2(-axis.direction[1], axis.direction[0]),
        -axis.foot[1:],
    ]


def degrees_of_freedom(data, prior):
    rows = 2 * data.used.sum() + data.face_used.sum() + 2 * len(data.placements) + (0 if prior is None else 4)
    return int(rows) - 4 - 8 * len(data.placements)


def prepare_boards(obs, T_head_lrf, use_face):
    """Group and pad the observations, and fit a start board (x along edge 1, z its normal) to every placement."""
    p_platform = lrf_to_platform(obs.points, obs.pitch, T_head_lrf)
    face_platform = lrf_to_platform(obs.face_points, obs.face_pitch, T_head_lrf)
    kept, rows, faces, boards, skipped = [], [], [], [], {}
    for placement in np.unique(obs.placement):
        edges = [np.flatnonzero((obs.placement == placement) & (obs.edge == e)) for e in (1, 2)]
        face = np.flatnonzero(obs.face_placement == placement) if use_face else np.zeros(0, int)
        edges = sorted((e for e in edges if len(e) >= 2), key=lambda e: obs.edge[e[0]])
        reason, board = _start_board([p_platform[e] for e in edges], face_platform[face])
        if reason:
            skipped[int(placement)] = reason
            continue
        kept.append(int(placement))
        boards.append(board)
        rows.append(edges)
        faces.append(face)
    if not kept:
        raise DegenerateGeometry(f"no placement can be used for the tilt axis: {skipped}")
    return _pad(obs, kept, rows, faces), np.array(boards), skipped


def _start_board(edges, face):
    """Pose array of the board from its edge and face points in the platform frame, or the reason why not."""
    if not edges:
        return "fewer than two points on either edge", None
    point, x, _ = fit_line(edges[0])
    if len(edges) == 2:
        point2, second, _ = fit_line(edges[1])
        z = np.cross(x, second)
        if np.linalg.norm(z) < np.sin(np.radians(30)):
            return "the two edges are nearly parallel: edges 1 and 2 must be perpendicular", None
        z /= np.linalg.norm(z)
        point = point + x * _along(point, x, point2, second)
    elif len(face) >= 3:
        normal = fit_plane(face)[0]
        z = normal - x * (x @ normal)
        z /= np.linalg.norm(z)
    else:
        return "only one edge, and no points on the face", None
    return "", np.column_stack([x, np.cross(z, x), z, point])


def _along(point, direction, point2, direction2):
    """How far along the first line it comes nearest to the second."""
    c, between = direction @ direction2, point2 - point
    return (between @ direction - c * (between @ direction2)) / (1 - c * c)


def _pad(obs, placements, rows, faces):
    index, used = _padded([np.concatenate(r) for r in rows])
    second, _ = _padded([np.concatenate([np.full(len(e), i) for i, e in enumerate(r)]) for r in rows])
    face, face_used = _padded(faces)
    covariance, floor = obs.covariance, SIGMA_FLOOR**2 * np.eye(3)
    empty = len(obs.face_points) == 0
    face_points = np.zeros((1, 3)) if empty else obs.face_points
    face_covariance = np.zeros((1, 3, 3)) if empty else obs.face_covariance
    face_pitch = np.zeros(1) if empty else obs.face_pitch
    lone = np.array([len(r) == 1 for r in rows])
    return PaddedBoards(
        np.array(placements),
        obs.points[index],
        covariance[index] + floor,
        obs.pitch[index],
        second.astype(float),
        used,
        face_points[face],
        face_covariance[face] + floor,
        face_pitch[face],
        face_used,
        lone,
    )


def _padded(rows):
    """Indices of ragged rows as a rectangle (zeros behind), and which of them count."""
    width = max(1, max(len(r) for r in rows))
    index, used = np.zeros((len(rows), width), int), np.zeros((len(rows), width), bool)
    for i, r in enumerate(rows):
        index[i, : len(r)], used[i, : len(r)] = r, True
    return index, used


def platform_blocks(state, data, weights, prior):
    """All residuals by placement; unknowns: axis 4, then board pose 6, skew and gap."""
    head, boards, bends = state
    sigma_skew, sigma_gap, sigma_pitch = weights
    skew, gap = bends[:, 0], bends[:, 1]
    blocks = [_edge_block(head, boards, skew, gap, data, sigma_pitch), _face_block(head, boards, data, sigma_pitch)]
    p = len(boards)
    board_rows = np.zeros((p, 2, 12))
    board_rows[:, 0, 10] = board_rows[:, 1, 11] = 1.0
    blocks.append(Block(bends, board_rows, np.broadcast_to([1 / sigma_skew, 1 / sigma_gap], (p, 2))))
    blocks.append(_lone_block(head, boards, data))
    if prior is not None:
        blocks.append(_prior_block(head, prior, p))
    return blocks


def _rows(head, boards, points, pitch, gradient):
    """Jacobian rows by the axis chart (4) and the board's pose (6), and the gradient by the LRF point.

    `gradient` (p, n, 3) is that of a scalar by the board coordinates of the point.
    """
    rotated = points @ head[:, :3].T
    q = tilt(rotated + head[:, 3], pitch)
    by_platform = gradient @ np.swapaxes(boards[:, :, :3], -1, -2)
    by_head = tilt(by_platform, -pitch)
    axis = np.concatenate([cross(rotated, by_head), by_head], axis=-1)[..., CHART]
    board = np.concatenate([cross(by_platform, q - boards[:, None, :, 3]), -by_platform], axis=-1)
    by_pitch = by_platform[..., 2] * q[..., 1] - by_platform[..., 1] * q[..., 2]
    return np.concatenate([axis, board], axis=-1), by_head @ head[:, :3], by_pitch


def _board_coordinates(head, boards, points, pitch):
    q = tilt(points @ head[:, :3].T + head[:, 3], pitch)
    return (q - boards[:, None, :, 3]) @ boards[:, :, :3]


def _edge_block(head, boards, skew, gap, data, sigma_pitch):
    """Two distances of an edge point from its edge, in the board's plane and across it."""
    b = _board_coordinates(head, boards, data.points, data.pitch)
    inside = _inside(skew, data.second)
    r = np.stack([np.sum(inside * b, axis=-1), b[..., 2] - data.second * gap[:, None]], axis=-1)
    J, by_point, by_pitch = _edge_rows(head, boards, skew, data.points, data.pitch, data.second)
    by_pitch = by_pitch * sigma_pitch
    noise = by_point @ data.covariance @ np.swapaxes(by_point, -1, -2) + by_pitch[..., :, None] * by_pitch[..., None, :]
    force = np.linalg.solve(noise, r[..., None])
    points = data.points - (data.covariance @ np.swapaxes(by_point, -1, -2) @ force)[..., 0]
    pitch = data.pitch - sigma_pitch * np.sum(by_pitch * force[..., 0], axis=-1)
    corrected = _edge_rows(head, boards, skew, points, pitch, data.second)[0]
    whitener = np.linalg.inv(np.linalg.cholesky(noise)) * data.used[..., None, None]
    p = len(boards)
    return Block(r.reshape(p, -1), J.reshape(p, -1, 12), whitener, corrected=corrected.reshape(p, -1, 12))


def _inside(skew, second):
    """Normals, in the board's plane, of the edge of each point (edge 1 along x, edge 2 along y but for the skew)."""
    c, s = np.cos(skew)[:, None], np.sin(skew)[:, None]
    return np.stack([second * c, 1 - second + second * s, 0 * second], axis=-1)


def _edge_rows(head, boards, skew, points, pitch, second):
    """Jacobian (p, n, 2, 12) of the two distances, and their gradients by the LRF point and the pitch."""
    inside = _inside(skew, second)
    pairs = [_rows(head, boards, points, pitch, g) for g in (inside, np.broadcast_to([0.0, 0.0, 1.0], inside.shape))]
    rows, by_point, by_pitch = (np.stack([pair[i] for pair in pairs], axis=2) for i in range(3))
    b = _board_coordinates(head, boards, points, pitch)
    bend = np.zeros(rows.shape[:-1] + (2,))
    c, s = np.cos(skew)[:, None], np.sin(skew)[:, None]
    bend[..., 0, 0] = second * (c * b[..., 1] - s * b[..., 0])
    bend[..., 1, 1] = -second
    return np.concatenate([rows, bend], axis=-1), by_point, by_pitch


def _face_block(head, boards, data, sigma_pitch):
    """Distances of face points from the board's plane."""
    r = _board_coordinates(head, boards, data.face, data.face_pitch)[..., 2]
    up = np.broadcast_to([0.0, 0.0, 1.0], data.face.shape)
    rows, by_point, by_pitch = _rows(head, boards, data.face, data.face_pitch, up)
    pull = (by_point[..., None, :] @ data.face_covariance)[..., 0, :]
    variance = np.sum(pull * by_point, axis=-1) + (by_pitch * sigma_pitch) ** 2
    force = r / variance
    pitch = data.face_pitch - sigma_pitch**2 * by_pitch * force
    corrected = _rows(head, boards, data.face - pull * force[..., None], pitch, up)[0]
    bend = np.zeros(rows.shape[:-1] + (2,))
    jacobian, corrected = (np.concatenate([x, bend], axis=-1) for x in (rows, corrected))
    return Block(r, jacobian, data.face_used / np.sqrt(variance), corrected=corrected)


def _lone_block(head, boards, data):
    """A board seen with one edge may slide along it: its origin is held at the middle of that edge's points."""
    count = np.maximum(data.used.sum(axis=1), 1)[:, None]
    b = _board_coordinates(head, boards, data.points, data.pitch)
    rows, _, _ = _rows(head, boards, data.points, data.pitch, np.broadcast_to([1.0, 0.0, 0.0], b.shape))
    mean = np.sum(b[..., 0] * data.used, axis=1, keepdims=True) / count
    slope = np.sum(rows * data.used[..., None], axis=1, keepdims=True) / count[..., None]
    jacobian = np.concatenate([slope, np.zeros(slope.shape[:-1] + (2,))], axis=-1)
    return Block(mean, jacobian, data.lone[:, None] * 100.0)


def prior_terms(head, prior):
    """Differences from the prior in the chart (4,), and their Jacobian (4, 4) by the chart's increments.

    The direction is compared by ``R0 R^T e_x``, the offset by the foot points, both in the prior's head frame.
    """
    reference = pose_array(head_from_axis(axis_of(prior.T_head_lrf)))
    turn = reference[:, :3] @ head[:, :3].T
    along, arm = turn[:, 0], np.array([0.0, head[1, 3], head[2, 3]])
    r = np.r_[along[2], -along[1], (turn @ arm)[1:] - reference[1:, 3]]
    J = np.zeros((4, 4))
    for column, w in enumerate(np.eye(3)[1:]):
        spun = -turn @ np.cross(w, [1.0, 0.0, 0.0])
        J[:2, column] = spun[2], -spun[1]
        J[2:, column] = -(turn @ np.cross(w, arm))[1:]
    J[2:, 2:] = turn[1:, 1:]
    return r, J


def _prior_block(head, prior, p):
    """The prior counts once: every placement holds a part, so that leaving one out (the scatter) keeps the rest."""
    r, J = prior_terms(head, prior)
    jacobian = np.zeros((p, 4, 12))
    jacobian[..., :4] = J
    weights = np.repeat([1 / prior.sigma_direction, 1 / prior.sigma_offset], 2) / np.sqrt(p)
    return Block(np.tile(r, (p, 1)), jacobian, np.tile(weights, (p, 1)))


def move_head(head, step):
    """Move a head pose array in the 4-dof chart."""
    delta = np.zeros(step.shape[:-1] + (6,))
    delta[..., CHART] = step
    return move_pose(head, delta)


def move_platform(state, step):
    common, own = step
    return move_head(state[0], common), move_pose(state[1], own[:, :6]), state[2] + own[:, 6:]
