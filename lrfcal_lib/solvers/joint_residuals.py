"""Residuals of the joint estimate with analytic Jacobians, padded by placement.

Ranges by equations (4) to (6) and (17), edges by the likelihood of
:mod:`lrfcal_lib.fit.edge_likelihood`, poses in images by equation (16).
"""

from typing import NamedTuple

import numpy as np

from lrfcal_lib.fit.axis_chart import AXIS_COLUMNS, PRIOR_FREEDOM, prior_terms
from lrfcal_lib.fit.edge_likelihood import beam_terms, edge_shift, flip_sigma
from lrfcal_lib.fit.least_squares import Block, Minimum, minimise
from lrfcal_lib.fit.stops import ViewBlock, same_stop
from lrfcal_lib.model import geometry
from lrfcal_lib.model.geometry import cross, hat, tilt
from lrfcal_lib.solvers.joint_model import (
    SENSOR,
    SWEEPS,
    JointData,
    JointState,
    Unknowns,
    move_state,
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
SMALL_TURN = 1e-4  # radians; below, the series of the rotation vector's derivative is exact


def named_blocks(
    state: JointState, data: JointData, unknowns: Unknowns
) -> dict[str, Block]:
    """Residuals by name: face (metres), beam (likelihoods), view (radians and metres), sweep,
    side, `USUAL`, prior.
    """
    blocks = {}
    if data.face["used"].any():
        blocks["face"] = face_block(state, data, unknowns)
    if data.beam["used"].any():
        blocks["beam"] = beam_block(state, data, unknowns)
    if data.view["used"].any():
        blocks["view"] = view_block(state, data, unknowns)
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
        lambda at, step: move_state(at, step, unknowns),
        shared=unknowns.shared,
        max_iterations=steps,
        tolerance=tolerance,
    )


def true_pitch(state, data, pitch):
    """Corrected pitch (p, n) and its derivatives by (scale, direction, offset, stretch), (p, n,
    4).
    """
    scale, by_direction = state.sensor[3:5]
    offset = state.sweeps[:, :1]
    stretch = state.sweeps[:, 1:]
    away = pitch - data.middle[:, None]
    turn = np.broadcast_to(data.direction[:, None], pitch.shape)
    corrected = pitch * (1 + scale) + by_direction * turn + offset + stretch * away
    return corrected, np.stack([pitch, turn, np.ones_like(pitch), away], axis=-1)


class Rays(NamedTuple):
    """Beams of a group.

    Origins and directions (p, n, 3) in the platform frame, directions in the head frame, true pitch
    (p, n) and its derivatives (p, n, 4), see :func:`true_pitch`.
    """

    origin: np.ndarray
    direction: np.ndarray
    in_head: np.ndarray
    pitch: np.ndarray
    by_parts: np.ndarray


def rays(state, data, group):
    """The Rays of a group."""
    pitch, by_parts = true_pitch(state, data, group["pitch"])
    in_head = group["ray"] @ state.head[:, :3].T
    origin = np.broadcast_to(state.head[:, 3], in_head.shape)
    return Rays(*tilt(np.stack([origin, in_head]), pitch), in_head, pitch, by_parts)


def ray_columns(by_o, by_d, ray):
    """Columns of the axis (4), of the pitch's parts (4) from the gradients by origin and
    direction.
    """
    shift, push = tilt(np.stack([by_o, by_d]), -ray.pitch)  # in the head's frame
    turned = cross(ray.in_head, push)
    # as in `AXIS_COLUMNS`: turns about y and z, shifts along y and z
    head = np.concatenate([turned[..., 1:], shift[..., 1:]], axis=-1)
    _, y, z = np.moveaxis(ray.origin, -1, 0)
    turn = y * by_o[..., 2] - z * by_o[..., 1] + turned[..., 0]
    return head, turn[..., None] * ray.by_parts


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
    J = np.zeros(parts.shape[:-1] + (unknowns.shared + unknowns.own,))
    for name, derivative in derivatives.items():
        where = unknowns.columns[name]
        J[..., where] = derivative[..., : where.stop - where.start]
    return J


def face_block(state, data, unknowns):
    """Predicted minus measured ranges to the board's plane, metres."""
    group = data.face
    ray = rays(state, data, group)
    normal = state.boards[:, None, :, 2]
    away = state.boards[:, None, :, 3] - ray.origin
    along = np.vecdot(normal, ray.direction)[..., None]
    along = np.where(np.abs(along) < GRAZING, GRAZING, along)
    r = np.vecdot(normal, away)[..., None] / along
    by_point = normal / along
    by_normal = (away - r * ray.direction) / along
    head, parts = ray_columns(-by_point, -r * by_point, ray)
    by_turn = cross(np.broadcast_to(normal, by_normal.shape), by_normal)
    board = np.concatenate([by_turn, by_point], axis=-1)
    J = assemble(unknowns, parts, axis=head, board=board, range_offset=np.ones_like(r))
    residuals = r[..., 0] + state.sensor[0] - group["range"]
    sigma = np.where(group["used"], group["sigma"], 1.0) * data.levels.face_scale
    weight = group["used"] * np.sqrt(data.levels.face_share)
    return Block(residuals * group["used"], J, weight / sigma)


class EdgeDistance(NamedTuple):
    """Signed distance (p, n) of rays from their edges, positive outside, and what it hangs on.

    Gradients (p, n, 3) by the ray's origin and direction and by the edge's direction (that by the
    edge's point is ``-by_origin``); point (relative to the board's origin) and direction of the
    edge, platform frame.
    """

    distance: np.ndarray
    by_origin: np.ndarray
    by_direction: np.ndarray
    by_edge: np.ndarray
    point: np.ndarray
    along: np.ndarray


def edge_distance(state, data, group, ray):
    """The EdgeDistance of the beams of a group."""
    normal = data.lines * [1.0, 1.0, 0.0]
    # of every edge: its point, its direction, its normal
    along = cross([0.0, 0.0, 1.0], normal)
    each = np.stack([-data.lines[:, 2:] * normal, along, normal])
    each = each @ state.boards[:, None, :, :3].mT
    point, along, outwards = (
        part[np.arange(len(part))[:, None], group["edge"]]
        for part in np.moveaxis(each, 1, 0)
    )
    away = ray.origin - point - state.boards[:, None, :, 3]
    m = cross(ray.direction, along)
    length = np.sqrt(np.vecdot(m, m))[..., None]
    sign = np.where(np.vecdot(m, outwards) < 0, -1.0, 1.0)[..., None]
    across = sign * m / length
    distance = np.vecdot(across, away)
    g = (away * sign - distance[..., None] * m / length) / length
    by_direction = cross(along, g)
    return EdgeDistance(
        distance, across, by_direction, cross(g, ray.direction), point, along
    )


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
    head, parts = ray_columns(-edge.by_origin, -edge.by_direction, ray)
    by_turn = cross(edge.along, -edge.by_edge) + cross(edge.point, edge.by_origin)
    mine = group["edge"][..., None] == np.arange(unknowns.edges + 1)
    mine[..., -1] = True
    J = assemble(
        unknowns,
        parts,
        axis=head,
        board=np.concatenate([by_turn, edge.by_origin], axis=-1),
        sides=slope[..., None] * mine,
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


def view_block(state, data, unknowns):
    """Predicted against measured poses of the board in the cameras: rotation vectors and
    translations.
    """
    view = data.view
    pose = view["pose"]
    camera = state.cameras[view["camera"]]
    on_head = data.on_head[view["camera"]]
    moved = on_head[..., None, None]
    pitch, by_parts = true_pitch(state, data, np.where(on_head, view["pitch"], 0.0))
    pitch = np.where(on_head, pitch, 0.0)
    head = np.where(moved, state.head, np.eye(3, 4))
    board = np.broadcast_to(state.boards[:, None], pitch.shape + (3, 4))
    # T_camera_board = T_camera_lrf T_head_lrf^-1 Rx(-pitch) T_platform_board for a camera on the
    # head
    R_camera_head = camera[..., :3] @ head[..., :3].mT
    R_head_platform = tilt(np.eye(3), -pitch[..., None]).mT
    R_camera_platform = R_camera_head @ R_head_platform
    origin = tilt(board[..., 3], -pitch)  # of the board, in the head frame
    arm = np.matvec(R_camera_head, origin - head[..., 3])
    w = geometry.log_rotation(R_camera_platform @ board[..., :3] @ pose[..., :3, :3].mT)
    residuals = np.concatenate([w, arm + camera[..., 3] - pose[..., :3, 3]], axis=-1)

    left = inverse_left_jacobian(w)
    turned = left @ -R_camera_head
    lever = R_camera_head @ hat(origin - head[..., 3])
    of_head = _by_pose(turned, lever, -R_camera_head) * moved
    by_pitch = _by_pose(turned, R_camera_head @ hat(origin), 0.0)[..., :1] * moved
    of_camera = _by_pose(left, -hat(arm), np.eye(3))
    J = assemble(
        unknowns,
        by_pitch * by_parts[..., None, :],
        axis=of_head[..., AXIS_COLUMNS],
        board=_by_pose(left @ R_camera_platform, 0.0, R_camera_platform),
        cameras=among_cameras(of_camera, view["camera"], unknowns.cameras),
    )
    p, v = pitch.shape
    return ViewBlock(
        residuals.reshape(p, 6 * v),
        J.reshape(p, 6 * v, -1),
        view["whitener"] / data.levels.view_scale,
        by_pitch=by_pitch[..., 0],
        same=same_stop(view["pitch"], view["used"]),
        sigma_pitch=data.levels.sigma_pitch,
    )


def _by_pose(turn_by_turn, shift_by_turn, shift_by_shift):
    """Derivatives (..., 6, 6) of ``[w, v]`` by that of another pose; no shift turns."""
    by_pose = np.zeros(turn_by_turn.shape[:-2] + (6, 6))
    by_pose[..., :3, :3] = turn_by_turn
    by_pose[..., 3:, :3] = shift_by_turn
    by_pose[..., 3:, 3:] = shift_by_shift
    return by_pose


def among_cameras(by_one, camera, count):
    """Derivatives (p, v, 6, k) by what is a view's camera's, among those of all, (p, v, 6, k c)."""
    mine = camera[..., None] == np.arange(count)
    among_all = by_one[..., None, :] * mine[:, :, None, :, None]
    return among_all.reshape(*by_one.shape[:-1], -1)


def inverse_left_jacobian(w):
    """How a small turn of a rotation changes its rotation vector, shape (..., 3) -> (..., 3, 3)."""
    angle = np.linalg.norm(w, axis=-1)[..., None, None]
    safe = np.maximum(angle, SMALL_TURN)
    bend = 1 / safe**2 - 1 / (2 * safe * np.tan(safe / 2))
    bend = np.where(angle > SMALL_TURN, bend, 1 / 12)
    W = hat(w)
    return np.eye(3) - 0.5 * W + bend * (W @ W)


def own_jacobian(unknowns, p, name):
    """Jacobian of unknowns that all p placements have (or share) by themselves."""
    rows = np.eye(unknowns.shared + unknowns.own)[unknowns.columns[name]]
    return np.broadcast_to(rows, (p, *rows.shape))


def sweep_block(state, data, unknowns):
    """What is expected of the sweeps' own errors of the pitch."""
    number = SWEEPS[unknowns.sweep]
    values = state.sweeps[:, :number]
    whitener = 1 / np.array(data.levels.sweep_sigma[:number])
    J = own_jacobian(unknowns, len(values), "sweep")
    return Block(values, J, np.broadcast_to(whitener, values.shape))


def side_block(state, data, unknowns):
    """What is expected of the deviations from the sensor's edge bias, of sides and of what those
    of a placement have in common: Student's t, as a likelihood.
    """
    x = state.sides
    spread = SIDE_FREEDOM * data.levels.of_sides(unknowns.edges) ** 2
    J = own_jacobian(unknowns, len(x), "sides")
    root = np.sqrt((SIDE_FREEDOM + 1) / (spread + x**2))
    cost = 0.5 * (SIDE_FREEDOM + 1) * np.log1p(x**2 / spread)
    return Block(root * x, root[..., None] * J, np.ones_like(x), cost=cost)


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
    jacobian = root[:, None] * J @ own_jacobian(unknowns, p, "axis")
    cost = 0.125 * (PRIOR_FREEDOM + 4) * np.log1p(square / PRIOR_FREEDOM) / p
    return Block(
        np.tile(root * r, (p, 1)), jacobian, np.ones((p, 4)), cost=np.full((p, 4), cost)
    )


def usual_block(state, unknowns, name):
    """A weak expectation of one of `USUAL`, for data that do not show it.

    Every placement holds a part.
    """
    usual, spread = USUAL[name]
    value = state.sensor[SENSOR.index(name)]
    one = np.ones((len(state.boards), 1))
    scale = spread * np.sqrt(len(one))
    away = (value - usual) / scale
    bend = 1.0
    if name == "edge_log_softness":
        # where the floor of `flip_sigma` takes over, the beams' gradient by ln softness falls with
        # the softness squared: without this curvature steps overshoot twofold
        bend = np.sqrt(1 + 2 * max(usual - value, 0.0))
    J = own_jacobian(unknowns, len(one), name)
    return Block(away / bend * one, J * bend / scale, one, cost=0.5 * away**2 * one)
