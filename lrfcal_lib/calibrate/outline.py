"""Outlines of boards in sweeps by likelihood, their size unknown, and with the images' edges in the coloured cloud."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation
from scipy.stats import f as f_distribution

from lrfcal_lib.calibrate.reconstruct import measure_board
from lrfcal_lib.fit.residuals import beam_terms, edge_shift, flip_sigma
from lrfcal_lib.model.board import corners_of_lines
from lrfcal_lib.model.geometry import (
    DegenerateGeometry,
    fit_line,
    fit_plane,
    hat,
    lrf_to_platform,
    polar_to_points,
    tilt,
)
from lrfcal_lib.preprocess.board_in_scan import face_points

LAPSE = 0.005  # share of beams that something else than the edge decides
FEWEST_CELLS = 8
ROUNDS = 40


@dataclass(frozen=True)
class EdgeModel:
    """What a calibration knows about how a sensor sees edges.

    Attributes
    ----------
    log_odds : float
        See :mod:`lrfcal_lib.fit.residuals`.
    log_odds_sigma : float
    spread : float
        Standard deviation of the log odds from side to side: backgrounds are not equally bright.
    softness : float
        Standard deviation of where single readings flip, in spot radii.
    range_offset, range_offset_sigma : float
        Recorded minus true range, metres.
    T_head_lrf : RigidTransform
    correct : callable, optional
        ``correct(placement, p_lrf, pitch) -> (p_lrf, pitch)`` takes known errors out of the pitch; what it does to
        points is not used, `range_offset` is.
    """

    log_odds: float = 0.0
    log_odds_sigma: float = 0.0
    spread: float = 0.0
    softness: float = 0.1
    range_offset: float = 0.0
    range_offset_sigma: float = 0.0
    T_head_lrf: RigidTransform = field(default_factory=RigidTransform.identity)
    correct: Callable | None = None

    def pitch(self, placement, p_lrf, pitch):
        """Recorded pitch without its known errors, radians."""
        return pitch if self.correct is None else self.correct(placement, p_lrf, pitch)[1]


@dataclass(frozen=True)
class MeasuredOutline:
    """The outline of a board as one sweep shows it.

    Attributes
    ----------
    T_platform_plane : ndarray, shape (4, 4)
        Origin on the face, z along the normal towards the sensor.
    edges : tuple of str
        The sides that were measured.
    lines : ndarray, shape (s, 3)
        ``a x + b y + c = 0`` in the plane, unit normals outwards, metres.
    covariance : ndarray, shape (2 s, 2 s)
        Of shifts outwards (metres) and turns (radians) of the sides about the middle of their cells, side by side.
    lengths, sigma : dict of str to float
        Of edges of which both neighbours were measured, and their standard deviations, metres.
    corners : dict of str to ndarray, shape (2,)
        Where an edge starts, plane coordinates.
    """

    T_platform_plane: np.ndarray
    edges: tuple[str, ...]
    lines: np.ndarray
    covariance: np.ndarray
    lengths: dict
    sigma: dict
    corners: dict


@dataclass(frozen=True)
class _Rays:
    """Beams about the edges in a plane's frame: where they meet it, and their directions."""

    at: np.ndarray
    direction: np.ndarray
    side: np.ndarray
    hit: np.ndarray
    radius: np.ndarray
    background: np.ndarray
    step: np.ndarray

    def distances(self, lines):
        """Between rays and the lines of their sides, positive outside, and its derivative by a shift of the line."""
        normal = lines[self.side, :2]
        across = np.sum(normal * self.direction[:, :2], axis=1)
        factor = np.abs(self.direction[:, 2]) / np.hypot(self.direction[:, 2], across)
        return (np.sum(normal * self.at, axis=1) + lines[self.side, 2]) * factor, factor


def measure_outline(cells, face, names, edges, model):
    """Measure a board of unknown size in one sweep.

    Parameters
    ----------
    cells : EdgeCells
    face : tuple
        Points on the face (LRF frame, metres), their pitch (radians), and the standard deviation of a range (metres).
    names : dict of int to str
        Edge of each side.
    edges : tuple of str
        All edges in order around the board.
    model : EdgeModel
        From other placements.

    Returns
    -------
    MeasuredOutline

    Raises
    ------
    DegenerateGeometry
        If the face does not span a plane, or no side has enough cells.
    """
    pose, bend = face_surface(face, model)
    rays, found = find_rays(cells, pose, bend, names, model)
    if not found:
        raise DegenerateGeometry(f"placement {cells.placement}: no side has {FEWEST_CELLS} beams about it")
    lines, middle = start_lines(rays, len(found))
    lines, information = fit_sides(rays, lines, middle, model)
    covariance = _covariance(rays, information, model)
    return _outline(pose, found, lines, middle, covariance, edges, model, face)


def face_surface(face, model):
    """The face of a board as a plane and its bend.

    Parameters
    ----------
    face : tuple
        See :func:`measure_outline`.
    model : EdgeModel

    Returns
    -------
    pose : ndarray, shape (4, 4)
        Frame in the plane: origin in the middle of the points, z towards the sensor; platform frame.
    bend : ndarray, shape (6,)
        Height over the plane, ``bend . (1, x, y, x^2, x y, y^2)``, metres; zero where the points do not ask for it
        (F test at 0.1 %): cardboard bends by a centimetre, and a ray at a slant then meets it elsewhere.
    """
    points, pitch, _ = face
    rays = points / np.linalg.norm(points, axis=1, keepdims=True)
    p = lrf_to_platform(points - model.range_offset * rays, pitch, model.T_head_lrf)
    normal, distance, _ = fit_plane(p)
    normal, distance = (-normal, -distance) if distance > 0 else (normal, distance)
    across = np.linalg.svd(hat(normal))[2][0]
    pose = np.eye(4)
    pose[:3, 0], pose[:3, 1], pose[:3, 2] = across, np.cross(normal, across), normal
    centre = p.mean(axis=0)
    pose[:3, 3] = centre - normal * (normal @ centre - distance)
    return pose, _bend((p - pose[:3, 3]) @ pose[:3, :3])


def _quadratic(x, y):
    return np.stack([np.ones_like(x), x, y, x**2, x * y, y**2], axis=-1)


def _bend(p):
    """Coefficients of a bent face where the points ask for them."""
    A = _quadratic(p[:, 0], p[:, 1])
    flat, bent = (np.linalg.lstsq(A[:, :k], p[:, 2], rcond=None)[0] for k in (3, 6))
    before, after = np.sum((p[:, 2] - A[:, :3] @ flat) ** 2), np.sum((p[:, 2] - A @ bent) ** 2)
    gain = (before - after) / 3 / (after / max(len(p) - 6, 1))
    return bent if gain > f_distribution.ppf(0.999, 3, max(len(p) - 6, 1)) else np.zeros(6)


def find_rays(cells, pose, bend, names, model):
    """Cells of named sides as rays in the plane's frame, and the names of these sides."""
    count = {side: np.sum(cells.side == side) for side in names}
    found = {side: name for side, name in names.items() if count[side] >= FEWEST_CELLS}
    number = {side: i for i, side in enumerate(found)}
    cells = cells.select(np.isin(cells.side, list(found)))
    p_lrf = polar_to_points(np.ones(len(cells)), cells.bearing)
    direction = tilt(p_lrf @ model.T_head_lrf.rotation.as_matrix().T, cells.pitch) @ pose[:3, :3]
    origin = (tilt(model.T_head_lrf.translation, cells.pitch) - pose[:3, 3]) @ pose[:3, :3]
    at = _meet_face(origin, direction, bend)
    side = np.array([number[s] for s in cells.side], int)
    step = cells.range_m * cells.step
    return _Rays(at[:, :2], direction, side, cells.hit, cells.radius, cells.background, step), tuple(found.values())


def _meet_face(origin, direction, bend):
    """Where rays meet a bent face (a few rounds of intersecting with the height at the last place)."""
    height = 0.0
    for _ in range(4):
        at = origin + ((height - origin[:, 2]) / direction[:, 2])[:, None] * direction
        height = _quadratic(at[:, 0], at[:, 1]) @ bend
    return at


def start_lines(rays, count):
    """A line through the cells of each side, and their middle: as many lie on either side of the edge."""
    lines, middle = np.zeros((count, 3)), np.zeros((count, 2))
    for s in range(count):
        mine = rays.side == s
        at, hit = rays.at[mine], rays.hit[mine]
        centre, direction, _ = fit_line(np.column_stack([at, np.zeros(len(at))]))
        normal = np.array([direction[1], -direction[0]])
        normal *= np.sign(normal @ (at[~hit].mean(axis=0) - at[hit].mean(axis=0))) if 0 < hit.sum() < len(hit) else 1.0
        lines[s], middle[s] = np.r_[normal, -normal @ centre[:2]], centre[:2]
    return lines, middle


def _sums(rays, values, count):
    """Sums over the cells of each side, shape (count, ...)."""
    out = np.zeros((count,) + values.shape[1:])
    np.add.at(out, rays.side, values)
    return out


def _evaluate(rays, lines, middle, model):
    """Cost (s,), gradient (s, 2) and information (s, 2, 2) by shifts outwards and turns of the lines."""
    u, factor = rays.distances(lines)
    shift, _ = edge_shift(model.log_odds, rays.radius, rays.background)
    sigma, _ = flip_sigma(model.softness, rays.radius, rays.step)
    cost, score, information, _ = beam_terms(shift - u, sigma, rays.hit, LAPSE)
    normal = lines[rays.side, :2]
    turned = np.stack([-normal[:, 1], normal[:, 0]], axis=1)
    J = np.stack([factor, -factor * np.sum(turned * (rays.at - middle[rays.side]), axis=1)], axis=1)
    count = len(lines)
    outer = information[:, None, None] * J[:, :, None] * J[:, None, :]
    return _sums(rays, cost, count), _sums(rays, score[:, None] * J, count), _sums(rays, outer, count)


def _moved(lines, middle, step):
    """Lines shifted outwards and turned about the middle of their cells."""
    c, s = np.cos(step[:, 1]), np.sin(step[:, 1])
    at = np.sum(lines[:, :2] * middle, axis=1) + lines[:, 2] - step[:, 0]
    normal = np.stack([c * lines[:, 0] - s * lines[:, 1], s * lines[:, 0] + c * lines[:, 1]], axis=1)
    return np.column_stack([normal, at - np.sum(normal * middle, axis=1)])


def fit_sides(rays, lines, middle, model, rounds=ROUNDS):
    """Damped Newton steps of all sides at once.

    Parameters
    ----------
    rays : _Rays
    lines : ndarray, shape (s, 3)
        Start values.
    middle : ndarray, shape (s, 2)
        What the lines turn about.
    model : EdgeModel
    rounds : int

    Returns
    -------
    lines : ndarray, shape (s, 3)
    information : ndarray, shape (s, 2, 2)
        Of shifts (metres) and turns (radians).
    """
    damping = np.full(len(lines), 1e-3)
    cost, gradient, information = _evaluate(rays, lines, middle, model)
    for _ in range(rounds):
        diagonal = np.einsum("sii->si", information) + np.array([1e2, 1.0])  # a metre and a radian are far
        damped = information + (damping[:, None] * diagonal)[:, None] * np.eye(2)
        step = -np.linalg.solve(damped, gradient[..., None])[..., 0]
        trial = _moved(lines, middle, np.clip(step, -0.01, 0.01))
        tried = _evaluate(rays, trial, middle, model)
        good = tried[0] <= cost
        lines = np.where(good[:, None], trial, lines)
        damping = np.clip(np.where(good, damping / 10, damping * 10), 1e-9, 1e9)
        cost, gradient, information = _evaluate(rays, lines, middle, model)
        if np.all(np.abs(step) < [1e-8, 1e-7]):
            break
    return lines, information


def _covariance(rays, information, model):
    """Covariance of all sides: their beams, the log odds common to them, and what differs from side to side."""
    count = len(information)
    _, slope = edge_shift(model.log_odds, rays.radius, rays.background)
    slope = _sums(rays, slope, count) / np.bincount(rays.side, minlength=count)
    out = np.zeros((2 * count, 2 * count))
    for s, own in enumerate(information):
        out[2 * s : 2 * s + 2, 2 * s : 2 * s + 2] = np.linalg.inv(own + np.diag([1e2, 1.0]))
    out[::2, ::2] += model.log_odds_sigma**2 * np.outer(slope, slope) + np.diag((model.spread * slope) ** 2)
    return out


def _outline(pose, found, lines, middle, covariance, edges, model, face):
    """Corners and lengths with their standard deviations."""
    corners, lengths = _lengths(found, lines, edges)
    J = np.zeros((len(lengths), covariance.shape[0]))
    for k in range(covariance.shape[0]):
        step = np.zeros(covariance.shape[0])
        step[k] = 1e-6
        moved = _lengths(found, _moved(lines, middle, step.reshape(-1, 2)), edges)[1]
        J[:, k] = [(moved[name] - lengths[name]) / 1e-6 for name in lengths]
    scale = model.range_offset_sigma / np.median(np.linalg.norm(face[0], axis=1))
    size = np.array(list(lengths.values()))
    variance = np.einsum("ij,jk,ik->i", J, covariance, J) + (scale * size) ** 2 + _by_plane(pose, face, size)
    sigma = dict(zip(lengths, np.sqrt(variance), strict=True))
    return MeasuredOutline(pose, found, lines, covariance, lengths, sigma, corners)


def _by_plane(pose, face, size):
    """Variance of lengths from the plane's own noise: a tilt shortens or stretches what is seen at a slant."""
    points, _, sigma = face
    cosine = np.median(np.abs(points @ pose[:3, 2]) / np.linalg.norm(points, axis=1))
    slant = np.sqrt(max(1 - cosine**2, 0.0)) / max(cosine, 0.1)
    spread = np.sqrt(np.mean(np.sum((points - points.mean(axis=0)) ** 2, axis=1)) / 2)
    tilt_sigma = sigma * max(cosine, 0.1) / np.sqrt(len(points)) / max(spread, 1e-3)
    return (size * slant * tilt_sigma) ** 2


def _lengths(found, lines, edges):
    """Corners where two neighbouring sides were found, and lengths between them."""
    line = dict(zip(found, lines, strict=True))
    before = dict(zip(edges, edges[-1:] + edges[:-1], strict=True))
    after = dict(zip(edges, edges[1:] + edges[:1], strict=True))
    both = [name for name in edges if name in line and before[name] in line]
    corners = {name: corners_of_lines(np.stack([line[before[name]], line[name]]))[1] for name in both}
    pairs = {n: (corners[n], corners[after[n]]) for n in edges if n in corners and after[n] in corners}
    return corners, {n: float(np.linalg.norm(b - a)) for n, (a, b) in pairs.items()}


ALONG = np.linspace(0.0, 1.0, 9)  # places along the stretch of an edge


def fused_outline_of(joint, placement):
    """Measure the outline of a board whose size nobody knows: image edges on the plane of the cloud.

    Parameters
    ----------
    joint : JointCalibration
        Its estimate without the placement is used where there is one (see
        :func:`lrfcal_lib.calibrate.pipeline.leave_out`).
    placement : int

    Returns
    -------
    measured : MeasuredBoard
        In the platform frame. Every camera's edges count alike.
    across : None
        No end hangs on beams or on where a sweep enters or leaves the board.

    Raises
    ------
    DegenerateGeometry
        If the sweep does not span a plane, or no image shows an edge.
    """
    solution, prepared = joint.without.get(placement, joint.solution), joint.prepared
    points, pitch = solution.correct(placement, *face_points(prepared.scans[placement])[:2])
    face = lrf_to_platform(points, pitch, solution.T_head_lrf)
    centre = face.mean(axis=0)
    normal = np.linalg.svd(face - centre, full_matrices=False)[2][2]
    sides = {}
    for camera, views in prepared.views.items():
        view = views.get(placement)
        if view is None or camera not in solution.transforms:
            continue
        T_platform_camera = camera_in_platform(joint, solution, camera, placement, view.pitch).inv()
        for edge in view.edges:
            points = edge_on_plane(edge, prepared.models[camera], T_platform_camera, centre, normal)
            sides.setdefault(edge.name, []).append(points)
    if not sides:
        raise DegenerateGeometry(f"placement {placement}: no image shows an edge of the board")
    return measure_board(face, {k: np.concatenate(v) for k, v in sides.items()}, prepared.board.edges), None


def camera_in_platform(joint, solution, camera, placement, pitch):
    """``T_camera_platform`` at the instant of an image."""
    T_camera_source = solution.transforms[camera]
    if joint.prepared.session.cameras[camera].mount == "platform":
        return T_camera_source
    pitch = float(solution.correct(placement, np.zeros(3), pitch)[1])
    turn = RigidTransform.from_rotation(Rotation.from_rotvec([-pitch, 0.0, 0.0]))
    return T_camera_source * solution.T_head_lrf.inv() * turn


def edge_on_plane(edge, model, T_platform_camera, centre, normal):
    """Points of an image edge where its lines of sight meet a plane, platform frame, shape (k, 3).

    The ends of the stretch are moved onto the fitted line first.
    """
    ends = edge.ends - (edge.ends @ edge.line[:2] + edge.line[2])[:, None] * edge.line[:2]
    uv = ends[0] + ALONG[:, None] * (ends[1] - ends[0])
    rays = np.column_stack([(uv - [model.cx, model.cy]) / [model.fx, model.fy], np.ones(len(uv))])
    d, o = T_platform_camera.rotation.apply(rays), T_platform_camera.translation
    return o + ((centre - o) @ normal / (d @ normal))[:, None] * d
