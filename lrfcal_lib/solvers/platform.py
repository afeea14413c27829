"""The tilt axis from edges swept at known pitch angles (eqs. 1-15): in space, and projected as printed."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import RigidTransform

from lrfcal_lib.fit.least_squares import Block, solve
from lrfcal_lib.fit.residuals import AXIS_COLUMNS as CHART
from lrfcal_lib.fit.residuals import SIGMA_FLOOR, chart_parameters, move_head, prior_terms
from lrfcal_lib.fit.result import AXIS_NAMES, AXIS_WORDS, Solution
from lrfcal_lib.model.geometry import (
    DegenerateGeometry,
    TiltAxis,
    axis_of,
    cross,
    fit_line,
    fit_plane,
    head_from_axis,
    lrf_to_platform,
    move_pose,
    paper_parameters,
    pose_array,
    pose_transform,
    tilt,
)

SIGMA_SKEW = np.radians(0.2)
GAUGE = ("rotation about the tilt axis", "translation along the tilt axis")


@dataclass(frozen=True)
class PlatformObservations:
    """Edge points (and face points) of boards swept by the pitching LRF.

    Attributes
    ----------
    points : ndarray, shape (n, 3)
        Edge points, LRF frame, metres.
    covariance : ndarray, shape (n, 3, 3)
    pitch : ndarray, shape (n,)
        Recorded pitch of their scan lines, radians.
    placement : ndarray of int, shape (n,)
    edge : ndarray of int, shape (n,)
        1 or 2: the two perpendicular edges of equations (7) to (14).
    face_points, face_covariance, face_pitch, face_placement : ndarray
        Points on the board's face, likewise; they may be empty.
    """

    points: np.ndarray
    covariance: np.ndarray
    pitch: np.ndarray
    placement: np.ndarray
    edge: np.ndarray
    face_points: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
    face_covariance: np.ndarray = field(default_factory=lambda: np.zeros((0, 3, 3)))
    face_pitch: np.ndarray = field(default_factory=lambda: np.zeros(0))
    face_placement: np.ndarray = field(default_factory=lambda: np.zeros(0, int))

    def __post_init__(self):
        for name in ("points", "covariance", "pitch", "face_points", "face_covariance", "face_pitch"):
            bad = ~np.isfinite(getattr(self, name))
            if bad.any():
                raise ValueError(f"{name} holds {int(bad.sum())} values that are not finite: leave such points out")
        if not np.isin(self.edge, (1, 2)).all():
            raise ValueError(f"edge must be 1 or 2 (the two perpendicular edges), got {np.unique(self.edge)}")


@dataclass(frozen=True)
class PlatformSolution:
    """The estimated tilt axis.

    Attributes
    ----------
    T_head_lrf : RigidTransform
        In the gauge of :func:`lrfcal_lib.model.geometry.head_from_axis`.
    axis : TiltAxis
    phi, ty : ndarray, shape (3,), and float
        The paper's parameters of the same axis. As ``ty -> 0``, phi_x loses its meaning.
    covariance : ndarray, shape (4, 4)
        Of ``(w_y, w_z, v_y, v_z)``, see the module; radians and metres. From the propagated noise.
    covariance_placements : ndarray, shape (4, 4), or None
        The same from the scatter over the placements; see :class:`lrfcal_lib.fit.result.Solution`.
    unobservable : tuple of str
        Motions that the data leave open. What no pitching data can show (`gauge`) is not counted.
    gauge : tuple of str
    skipped : dict of int to str
        Placements left out, with the reason.
    placements : ndarray of int, shape (p,)
        Placements used.
    skew, gap : ndarray, shape (p,)
        Deviation of the two edges from a right angle (radians), and their distance (metres), at the solution.
    solution : Solution
        Of the least squares problem (residuals, Jacobian, cost history, ...).
    """

    T_head_lrf: RigidTransform
    axis: TiltAxis
    phi: np.ndarray
    ty: float
    covariance: np.ndarray
    covariance_placements: np.ndarray | None
    unobservable: tuple[str, ...]
    gauge: tuple[str, ...]
    skipped: dict[int, str]
    placements: np.ndarray
    skew: np.ndarray
    gap: np.ndarray
    solution: Solution

    @property
    def sigma_direction(self):
        """Standard deviation of the direction, radians (root of the trace of its two angles)."""
        return float(np.sqrt(np.trace(self.solution.trusted[:2, :2])))

    @property
    def sigma_offset(self):
        """Standard deviation of the offset, metres (root of the trace of its two components)."""
        return float(np.sqrt(np.trace(self.solution.trusted[2:, 2:])))

    @property
    def converged(self):
        return self.solution.converged

    def __repr__(self):
        return f"PlatformSolution({self.solution.method}, {self.axis}, {len(self.placements)} placements)"


def start_head(T0=None, prior=None):
    """Start value of ``T_head_lrf``: given, or the prior's, or an axis through the LRF's origin along its x."""
    start = T0 if T0 is not None else prior.T_head_lrf if prior is not None else RigidTransform.identity()
    return head_from_axis(axis_of(start))


def solve_platform(
    obs,
    T0=None,
    prior=None,
    *,
    sigma_skew=SIGMA_SKEW,
    sigma_gap=0.002,
    sigma_pitch=0.0,
    use_face=True,
    loss=None,
    scale=1.0,
    max_iterations=100,
    required=True,
):
    """The tilt axis from 3D line fits, weighted by propagated noise.

    Parameters
    ----------
    obs : PlatformObservations
    T0 : RigidTransform, optional
        Start value of ``T_head_lrf``; see :func:`start_head`.
    prior : PlatformPrior, optional
        A rough measurement that enters with its weight.
    sigma_skew, sigma_gap : float
        Tolerances of the board: right angle of the two edges (radians) and their distance (metres). The
        perpendicularity and coplanarity of equations (13) and (14) are residuals with these weights.
    sigma_pitch : float
        Standard deviation of a recorded pitch, radians.
    use_face : bool
        Also require the face points to lie in the plane of edge 1.
    loss : {None, 'huber', 'cauchy'}
        Robust loss for single points, with `scale` (standard deviations, or 'auto').
    scale : float or 'auto'
    max_iterations : int
    required : bool
        False: report unobservable motions instead of raising.

    Returns
    -------
    PlatformSolution

    Raises
    ------
    DegenerateGeometry
        When no placement can be used, or when the data leave a motion of the axis open.

    Notes
    -----
    Equations (1) to (15) with total least squares lines instead of projected fits: every placement has a board of its
    own (pose, skew, gap: 8 unknowns, eliminated by a Schur complement), an edge point has two distances from its edge.
    A placement with one edge serves too when it has face points.
    """
    head = pose_array(start_head(T0, prior))
    data, boards, skipped = prepare_boards(obs, pose_transform(head), use_face)
    weights = (sigma_skew, sigma_gap, sigma_pitch)
    options = dict(
        names=AXIS_NAMES,
        method="platform_3d",
        read=lambda s: (pose_transform(s[0]), chart_parameters(s[0])),
        shared=4,
        loss=loss,
        scale=scale,
        max_iterations=max_iterations,
        words=axis_words,
        freedom=degrees_of_freedom(data, prior),
        limit=0.5,
        n_observations=int(data.used.sum() + data.face_used.sum()),
    )

    def evaluate(state):
        return platform_blocks(state, data, weights, prior)

    first = solve(evaluate, (head, boards, np.zeros((len(boards), 2))), move_platform, required=False, **options)
    gauge = head_from_axis(axis_of(first.transform))
    _, boards, _ = prepare_boards(obs, gauge, use_face)
    state = (pose_array(gauge), boards, np.zeros((len(boards), 2)))
    found = solve(evaluate, state, move_platform, required=required, earlier=[first.cost_history], **options)
    first = 2 * data.used.shape[1] + data.face_used.shape[1]
    skew, gap = (found.residuals[:, first : first + 2] * [sigma_skew, sigma_gap]).T
    return platform_solution(found, data.placements, skew, gap, skipped)


def platform_solution(found, placements, skew, gap, skipped):
    """Wrap a solved axis."""
    T = head_from_axis(axis_of(found.transform))
    phi, ty = paper_parameters(T)
    return PlatformSolution(
        T,
        axis_of(T),
        phi,
        ty,
        found.covariance,
        found.covariance_placements,
        found.unobservable,
        GAUGE,
        skipped,
        placements,
        skew,
        gap,
        found,
    )


def axis_words(direction):
    """A combination of the four motions of the axis in words."""
    large = [
        words
        for words, value in zip(AXIS_WORDS, direction, strict=True)
        if abs(value) > 0.3 * np.max(np.abs(direction))
    ]
    return " with ".join(large)


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


def _prior_block(head, prior, p):
    """The prior counts once: every placement holds a part, so that leaving one out (the scatter) keeps the rest."""
    r, J = prior_terms(head, prior)
    jacobian = np.zeros((p, 4, 12))
    jacobian[..., :4] = J
    weights = np.repeat([1 / prior.sigma_direction, 1 / prior.sigma_offset], 2) / np.sqrt(p)
    return Block(np.tile(r, (p, 1)), jacobian, np.tile(weights, (p, 1)))


def move_platform(state, step):
    common, own = step
    return move_head(state[0], common), move_pose(state[1], own[:, :6]), state[2] + own[:, 6:]


LEAST_SLOPE = 0.1  # nearer to a coordinate plane (6 degrees) a projected fit is useless


def solve_projected(obs, T0=None, *, least_slope=LEAST_SLOPE, max_iterations=100, required=True):
    """The tilt axis by the paper's projected line fits.

    Parameters
    ----------
    obs : PlatformObservations
        Its edge points are used, without their covariance.
    T0 : RigidTransform, optional
        Start value of ``T_head_lrf``; see :func:`lrfcal_lib.solvers.platform.start_head`.
    least_slope : float
        A placement is left out when an edge is nearer than this (radians) to the xy or the xz plane of the platform.
    max_iterations : int
    required : bool
        False: report unobservable motions instead of raising.

    Returns
    -------
    PlatformSolution
        `skipped` names the placements with an edge parallel to a coordinate plane: their projected fits would divide by
        zero. The covariance comes from the scatter of the residuals.

    Raises
    ------
    DegenerateGeometry
        When no placement is left, or when the data leave a motion of the axis open.

    Notes
    -----
    Equation (15) is garbled; it is read as the sum over the placements of the squares of six terms: the root mean
    square errors of the four projected fits (each point's error over the root of their number enters, which has the
    same sum of squares and stays smooth), ``|u1 . u2|`` of the unit directions (unit vectors, because the paper's (9)
    and (10) grow beyond bounds for level edges) and the gap D in metres. These have different units and no weights: the
    result depends on that. :func:`lrfcal_lib.solvers.platform.solve_platform` weighs every term by its noise.
    """
    head = pose_array(start_head(T0))
    groups, skipped = _usable(obs, head, least_slope)
    if not groups:
        raise DegenerateGeometry(f"projected fits: no placement can be used: {skipped}; use the 3D fits instead")
    rows = np.concatenate([np.full(2 * (len(a) + len(b)) + 2, placement) for placement, a, b in groups])
    options = dict(
        names=AXIS_NAMES, method="platform_projected", words=axis_words, groups=rows, limit=np.inf, required=required,
        read=lambda state: (pose_transform(state), chart_parameters(state)), max_iterations=max_iterations,
    )  # fmt: skip
    first = solve(lambda state: projected_block(state, obs, groups), head, move_head, **options)
    gauge = pose_array(head_from_axis(axis_of(first.transform)))
    count = len(first.residuals)
    scatter = max(np.sqrt(np.sum(first.residuals**2) / max(count - 4, 1)), 1e-6)
    found = solve(
        lambda state: _scaled(projected_block(state, obs, groups), scatter), gauge, move_head,
        earlier=[first.cost_history], **options,
    )  # fmt: skip
    placements = np.array([g[0] for g in groups])
    skew, gap = _properties(found, groups, scatter)
    return platform_solution(found, placements, skew, gap, skipped)


def _scaled(block, scatter):
    return Block(block.residuals, block.jacobian, np.full_like(block.residuals, 1.0 / scatter))


def _properties(found, groups, scatter):
    """Cosine of the two edges and their gap, the last two residuals of every placement."""
    ends = np.cumsum([2 * (len(a) + len(b)) + 2 for _, a, b in groups])
    residuals = found.residuals * scatter
    return np.arcsin(np.clip(residuals[ends - 2], -1, 1)), residuals[ends - 1]


def _usable(obs, head, least_slope):
    """Rows of edges 1 and 2 of every placement whose edges are slanted to the coordinate planes; reasons."""
    q = tilt(obs.points @ head[:, :3].T + head[:, 3], obs.pitch)
    groups, skipped = [], {}
    for placement in np.unique(obs.placement):
        rows = [np.flatnonzero((obs.placement == placement) & (obs.edge == e)) for e in (1, 2)]
        reason = ""
        for number, r in enumerate(rows, start=1):
            if len(r) < 3:
                reason = reason or f"edge {number} has {len(r)} points, at least 3 needed"
                continue
            direction = np.abs(fit_line(q[r])[1])
            for axis, plane in ((2, "xy"), (1, "xz")):
                if direction[axis] < least_slope:
                    reason = (
                        reason or f"edge {number} is parallel to the {plane} plane: its projected fits divide by zero"
                    )
        if reason:
            skipped[int(placement)] = reason
        else:
            groups.append((int(placement), *rows))
    return groups, skipped


def projected_block(head, obs, groups):
    """The six terms of equation (15) of every placement, with their analytic Jacobian by the axis chart.

    Parameters
    ----------
    head : ndarray, shape (3, 4)
        ``T_head_lrf``.
    obs : PlatformObservations
    groups : list of (placement, rows of edge 1, rows of edge 2)

    Returns
    -------
    Block
    """
    rotated = obs.points @ head[:, :3].T
    q = tilt(rotated + head[:, 3], obs.pitch)
    slopes = np.stack([_coordinate_slope(rotated, obs.pitch, axis) for axis in range(3)], axis=1)
    parts = [_placement_terms(q, slopes, a, b) for _, a, b in groups]
    residuals, jacobian = (np.concatenate([part[i] for part in parts]) for i in range(2))
    return Block(residuals, jacobian, np.ones_like(residuals))


def _coordinate_slope(rotated, pitch, axis):
    """Derivative (n, 4) of a platform coordinate of every point by the axis chart."""
    gradient = tilt(np.broadcast_to(np.eye(3)[axis], rotated.shape), -pitch)
    return np.concatenate([cross(rotated, gradient), gradient], axis=1)[:, CHART]


def _placement_terms(q, slopes, first, second):
    """Residuals (2 n1 + 2 n2 + 2,) of one placement and their Jacobian."""
    lines = [_projected_line(q[rows], slopes[rows]) for rows in (first, second)]
    (u1, du1, p1, dp1), (u2, du2, p2, dp2) = (line[2:] for line in lines)
    normal = np.cross(u1, u2)
    dnormal = np.cross(du1.T, u2) + np.cross(u1, du2.T)
    length, between = np.linalg.norm(normal), p1 - p2
    gap = normal @ between / length
    dgap = (dnormal @ between + (dp1 - dp2).T @ normal) / length - gap * (dnormal @ normal) / length**2
    residuals = [lines[0][0], lines[1][0], [u1 @ u2, gap]]
    jacobian = [lines[0][1], lines[1][1], np.stack([u2 @ du1 + u1 @ du2, dgap])]
    return np.concatenate(residuals), np.concatenate(jacobian)


def _projected_line(q, slopes):
    """Fit ``x = a z + b`` and ``z = c y + d`` (equations (7), (8)) to one edge.

    Returns
    -------
    errors : ndarray, shape (2 n,)
        Over the root of n.
    jacobian : ndarray, shape (2 n, 4)
    direction, its jacobian (3, 4), point, its jacobian (3, 4)
        Equations (9) to (12): ``u ~ (a, 1 / c, 1)`` as a unit vector and ``p = (b, -d / c, 0)``.
    """
    x, y, z = q.T
    dx, dy, dz = (slopes[:, i] for i in range(3))
    e1, de1, a, da, b, db = _regression(z, dz, x, dx)
    e2, de2, c, dc, d, dd = _regression(y, dy, z, dz)
    root = np.sqrt(len(q))
    raw, draw = np.array([a, 1 / c, 1.0]), np.stack([da, -dc / c**2, 0 * da])
    length = np.linalg.norm(raw)
    u = raw / length
    du = (draw - np.outer(u, u @ draw)) / length
    point, dpoint = np.array([b, -d / c, 0.0]), np.stack([db, -dd / c + d * dc / c**2, 0 * da])
    return np.concatenate([e1, e2]) / root, np.concatenate([de1, de2]) / root, u, du, point, dpoint


def _regression(s, ds, v, dv):
    """Errors, slope and offset of the straight-line fit ``v = slope s + offset``, each with its derivative."""
    sc, dsc, vc, dvc = (w - w.mean(axis=0) for w in (s, ds, v, dv))
    total = sc @ sc
    slope = sc @ vc / total
    errors = vc - slope * sc
    dslope = (dsc.T @ errors + (dvc - slope * dsc).T @ sc) / total
    derrors = dvc - slope * dsc - np.outer(sc, dslope)
    offset = v.mean() - slope * s.mean()
    doffset = dv.mean(axis=0) - slope * ds.mean(axis=0) - dslope * s.mean()
    return errors, derrors, slope, dslope, offset, doffset
