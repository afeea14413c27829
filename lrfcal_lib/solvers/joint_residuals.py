"""Residuals of the joint estimate with analytic Jacobians, padded by placement.

Ranges by equations (4) to (6) and (17), edges by the likelihood of
:mod:`lrfcal_lib.fit.edge_likelihood`, poses in images by equation (16).
"""

from dataclasses import dataclass
from functools import cached_property
from types import EllipsisType
from typing import NamedTuple

import numpy as np

from lrfcal_lib.fit.axis_chart import AXIS_COLUMNS, PRIOR_FREEDOM, prior_terms
from lrfcal_lib.fit.edge_likelihood import beam_terms, edge_shift, flip_sigma
from lrfcal_lib.fit.least_squares import Block, Minimum, minimise
from lrfcal_lib.fit.padding import among
from lrfcal_lib.model.geometry import (
    cross,
    gradient_by_pose,
    hat,
    log_rotation,
    tilt,
)
from lrfcal_lib.solvers.joint_model import (
    SENSOR,
    SWEEPS,
    JointData,
    JointState,
    Unknowns,
)

# what is usual of the sensor, and by how much it may differ: at the rim of the spot the odds say
# nothing any more
USUAL = {
    "edge_log_odds": (0.0, 6.0),
    "edge_log_softness": (np.log(0.15), 1.0),
    "pitch_scale": (0.0, 0.05),
}
SIDE_FREEDOM = 3.0  # of Student's t: most backgrounds are alike, some are dark
GRAZING = 1e-9  # cosine of the incidence below which a beam is taken not to be parallel to a board
# root information of a beam, beside that at its edge: below, it says nothing
LEAST_ROOT = 1e-7
ROUGH_STEP = 1e-2  # standard deviations: a shorter step ends a round
MOST_STEPS = 300
SAME_STOP = np.radians(
    0.001
)  # of recorded pitch angles: platforms record steps of 0.01 deg or so


def named_blocks(
    state: JointState, data: JointData, unknowns: Unknowns
) -> dict[str, Block]:
    """Residuals by name: face (metres), beam (likelihoods), view (radians and metres), sweep,
    side, `USUAL`, prior.
    """
    blocks = {}
    of_groups = {"face": face_block, "beam": beam_block, "view": view_block}
    for name, block_of in of_groups.items():
        if getattr(data, name)["used"].any():
            blocks[name] = block_of(state, data, unknowns)
    if SWEEPS[unknowns.sweep]:
        blocks["sweep"] = sweep_block(state, data, unknowns)
    if unknowns.sides:
        blocks["side"] = side_block(state, data, unknowns)
    for name in USUAL:
        if name in unknowns.sensor and (name != "edge_log_odds" or "beam" in blocks):
            blocks[name] = usual_block(state, unknowns, name)
    if data.levels.prior is not None and unknowns.axis:
        blocks["prior"] = prior_block(state, data, unknowns)
    return blocks


def minimum(
    state: JointState,
    data: JointData,
    unknowns: Unknowns,
    tolerance: float = ROUGH_STEP,
    steps: int = MOST_STEPS,
) -> Minimum:
    """The state nearby that explains the data best."""
    return minimise(
        lambda at: named_blocks(at, data, unknowns).values(),
        state,
        unknowns.move,
        shared=unknowns.shared,
        max_iterations=steps,
        tolerance=tolerance,
    )


def true_pitch(state, data, pitch):
    """Corrected pitch (p, n) and its derivatives by (scale, direction, offset, stretch), (p, n,
    4).
    """
    away = pitch - data.middle[:, None]
    columns = np.broadcast_arrays(pitch, data.direction[:, None], 1.0, away)
    by_parts = np.stack(columns, axis=-1)
    parts = np.insert(state.sweeps, [0, 0], state.sensor[3:], axis=1)
    return pitch + np.matvec(by_parts, parts), by_parts


class Rays(NamedTuple):
    """Beams of a group.

    Origins and directions (p, n, 3) in the platform frame, true pitch (p, n) and its derivatives
    (p, n, 4), see :func:`true_pitch`.
    """

    origin: np.ndarray
    direction: np.ndarray
    pitch: np.ndarray
    by_parts: np.ndarray


def rays(state, data, group):
    """The Rays of a group."""
    pitch, by_parts = true_pitch(state, data, group["pitch"])
    origin = tilt(state.head[:, 3], pitch)
    direction = tilt(group["ray"] @ state.head[:, :3].T, pitch)
    return Rays(origin, direction, pitch, by_parts)


def ray_columns(gradient, reach, ray):
    """Columns of the axis (4), of the pitch's parts (4) from the gradients (p, n, 3) by the points
    of rays at a reach (p, n, 1).
    """
    lever = reach * ray.direction
    in_head = tilt(np.stack([lever, gradient]), -ray.pitch)
    head = gradient_by_pose(*in_head)[..., AXIS_COLUMNS]
    turn = cross(ray.origin + lever, gradient)[..., :1]  # about the tilt axis
    return head, turn * ray.by_parts


def assemble(unknowns, parts, **derivatives):
    """Jacobian from derivatives (p, n, width) by the parts of :attr:`Unknowns.columns`; zeros by
    those not given.

    `parts` are those by the pitch: scale and offset by direction are shared, offset and stretch of
    the sweep its own.
    """
    derivatives |= {
        "pitch_scale": parts[..., :1],
        "pitch_by_direction": parts[..., 1:2],
        "sweep": parts[..., 2:],
    }
    J = np.zeros(parts.shape[:-1] + (unknowns.size,))
    for name, derivative in derivatives.items():
        where = unknowns.columns[name]
        J[..., where] = derivative[..., : where.stop - where.start]
    return J


class Meeting(NamedTuple):
    """Where rays meet the planes of their boards.

    Ranges (p, n, 1), their gradients by the board's origin (p, n, 3), points relative to that
    origin, platform frame (p, n, 3).
    """

    range: np.ndarray
    by_board: np.ndarray
    point: np.ndarray


def meeting(state, ray):
    """The Meeting of rays."""
    normal = state.boards[:, None, :, 2]
    away = state.boards[:, None, :, 3] - ray.origin
    along = np.vecdot(normal, ray.direction)[..., None]
    by_board = normal / np.where(np.abs(along) < GRAZING, GRAZING, along)
    r = np.vecdot(by_board, away)[..., None]
    return Meeting(r, by_board, r * ray.direction - away)


def face_block(state, data, unknowns):
    """Predicted minus measured ranges to the board's plane, metres."""
    group = data.face
    ray = rays(state, data, group)
    r, by_board, point = meeting(state, ray)
    head, parts = ray_columns(-by_board, r, ray)
    board = gradient_by_pose(point, by_board)
    J = assemble(unknowns, parts, axis=head, board=board, range_offset=np.ones_like(r))
    residuals = r[..., 0] + state.sensor[0] - group["range"]
    root = np.sqrt(data.levels.face_share) / data.levels.face_scale
    return Block(residuals, J, root * group["weight"])


def face_heights(
    state: JointState,
    data: JointData,
    boards: np.ndarray,
    rows: np.ndarray | EllipsisType = ...,
) -> np.ndarray:
    """Of the measured face points over boards (v, 3, 4) of placements, metres, shape (v, n)."""
    ray = rays(state, data, data.face)
    reach = data.face["range"] - state.sensor[0]
    points = ray.origin + reach[..., None] * ray.direction
    return np.vecdot(points[rows] - boards[:, None, :, 3], boards[:, None, :, 2])


class EdgeDistance(NamedTuple):
    """Signed distance (p, n) of rays from their edges, positive outside, and what it hangs on.

    Its gradient (p, n, 3) by the ray, a unit vector across both lines; where they are nearest, on
    the ray by the reach (p, n, 1), on the edge as a point relative to the board's origin; direction
    of the edge, platform frame.
    """

    distance: np.ndarray
    across: np.ndarray
    reach: np.ndarray
    nearest: np.ndarray
    along: np.ndarray


def edge_distance(state, data, group, ray):
    """The EdgeDistance of the beams of a group."""
    lines = data.lines[group["edge"]]
    outwards = lines[..., :2] @ state.boards[..., :2].mT
    along = cross(state.boards[:, None, :, 2], outwards)
    origin = ray.origin - state.boards[:, None, :, 3]
    away = origin + lines[..., 2:] * outwards
    m = cross(ray.direction, along)
    square = np.vecdot(m, m)[..., None]
    sign = np.copysign(1.0, np.vecdot(m, outwards))[..., None]
    across = sign * m / np.sqrt(square)
    distance = np.vecdot(across, away)
    reach = np.vecdot(cross(along, away), m)[..., None] / square
    nearest = origin + reach * ray.direction - distance[..., None] * across
    return EdgeDistance(distance, across, reach, nearest, along)


def beam_block(state, data, unknowns):
    """Negative log likelihoods of beams near the edges."""
    group = data.beam
    ray = rays(state, data, group)
    edge = edge_distance(state, data, group, ray)
    of_side = np.take_along_axis(state.sides, group["edge"], axis=1) + state.sides[:, -1:]
    odds = group["background"] + of_side
    shift, slope = edge_shift(state.sensor[1], group["radius"], odds)
    radius = np.where(group["used"], group["radius"], 1.0)
    sigma, share_soft = flip_sigma(np.exp(state.sensor[2]), radius, group["step"])
    margin = shift - edge.distance
    lapse = data.levels.lapse
    cost, score, information = beam_terms(margin, sigma, group["hit"], lapse)
    head, parts = ray_columns(-edge.across, edge.reach, ray)
    J = assemble(
        unknowns,
        parts,
        axis=head,
        board=gradient_by_pose(edge.nearest, edge.across),
        sides=slope[..., None] * sides_of_beams(data, unknowns.edges),
        edge_log_odds=slope[..., None],
        edge_log_softness=(-margin * share_soft)[..., None],
    )
    share = data.levels.beam_share * group["used"]
    root = np.sqrt(information)
    alive = root * sigma > LEAST_ROOT
    residuals = np.divide(score, root, out=np.zeros_like(score), where=alive)
    return Block(
        residuals, (root * alive)[..., None] * J, np.sqrt(share), cost=cost * share
    )


def sides_of_beams(data, edges):
    """Which of the deviations of a placement from the sensor's edge bias beams see, (p, n, e + 1):
    that of their side, and what all have in common.
    """
    mine = data.beam["edge"][..., None] == np.arange(edges + 1)
    mine[..., -1] = True
    return mine


def view_block(state, data, unknowns):
    """Predicted against measured poses of the board in the cameras: rotation vectors and
    translations.
    """
    view = data.view
    pose = view["pose"]
    camera = state.cameras[view["camera"]]
    on_head = data.on_head[view["camera"]]
    moved = on_head[..., None, None]
    pitch, by_parts = true_pitch(state, data, view["pitch"])
    pitch = pitch * on_head
    head = np.where(moved, state.head, np.eye(3, 4))
    board = state.boards[:, None]
    # T_camera_board = T_camera_lrf T_head_lrf^-1 Rx(-pitch) T_platform_board for a camera on the
    # head
    R_camera_head = camera[..., :3] @ head[..., :3].mT
    R_camera_platform = tilt(R_camera_head, pitch[..., None])  # row by row
    origin = tilt(board[..., 3], -pitch)  # of the board, in the head frame
    from_lrf = origin - head[..., 3]
    arm = np.matvec(R_camera_head, from_lrf)
    w = log_rotation(R_camera_platform @ board[..., :3] @ pose[..., :3, :3].mT)
    residuals = np.concatenate([w, arm + camera[..., 3] - pose[..., :3, 3]], axis=-1)

    left = inverse_left_jacobian(w)
    turned = left @ -R_camera_head
    lever = R_camera_head @ hat(from_lrf)
    of_head = _by_pose(turned, lever, -R_camera_head) * moved
    by_pitch = _by_pose(turned, R_camera_head @ hat(origin), 0.0)[..., :1] * moved
    of_camera = _by_pose(left, -hat(arm), np.eye(3))
    J = assemble(
        unknowns,
        by_pitch * by_parts[..., None, :],
        axis=of_head[..., AXIS_COLUMNS],
        board=_by_pose(left @ R_camera_platform, 0.0, R_camera_platform),
        cameras=among(of_camera, view["camera"][..., None], unknowns.cameras),
    )
    return ViewBlock.of_groups(
        residuals,
        J,
        view["whitener"] / data.levels.view_scale,
        by_pitch=by_pitch[..., 0],
        same=same_stop(view["pitch"], view["used"]),
        sigma_pitch=data.levels.sigma_pitch,
    )


def same_stop(pitch: np.ndarray, used: np.ndarray) -> np.ndarray:
    """Which images of a placement were taken at one stop.

    Parameters
    ----------
    pitch : ndarray, shape (p, v)
        Recorded, radians.
    used : ndarray of bool, shape (p, v)

    Returns
    -------
    ndarray of bool, shape (p, v, v)
    """
    stop = np.where(used, np.rint(pitch / SAME_STOP), np.nan)  # which is like no other
    return stop[:, :, None] == stop[:, None, :]


@dataclass(frozen=True)
class ViewBlock(Block):
    """Board poses in images (p, 6 v), and the error of the pitch that the images of a stop share.

    The covariance of whitened views of a stop is ``I + sigma^2 g g^T``, of which ``I - h h^T`` with
    h along g is the inverse root: no matrix larger than that of one view is needed.

    Attributes
    ----------
    by_pitch : ndarray, shape (p, v, 6)
        Derivative of the residuals by the pitch of the image; zeros for cameras on the base.
    same : ndarray of bool, shape (p, v, v)
        See :func:`same_stop`.
    sigma_pitch : float
        Standard deviation of the pitch at a stop, radians.
    """

    by_pitch: np.ndarray = None
    same: np.ndarray = None
    sigma_pitch: float = 0.0

    @cached_property
    def white_by_pitch(self):
        """The vectors g (p, v, 6), and the square of the whole one of a view's stop (p, v)."""
        g = np.matvec(self.whitener, self.by_pitch)
        return g, np.matvec(self.same, np.vecdot(g, g))

    def whitened(self, rows):
        """Rows (p, 6 v, k) in independent standard deviations."""
        white = super().whitened(rows)
        if self.sigma_pitch == 0:
            return white
        g, square = self.white_by_pitch
        gain = 1 - 1 / np.sqrt(1 + self.sigma_pitch**2 * square)
        h = np.sqrt(gain / np.maximum(square, 1e-300))[..., None, None] * g[..., None]
        views = white.reshape(*h.shape[:-1], -1)
        common = self.same @ np.sum(h * views, axis=2)
        return (views - h * common[:, :, None]).reshape(white.shape)

    @property
    def log_determinant(self):
        """Of the covariance of whitened views: what the pitch of the stops adds to it."""
        _, square = self.white_by_pitch
        number = np.maximum(self.same.sum(axis=-1), 1)  # every stop counts once
        return np.sum(np.log1p(self.sigma_pitch**2 * square) / number)


def _by_pose(turn_by_turn, shift_by_turn, shift_by_shift):
    """Derivatives (..., 6, 6) of ``[w, v]`` by that of another pose; no shift turns."""
    by_pose = np.zeros(turn_by_turn.shape[:-2] + (6, 6))
    by_pose[..., :3, :3] = turn_by_turn
    by_pose[..., 3:, :3] = shift_by_turn
    by_pose[..., 3:, 3:] = shift_by_shift
    return by_pose


def inverse_left_jacobian(w):
    """How a small turn of a rotation changes its rotation vector, shape (..., 3) -> (..., 3, 3).

    Up to the fifth power of the angle: what is left out is 6e-8 at 20 degrees.
    """
    square = np.vecdot(w, w)[..., None, None]
    W = hat(w)
    return np.eye(3) - 0.5 * W + (1 / 12 + square / 720) * (W @ W)


def own_jacobian(unknowns, name):
    """Jacobian (n, k) of unknowns that every placement has (or shares) by themselves."""
    return np.eye(unknowns.size)[unknowns.columns[name]]


def sweep_block(state, data, unknowns):
    """What is expected of the sweeps' own errors of the pitch."""
    number = SWEEPS[unknowns.sweep]
    values = state.sweeps[:, :number]
    whitener = np.reciprocal(data.levels.sweep_sigma[:number])
    J = own_jacobian(unknowns, "sweep")
    return Block(values, J, np.broadcast_to(whitener, values.shape))


def side_block(state, data, unknowns):
    """What is expected of the deviations from the sensor's edge bias, of sides and of what those
    of a placement have in common: Student's t, as a likelihood.
    """
    x = state.sides
    spread = SIDE_FREEDOM * data.levels.of_sides(unknowns.edges) ** 2
    J = own_jacobian(unknowns, "sides")
    root = np.sqrt((SIDE_FREEDOM + 1) / (spread + x**2))
    cost = 0.5 * (SIDE_FREEDOM + 1) * np.log1p(x**2 / spread)
    return Block(x, J, root, cost=cost)


def prior_block(state, data, unknowns):
    """What is stated about the axis: Student's t, so that a wrong statement loses.

    Every placement holds a part.
    """
    prior = data.levels.prior
    r, J = prior_terms(state.head, prior)
    sigma = np.repeat([prior.sigma_direction, prior.sigma_offset], 2)
    square = np.sum((r / sigma) ** 2)
    p = len(state.boards)
    root = np.sqrt((PRIOR_FREEDOM + 4) / (PRIOR_FREEDOM + square) / p) / sigma
    cost = 0.125 * (PRIOR_FREEDOM + 4) * np.log1p(square / PRIOR_FREEDOM) / p
    return Block(
        r[None],
        J @ own_jacobian(unknowns, "axis"),
        np.tile(root, (p, 1)),
        cost=np.full((p, 4), cost),
    )


def usual_block(state, unknowns, name):
    """A weak expectation of one of `USUAL`, for data that do not show it.

    Every placement holds a part.
    """
    usual, spread = USUAL[name]
    away = state.sensor[None, [SENSOR.index(name)]] - usual
    bend = np.ones_like(away)
    if name == "edge_log_softness":
        # where the floor of `flip_sigma` takes over, the beams' gradient by ln softness falls with
        # the softness squared: without this curvature steps overshoot twofold
        bend = np.sqrt(1 + 2 * np.maximum(-away, 0.0))
    p = len(state.boards)
    root = np.repeat(bend / (spread * np.sqrt(p)), p, axis=0)
    J = own_jacobian(unknowns, name)
    return Block(away / bend**2, J, root, cost=0.5 * (root / bend * away) ** 2)
