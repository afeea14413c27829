"""Residuals with analytic Jacobians: beams about edges, lines of sight, planes, views, priors.

Padded by placement.
"""

from dataclasses import MISSING, dataclass, fields, replace
from functools import cached_property

import numpy as np
from scipy.special import log_ndtr

from lrfcal_lib.fit.least_squares import Block
from lrfcal_lib.fit.result import AXIS_NAMES, PlatformPrior
from lrfcal_lib.fit.stops import ViewBlock, same_stop
from lrfcal_lib.model import geometry
from lrfcal_lib.model.camera import CameraModel, line_distance, line_through, project, undistort
from lrfcal_lib.model.geometry import (
    cross,
    gradient_by_pose,
    hat,
    move_pose,
    moved_noise,
    noise_correction,
    pose_transform,
    rotate_points,
    tilt,
)


def line_residuals(moved: np.ndarray, lines: np.ndarray, camera: CameraModel) -> np.ndarray:
    """Signed distances of projected points from image lines, equations (19) and (20).

    Behind the camera the formula goes on (mirrored), so that a poor start value can still find its
    way.

    Parameters
    ----------
    moved : ndarray, shape (..., n, 3)
        Points in the camera frame, equation (16), metres.
    lines : ndarray, shape (..., n, 3)
        ``(a, b, c)`` with ``a^2 + b^2 = 1``, undistorted pixels.
    camera : CameraModel

    Returns
    -------
    ndarray, shape (..., n)
        Undistorted pixels; the sign is that of the line.
    """
    u = camera.fx * moved[..., 0] / moved[..., 2] + camera.cx  # (19)
    v = camera.fy * moved[..., 1] / moved[..., 2] + camera.cy
    return lines[..., 0] * u + lines[..., 1] * v + lines[..., 2]  # (20)


def line_gradients(moved: np.ndarray, lines: np.ndarray, camera: CameraModel) -> np.ndarray:
    """Derivatives (..., n, 3) of :func:`line_residuals` by the moved points, pixels a metre."""
    by_x = lines[..., 0] * camera.fx / moved[..., 2]
    by_y = lines[..., 1] * camera.fy / moved[..., 2]
    by_z = -(by_x * moved[..., 0] + by_y * moved[..., 1]) / moved[..., 2]
    return np.stack([by_x, by_y, by_z], axis=-1)


def line_block(pose: np.ndarray, obs) -> Block:
    """Distances d(e, ab) of projected crossings from their image lines: :func:`line_residuals` as a
    Block.

    The whitener holds the crossing's covariance, projected, and the line's; `corrected` is the
    Jacobian without what errors of the crossings put into it
    (:func:`lrfcal_lib.model.geometry.noise_correction`).

    Parameters
    ----------
    pose : ndarray, shape (..., 3, 4)
        ``T_camera_source``.
    obs : CameraObservations
    """
    rotated = rotate_points(pose, obs.crossing_points)
    moved = rotated + pose[..., None, :, 3]  # (16)
    residuals = line_residuals(moved, obs.crossing_lines, obs.model)
    gradients = line_gradients(moved, obs.crossing_lines, obs.model)
    jacobian = gradient_by_pose(rotated, gradients)
    noise = moved_noise(pose, gradients, obs.crossing_covariance)
    variance = np.vecdot(gradients, noise) + obs.crossing_line_sigma**2
    correction = noise_correction(rotated, moved, gradients, noise, residuals / variance)
    return Block(residuals, jacobian, 1 / np.sqrt(variance), corrected=jacobian - correction)


def read_pose(pose):
    """Transform and parameters of a pose state."""
    return geometry.pose_transform(pose, proper=True), geometry.pose_parameters(pose)


def edge_residuals_px(obs, transform, model=None):
    """Signed distances of the projected crossings from their image lines, equation (20).

    Parameters
    ----------
    obs : CameraObservations
    transform : RigidTransform
        ``T_camera_source``.
    model : CameraModel, optional
        Other intrinsics than ``obs.model``: the image lines are then moved there (two points of
        each are distorted with the old model and undistorted with the new one).

    Returns
    -------
    ndarray, shape (n,)
        Undistorted pixels; positive outside the board.
    """
    if model is not None and len(obs.crossing_points):
        lines = obs.crossing_lines
        to_rays = np.linalg.inv(obs.model.matrix).T
        q = transform.apply(obs.crossing_points) @ obs.model.matrix.T
        uv = q[:, :2] / q[:, 2:]
        foot = uv - line_distance(uv, lines)[:, None] * lines[:, :2]
        along = lines[:, [1, 0]] * [10.0, -10.0]
        rays = (
            np.column_stack([foot + side * along, np.ones(len(foot))]) @ to_rays for side in (-1, 1)
        )
        moved = line_through(*(undistort(project(ray, obs.model), model) for ray in rays))
        moved *= np.sign(np.sum(moved[:, :2] * lines[:, :2], axis=1))[:, None]
        obs = replace(obs, crossing_lines=moved, model=model)
    return line_block(geometry.pose_array(transform), obs).residuals


def plane_residuals_m(obs, transform, board_poses=None):
    """Signed distances (m,) of the board-face points from the planes the camera sees under
    ``T_camera_source``.

    Metres, along the board's z; NaN for placements whose board pose the camera does not know.
    `board_poses` are other poses than ``obs.board_poses`` (of a joint refinement).
    """
    poses = obs.board_poses if board_poses is None else board_poses
    out = np.full(len(obs.plane_points), np.nan)
    row, known = np.nonzero(obs.placements[:, None] == obs.plane_placement)
    normal = poses[row, :3, 2]
    point = poses[row, :3, 3]
    out[known] = np.sum(normal * (transform.apply(obs.plane_points[known]) - point), axis=1)
    return out


ROOT_2PI = np.sqrt(2 * np.pi)
# of a beam step: least softness, so that an edge between two beams is put into their middle
LEAST_STEP = 0.15
# dense where the share of a disc changes least
_X = np.sin(np.linspace(-1, 1, 4001) * np.pi / 2)[1:-1]


def disc_share(x):
    """Share of a unit disc inside a straight edge `x` radii inside of its centre: 1 for x <=
    -1, 0 for x >= 1.
    """
    x = np.clip(np.asarray(x, float), -1.0, 1.0)
    return (np.arccos(x) - x * np.sqrt(1 - x**2)) / np.pi


_LOG_ODDS = np.log(disc_share(_X)) - np.log(disc_share(-_X))


def disc_edge(log_odds):
    """Where an edge cuts a unit disc so that its inner share has log odds ``ln(share / (1 -
    share))``.

    Inverts :func:`disc_share`; returns the distance x of the disc's centre from the edge in radii,
    positive outside, between -1 and 1, and ``dx / dlog_odds`` (negative).
    """
    log_odds = np.asarray(log_odds, float)
    x = np.interp(-log_odds, -_LOG_ODDS, _X)
    slope, here = _slope(x)
    # value and slope must agree for steps to converge
    refined = x + slope * np.clip(log_odds - here, -1e-4, 1e-4)
    return refined, _slope(refined)[0]


def _slope(x):
    """``dx / dlog_odds`` and the log odds of the share inside, at a distance of the edge in
    radii.
    """
    inside, outside = (np.maximum(disc_share(v), 1e-12) for v in (x, -x))
    slope = -inside * outside * np.pi / (2 * np.sqrt(np.maximum(1 - x**2, 1e-12)))
    return slope, np.log(inside / outside)


def edge_shift(log_odds, radius, background=0.0):
    """By how far a spot's centre may lie outside an edge and still read the board, and its
    derivative by `log_odds`.

    Metres, positive where boards look larger. The log odds are the sensor's, for a background as
    far and as bright as the board; `background` is what the real one adds: ``-2 ln(d_background /
    d_board)``, 0 where it is not known.
    """
    x, slope = disc_edge(log_odds + np.asarray(background, float))
    return radius * x, radius * slope


def flip_sigma(softness, radius, step):
    """Standard deviation of where readings flip (metres), and ``d ln sigma / d ln softness``, 0
    (all floor) to 1.

    `softness` is in spot radii. Beams a step apart (metres, at the board) cannot show a sharper
    edge than a floor.
    """
    soft = softness * np.asarray(radius, float)
    sigma = np.hypot(soft, LEAST_STEP * np.asarray(step, float))
    return sigma, (soft / sigma) ** 2


def beam_terms(margin, sigma, hit, lapse=0.0):
    """Negative log likelihood of single beams near an edge, a probit: ``P(hit) = Phi(margin /
    sigma)``.

    `margin` and `sigma` (metres) are how far inside the place where readings flip the beam's centre
    lies (shift - distance from the edge), and the standard deviation of that place; `hit` tells
    whether the board was read, `lapse` is the share of beams that say nothing (something hid or
    bent the edge there): their pull fades with distance. Returned are cost, score (its derivative
    by the margin) and the observed information on the margin, never negative; with `lapse` that of
    the majorising function of an EM step.
    """
    sign = np.where(hit, 1.0, -1.0)
    z = sign * np.asarray(margin, float) / sigma
    log_p = log_ndtr(z)
    mills = np.exp(-0.5 * z**2 - log_p) / ROOT_2PI  # phi(z) / Phi(z) without overflow
    weight = 1.0
    cost = -log_p
    if lapse:
        cost = -np.logaddexp(np.log(lapse), np.log1p(-2 * lapse) + log_p)
        weight = np.exp(np.log1p(-2 * lapse) + log_p + cost)
    return cost, -weight * sign * mills / sigma, weight * mills * (z + mills) / sigma**2


# metres; no printed board is flatter, and a board along the beam has no range noise across it
SIGMA_FLOOR = 1e-4
SENSOR = ("range_offset", "edge_log_odds", "edge_log_softness", "pitch_scale", "pitch_by_direction")
SWEEPS = {"none": 0, "offset": 1, "offset_stretch": 2}
LARGEST_ODDS = 8.0  # beyond, the edge lies at the rim of the spot whatever the odds
# and how widely they may differ: at the rim of the spot the odds say nothing any more
USUAL = {
    "edge_log_odds": (0.0, 6.0),
    "edge_log_softness": (np.log(0.15), 1.0),
    "pitch_scale": (0.0, 0.05),
}
SIDE_FREEDOM = PRIOR_FREEDOM = 3.0
# of the increments [w, v] of T_head_lrf: what the gauge leaves
AXIS_COLUMNS = np.array([1, 2, 4, 5])


@dataclass(frozen=True)
class JointState:
    """Everything that moves.

    Attributes
    ----------
    head, cameras, boards : ndarray, shapes (3, 4), (c, 3, 4), (p, 3, 4)
        ``T_head_lrf``, ``T_camera_lrf`` (mount 'head') or ``T_camera_platform`` (mount 'platform'),
        ``T_platform_board``.
    sensor : ndarray, shape (5,)
        In the order of `SENSOR`: metres, log odds, log of spot radii, fraction, radians.
    sweeps : ndarray, shape (p, 2)
        Offset (radians) and stretch of the recorded pitch of each sweep.
    sides : ndarray, shape (p, e)
        By how much the log odds of each side differ from the sensor's: what stands behind it is
        darker or brighter.
    """

    head: np.ndarray
    cameras: np.ndarray
    sensor: np.ndarray
    boards: np.ndarray
    sweeps: np.ndarray
    sides: np.ndarray


@dataclass(frozen=True)
class Unknowns:
    """Which columns of the full Jacobian are unknown.

    `cameras` and `edges` are their numbers, `sensor` names some of `SENSOR`, `sweep` one of
    `SWEEPS`; `poses` tells whether the cameras' are unknown, `sides` whether every side of every
    placement has a deviation of its own from the sensor's edge bias.
    """

    cameras: int
    edges: int
    axis: bool = True
    sensor: tuple = ("range_offset", "edge_log_odds", "edge_log_softness")
    sweep: str = "none"
    poses: bool = True
    sides: bool = False

    @property
    def mask(self):
        """Of the full set of shared columns, those that are unknown."""
        sensor = [name in self.sensor for name in SENSOR]
        return np.array([self.axis] * 4 + [self.poses] * 6 * self.cameras + sensor)

    @cached_property
    def columns(self):
        """Where the unknowns stand in a Jacobian: first the shared ones, then the placement's
        own.
        """
        widths = {"axis": 4 * self.axis, "cameras": 6 * self.cameras * self.poses}
        widths |= {name: int(name in self.sensor) for name in SENSOR}
        widths |= {"board": 6, "sweep": SWEEPS[self.sweep], "sides": self.edges * self.sides}
        ends = np.cumsum(list(widths.values())).tolist()
        return {
            name: slice(end - width, end)
            for (name, width), end in zip(widths.items(), ends, strict=True)
        }

    @property
    def shared(self):
        """Number of unknowns common to all placements."""
        return self.columns["board"].start

    @property
    def own(self):
        """Number of unknowns of one placement."""
        return self.columns["sides"].stop - self.shared

    def names(self, cameras):
        """Names of the shared unknowns."""
        every = [*AXIS_NAMES, *(f"{c}_{n}" for c in cameras for n in geometry.POSE_NAMES), *SENSOR]
        return tuple(np.array(every)[self.mask].tolist())


@dataclass(frozen=True)
class JointData:
    """Observations padded by placement: arrays (p, n, ...), `used` marks what is no padding.

    `face`, `beam` and `view` hold the fields of that group of JointObservations, with ``ray`` (LRF
    frame) or, for views, ``whitener`` (p, v, 6, 6); `lines` (e, 3) are the board's, `middle` and
    `direction` (p,) the sweeps'. Then come factors on the stated standard deviations of ranges and
    of each camera's views, the standard deviation of the recorded pitch at a stop (what a head at
    rest is off by, radians; see :mod:`lrfcal_lib.fit.stops`), shares of independent errors per
    observation (below one where neighbours repeat each other's errors), `lapse` (see
    :func:`beam_terms`), what is expected of the sweeps' own offset (radians) and stretch, the scale
    of the sides' deviations of the log odds (Student's t with `SIDE_FREEDOM` degrees of freedom:
    most backgrounds are alike, some are dark), and the stated platform, which yields where the data
    contradict it.
    """

    face: dict
    beam: dict
    view: dict
    lines: np.ndarray
    middle: np.ndarray
    direction: np.ndarray
    on_head: np.ndarray
    face_scale: float = 1.0
    view_scale: np.ndarray | None = None
    sigma_pitch: float = 0.0
    face_share: float = 1.0
    beam_share: float = 1.0
    lapse: float = 0.0
    sweep_sigma: tuple = (np.radians(0.5), 0.05)
    side_sigma: float = 0.35
    prior: PlatformPrior | None = None

    @property
    def levels(self):
        """Noise levels and prior: all that has a default."""
        return {f.name: getattr(self, f.name) for f in fields(self) if f.default is not MISSING}


def pad(group, count, width=1):
    """Arrays of a group (with `placement`, an index below `count`) sorted into rectangles (count,
    n, ...).

    Rows of a placement keep their order; zeros stand behind them, and `used` marks what is no
    padding. n is `width` at least.
    """
    order = np.argsort(group["placement"], kind="stable")
    number = np.bincount(group["placement"], minlength=count)
    used = np.arange(number.max(initial=width)) < number[:, None]
    out = {"used": used}
    for key, value in group.items():
        if key != "placement":
            out[key] = np.zeros(used.shape + value.shape[1:], value.dtype)
            out[key][used] = value[order]
    return out


def gather(obs, **levels):
    """JointObservations as padded arrays, a JointData, with noise levels other than those
    stated.
    """
    count = len(obs.placements)
    face, beam, view = (pad(obs.group(name), count) for name in ("face", "beam", "view"))
    for group in (face, beam):
        group["ray"] = geometry.polar_to_points(1.0, group["bearing"])
    view["covariance"] = np.where(view["used"][..., None, None], view["covariance"], np.eye(6))
    view["whitener"] = (
        np.linalg.inv(np.linalg.cholesky(view["covariance"])) * view["used"][..., None, None]
    )
    view["pose"] = np.where(view["used"][..., None, None], view["pose"], np.eye(4))
    on_head = np.array([m == "head" for m in obs.mounts], bool)
    levels = {"view_scale": np.ones(len(obs.cameras))} | levels
    return JointData(face, beam, view, obs.lines(), obs.middle, obs.direction, on_head, **levels)


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


def inverse_left_jacobian(w):
    """How a small turn of a rotation changes its rotation vector, shape (..., 3) -> (..., 3, 3)."""
    angle = np.linalg.norm(w, axis=-1)[..., None, None]
    safe = np.maximum(angle, 1e-4)
    bend = np.where(angle > 1e-4, 1 / safe**2 - 1 / (2 * safe * np.tan(safe / 2)), 1 / 12)
    W = hat(w)
    return np.eye(3) - 0.5 * W + bend * (W @ W)


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


def own_jacobian(unknowns, p, name):
    """Jacobian of unknowns that all p placements have (or share) by themselves."""
    rows = np.eye(unknowns.shared + unknowns.own)[unknowns.columns[name]]
    return np.broadcast_to(rows, (p, *rows.shape))


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


def move_state(state, step, unknowns):
    """Retraction of the joint estimate: shared increments (c,) and those of each placement (p,
    l).
    """
    full = np.zeros(len(unknowns.mask))
    full[unknowns.mask] = step[0]
    c = len(state.cameras)
    sensor = state.sensor + full[4 + 6 * c :]
    sensor[1] = np.clip(sensor[1], -LARGEST_ODDS, LARGEST_ODDS)
    sensor[2] = np.clip(sensor[2], np.log(1e-3), np.log(10.0))
    count = SWEEPS[unknowns.sweep]
    sweeps = state.sweeps.copy()
    sweeps[:, :count] += step[1][:, 6 : 6 + count]
    return replace(
        state,
        head=move_head(state.head, full[:4]),
        cameras=move_pose(state.cameras, full[4 : 4 + 6 * c].reshape(c, 6)) if c else state.cameras,
        sensor=sensor,
        boards=move_pose(state.boards, step[1][:, :6]),
        sweeps=sweeps,
        sides=state.sides + step[1][:, 6 + count :] if unknowns.sides else state.sides,
    )


def chart_parameters(head):
    """The axis of ``T_head_lrf`` (3, 4): angles out of and within the scan plane, and minus y,
    z of its foot, (4,).
    """
    axis = geometry.axis_of(pose_transform(head))
    x, y, z = axis.direction
    return np.r_[np.arctan2(z, x), np.arctan2(-y, x), -axis.foot[1:]]


def prior_terms(head, prior):
    """Differences from the prior in the chart (4,), and their Jacobian (4, 4) by the chart's
    increments.

    The direction is compared by ``R0 R^T e_x``, the offset by the foot points, both in the prior's
    head frame.
    """
    reference = geometry.pose_array(geometry.head_from_axis(geometry.axis_of(prior.T_head_lrf)))
    turn = reference[:, :3] @ head[:, :3].T
    along = turn[:, 0]
    arm = np.array([0.0, head[1, 3], head[2, 3]])
    r = np.r_[along[2], -along[1], (turn @ arm)[1:] - reference[1:, 3]]
    J = np.zeros((4, 4))
    by_turn = turn @ hat([[1.0, 0.0, 0.0], arm])[..., 1:]  # of R^T e_x and R^T t by w_y, w_z
    J[:2, :2] = by_turn[0, [2, 1]] * [[1.0], [-1.0]]
    J[2:, :2] = by_turn[1, 1:]
    J[2:, 2:] = turn[1:, 1:]
    return r, J


def move_head(head, step):
    """Move a head pose array in the 4-dof chart."""
    delta = np.zeros(step.shape[:-1] + (6,))
    delta[..., AXIS_COLUMNS] = step
    return move_pose(head, delta)


def sight_normals(lines, model):
    """Unit normals of the planes through the camera centre and image lines, and lengths of
    ``K^T l``.
    """
    raw = lines @ model.matrix
    length = np.linalg.norm(raw, axis=-1)
    return raw / length[..., None], length


def sight_block(pose, points, normals, sigma):
    """Distances of points (..., n, 3) from planes through the camera centre with unit normals
    (..., n, 3), metres.
    """
    rotated = rotate_points(pose, points)
    residuals = np.sum(normals * (rotated + pose[..., None, :, 3]), axis=-1)
    jacobian = gradient_by_pose(rotated, np.broadcast_to(normals, rotated.shape))
    return Block(residuals, jacobian, np.full(residuals.shape, 1.0 / sigma))
