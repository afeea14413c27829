"""Residuals of the joint estimate with analytic Jacobians, padded by placement.

Ranges by equations (4) to (6) and (17), edges by the likelihood of
:mod:`lrfcal_lib.fit.edge_likelihood`, poses in images by equation (16).
"""

import numpy as np

from lrfcal_lib.fit.axis_chart import PRIOR_FREEDOM, prior_terms
from lrfcal_lib.fit.edge_likelihood import beam_terms, edge_shift, flip_sigma
from lrfcal_lib.fit.least_squares import Block
from lrfcal_lib.fit.stops import ViewBlock, same_stop
from lrfcal_lib.model import geometry
from lrfcal_lib.model.geometry import cross, hat, tilt
from lrfcal_lib.solvers.joint_model import SENSOR, SWEEPS

# and how widely they may differ: at the rim of the spot the odds say nothing any more
USUAL = {
    "edge_log_odds": (0.0, 6.0),
    "edge_log_softness": (np.log(0.15), 1.0),
    "pitch_scale": (0.0, 0.05),
}
SIDE_FREEDOM = 3.0  # of Student's t: most backgrounds are alike, some are dark


def joint_blocks(state, data, unknowns):
    """All residuals of the joint estimate, a list of Block."""
    return list(named_blocks(state, data, unknowns).values())


def named_blocks(state, data, unknowns):
    """Residuals by name: face (metres), beam (likelihoods), view (radians and metres), sweep,
    side, `USUAL`, prior.
    """
    makers = {"face": face_block, "beam": beam_block, "view": view_block}
    blocks = {
        n: make(state, data, unknowns)
        for n, make in makers.items()
        if getattr(data, n)["used"].any()
    }
    if SWEEPS[unknowns.sweep]:
        blocks["sweep"] = sweep_block(state, data, unknowns)
    if unknowns.sides:
        blocks["side"] = side_block(state, data, unknowns)
    shown = set(unknowns.sensor) - (set() if "beam" in blocks else {"edge_log_odds"})
    blocks |= {name: usual_block(state, unknowns, name) for name in USUAL if name in shown}
    if data.prior is not None and unknowns.axis:
        blocks["prior"] = prior_block(state, data, unknowns)
    return blocks


def face_block(state, data, unknowns):
    """Predicted minus measured ranges to the board's plane, metres."""
    group = data.face
    ray = rays(state, data, group)
    o, d = ray[:2]
    normal = state.boards[:, None, :, 2]
    origin = state.boards[:, None, :, 3]
    along = np.vecdot(normal, d)[..., None]
    along = np.where(np.abs(along) < 1e-9, 1e-9, along)
    r = np.vecdot(normal, origin - o)[..., None] / along
    by_q = normal / along
    head, parts = ray_columns(-by_q, -r * by_q, ray)
    by_normal = (origin - o - r * d) / along
    board = np.concatenate(
        [cross(np.broadcast_to(normal, by_normal.shape), by_normal), by_q], axis=-1
    )
    J = assemble(unknowns, axis=head, parts=parts, board=board, range_offset=np.ones_like(r))
    residuals = r[..., 0] + state.sensor[0] - group["range"]
    sigma = np.where(group["used"], group["sigma"], 1.0) * data.face_scale
    return Block(residuals * group["used"], J, group["used"] * np.sqrt(data.face_share) / sigma)


def beam_block(state, data, unknowns):
    """Negative log likelihoods of beams near the edges."""
    group = data.beam
    ray = rays(state, data, group)
    u, by_o, by_d, by_t, a, t = edge_distance(state, data, group, ray)
    own = np.take_along_axis(state.sides, group["edge"], axis=1)
    shift, slope = edge_shift(state.sensor[1], group["radius"], group["background"] + own)
    radius = np.where(group["used"], group["radius"], 1.0)
    sigma, share_soft = flip_sigma(np.exp(state.sensor[2]), radius, group["step"])
    margin = shift - u
    cost, score, information = beam_terms(margin, sigma, group["hit"], data.lapse)
    head, parts = ray_columns(-by_o, -by_d, ray)
    board = np.concatenate([cross(t, -by_t) + cross(a, by_o), by_o], axis=-1)
    sides = slope[..., None] * (group["edge"][..., None] == np.arange(unknowns.edges))
    sensor = {
        "edge_log_odds": slope[..., None],
        "edge_log_softness": (-margin * share_soft)[..., None],
    }
    J = assemble(unknowns, axis=head, parts=parts, board=board, sides=sides, **sensor)
    share = data.beam_share * group["used"]
    root = np.sqrt(information)
    alive = root * sigma > 1e-7
    residuals = np.divide(score, root, out=np.zeros_like(score), where=alive)
    return Block(residuals, (root * alive)[..., None] * J, np.sqrt(share), cost=cost * share)


def view_block(state, data, unknowns):
    """Predicted against measured poses of the board in the cameras: rotation vectors and
    translations.
    """
    view = data.view
    on_head = data.on_head[data.view["camera"]]
    camera = state.cameras[view["camera"]]
    pose = view["pose"]
    moved = on_head[..., None, None]
    pitch, by_parts = true_pitch(state, data, np.where(on_head, view["pitch"], 0.0))
    pitch = np.where(on_head, pitch, 0.0)
    head = np.where(moved, state.head, np.eye(3, 4))
    board = np.broadcast_to(state.boards[:, None], pitch.shape + (3, 4))
    # T_camera_board = T_camera_lrf T_head_lrf^-1 Rx(-pitch) T_platform_board for a camera on the
    # head
    A = camera[..., :3] @ np.swapaxes(head[..., :3], -1, -2)
    B = A @ np.swapaxes(tilt(np.eye(3), -pitch[..., None]), -1, -2)
    y = tilt(board[..., 3], -pitch)
    t = (A @ (y - head[..., 3])[..., None])[..., 0] + camera[..., 3]
    w = geometry.log_rotation(B @ board[..., :3] @ np.swapaxes(pose[..., :3, :3], -1, -2))
    residuals = np.concatenate([w, t - pose[..., :3, 3]], axis=-1)
    left = inverse_left_jacobian(w)

    def by(columns, turn, shift):
        """Derivatives by turns and shifts of a pose from what they do to the board's turn and
        shift in the camera.
        """
        out = np.zeros(A.shape[:2] + (6, columns))
        out[..., :3, : turn.shape[-1]] = left @ turn
        out[..., 3:, columns - shift.shape[-1] :] = shift
        return out

    axis = (
        by(
            4,
            -A[..., 1:],
            np.concatenate([(A @ hat(y - head[..., 3]))[..., 1:], -A[..., 1:]], axis=-1),
        )
        * moved
    )
    turn = by(1, -A[..., :1], A @ hat(y)[..., :1]) * moved
    by_board = by(6, B, B)
    eye = np.broadcast_to(np.eye(3), A.shape)
    own = by(6, eye, np.concatenate([-hat(t - camera[..., 3]), eye], axis=-1))
    mine = view["camera"][..., None] == np.arange(unknowns.cameras)
    cameras = (own[..., None, :] * mine[:, :, None, :, None]).reshape(A.shape[:2] + (6, -1))
    J = assemble(
        unknowns, axis=axis, parts=turn * by_parts[..., None, :], board=by_board, cameras=cameras
    )
    p, v = pitch.shape
    return ViewBlock(
        residuals.reshape(p, 6 * v),
        J.reshape(p, 6 * v, -1),
        view["whitener"] / data.view_scale[view["camera"]][..., None, None],
        by_pitch=turn[..., 0],
        same=same_stop(view["pitch"], view["used"]),
        sigma_pitch=data.sigma_pitch,
    )


def sweep_block(state, data, unknowns):
    """What is expected of the sweeps' own errors of the pitch."""
    values = state.sweeps[:, : SWEEPS[unknowns.sweep]]
    whitener = np.broadcast_to(1 / np.array(data.sweep_sigma[: values.shape[1]]), values.shape)
    return Block(values, own_jacobian(unknowns, len(values), "sweep"), whitener)


def side_block(state, data, unknowns):
    """What is expected of the sides' deviations from the sensor's edge bias: Student's t, as a
    likelihood.
    """
    x = state.sides
    spread = SIDE_FREEDOM * data.side_sigma**2
    J = own_jacobian(unknowns, len(x), "sides")
    root = np.sqrt((SIDE_FREEDOM + 1) / (spread + x**2))
    cost = 0.5 * (SIDE_FREEDOM + 1) * np.log1p(x**2 / spread)
    return Block(root * x, root[..., None] * J, np.ones_like(x), cost=cost)


def prior_block(state, data, unknowns):
    """What is stated about the axis: Student's t, so that a wrong statement loses.

    Every placement holds a part.
    """
    r, J = prior_terms(state.head, data.prior)
    sigma = np.repeat([data.prior.sigma_direction, data.prior.sigma_offset], 2)
    square = np.sum((r / sigma) ** 2)
    p = len(state.boards)
    root = np.sqrt((PRIOR_FREEDOM + 4) / (PRIOR_FREEDOM + square) / p) / sigma
    jacobian = np.zeros((p, 4, unknowns.shared + unknowns.own))
    jacobian[..., :4] = root[:, None] * J
    cost = np.full((p, 4), 0.125 * (PRIOR_FREEDOM + 4) * np.log1p(square / PRIOR_FREEDOM) / p)
    return Block(np.tile(root * r, (p, 1)), jacobian, np.ones((p, 4)), cost=cost)


def usual_block(state, unknowns, name):
    """A weak expectation of one of `USUAL`, for data that do not show it.

    Every placement holds a part.
    """
    (usual, spread) = USUAL[name]
    value = state.sensor[SENSOR.index(name)]
    one = np.ones((len(state.boards), 1))
    scale = spread * np.sqrt(len(one))
    # where the floor of `flip_sigma` takes over, the beams' gradient by ln softness falls with the
    # softness squared:
    # without this curvature steps overshoot twofold
    bend = np.sqrt(1 + 2 * max(usual - value, 0.0)) if name == "edge_log_softness" else 1.0
    away = (value - usual) / scale
    J = own_jacobian(unknowns, len(one), name)
    return Block(away / bend * one, J * bend / scale, one, cost=0.5 * away**2 * one)


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


def rays(state, data, group):
    """Origins and directions (p, n, 3) of the beams of a group in the platform frame, pitch and
    its derivatives.
    """
    pitch, by_parts = true_pitch(state, data, group["pitch"])
    d_head = group["ray"] @ state.head[:, :3].T
    return tilt(state.head[:, 3], pitch), tilt(d_head, pitch), d_head, pitch, by_parts


def ray_columns(by_o, by_d, ray):
    """Columns of the axis (4), of the pitch's parts (4) from the gradients by origin and
    direction.
    """
    o, d, d_head, pitch, by_parts = ray
    (x, y, z), (_, y_o, z_o), (x_d, y_d, z_d) = (
        np.moveaxis(v, -1, 0) for v in (d_head, by_o, by_d)
    )
    c = np.cos(pitch)
    s = np.sin(pitch)
    back = c * y_d + s * z_d, c * z_d - s * y_d  # of by_d, in the head's frame
    # `AXIS_COLUMNS`
    head = [z * x_d - x * back[1], x * back[0] - y * x_d, c * y_o + s * z_o, c * z_o - s * y_o]
    turn = o[..., 1] * z_o - o[..., 2] * y_o + d[..., 1] * z_d - d[..., 2] * y_d
    return np.stack(head, axis=-1), turn[..., None] * by_parts


def edge_distance(state, data, group, ray):
    """Signed distance u (p, n) of rays from their edges, positive outside, and what it hangs on,
    (p, n, 3).

    The gradients by_o, by_d, by_t by origin, direction, and the edge's direction (that by the
    edge's point is ``-by_o``), then a, t: point (relative to the board's origin) and direction of
    the edge, platform frame.
    """
    o, d = ray[:2]
    normal = data.lines * [1.0, 1.0, 0.0]
    turn = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    # of every edge: a, t, its normal
    each = np.concatenate([-data.lines[:, 2:] * normal, normal @ turn, normal])
    each = (each @ np.swapaxes(state.boards[:, :, :3], -1, -2)).reshape(len(state.boards), 3, -1, 3)
    a, t, n = (
        part[np.arange(len(part))[:, None], group["edge"]] for part in np.moveaxis(each, 1, 0)
    )
    away = o - a - state.boards[:, None, :, 3]
    m = cross(d, t)
    length = np.sqrt(np.vecdot(m, m))[..., None]
    sign = np.where(np.vecdot(m, n) < 0, -1.0, 1.0)[..., None]
    c = sign * m / length
    u = np.vecdot(c, away)
    g = (away * sign - u[..., None] * m / length) / length
    return u, c, cross(t, g), cross(g, d), a, t


def inverse_left_jacobian(w):
    """How a small turn of a rotation changes its rotation vector, shape (..., 3) -> (..., 3, 3)."""
    angle = np.linalg.norm(w, axis=-1)[..., None, None]
    safe = np.maximum(angle, 1e-4)
    bend = np.where(angle > 1e-4, 1 / safe**2 - 1 / (2 * safe * np.tan(safe / 2)), 1 / 12)
    W = hat(w)
    return np.eye(3) - 0.5 * W + bend * (W @ W)


def assemble(unknowns, **derivatives):
    """Jacobian from derivatives (p, n, width) by the parts of :attr:`Unknowns.columns`; zeros by
    those not given.

    `parts` are those by the pitch: scale and offset by direction are shared, offset and stretch of
    the sweep its own.
    """
    parts = derivatives.pop("parts")
    derivatives |= {
        "pitch_scale": parts[..., :1],
        "pitch_by_direction": parts[..., 1:2],
        "sweep": parts[..., 2:],
    }
    J = np.zeros(parts.shape[:-1] + (unknowns.shared + unknowns.own,))
    for name, where in unknowns.columns.items():
        if name in derivatives:
            J[..., where] = derivatives[name][..., : where.stop - where.start]
    return J


def own_jacobian(unknowns, p, name):
    """Jacobian of unknowns that all p placements have (or share) by themselves."""
    rows = np.eye(unknowns.shared + unknowns.own)[unknowns.columns[name]]
    return np.broadcast_to(rows, (p, *rows.shape))
