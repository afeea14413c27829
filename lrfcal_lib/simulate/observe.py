"""Observations of a whole rig drawn directly from the noise models of beam, platform and cameras, without images.

A session of :mod:`lrfcal_lib.simulate.record` takes minutes; this takes milliseconds, for Monte-Carlo trials by the
hundred. It returns plain arrays and knows no solver.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from lrfcal_lib.board import Board, triangle_board
from lrfcal_lib.camera import CameraModel, project_jacobians
from lrfcal_lib.geometry import lrf_to_platform, tilt

# of the pattern
CORNERS = np.array([[0.04 + 0.03 * i, 0.04 + 0.03 * j, 0.0] for i in range(5) for j in range(6) if i + j < 7])
MARGIN = 6  # beams beyond the board
AHEAD = Rotation.from_matrix([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])  # a camera that looks along y of the LRF


def _camera():
    return CameraModel(1280, 960, 1000.0, 1000.0, 639.5, 479.5, np.zeros(5))


@dataclass(frozen=True)
class Bench:
    """Truth and noise of a rig to draw observations from.

    Attributes
    ----------
    T_head_lrf : RigidTransform
    cameras : dict of str to RigidTransform
        ``T_camera_lrf`` (mount 'head') or ``T_camera_platform``.
    mount : {'head', 'platform'}
    model : CameraModel
    board : Board
    step, pitch_step : float
        Between beams and between scan lines, radians.
    spot : tuple of float
        Diameter at the window (metres) and growth (radians).
    sigma_range, range_offset : float
        Metres.
    sigma_px : float
        Of one coordinate of a pattern corner, pixels.
    bias : float
        How far outside an edge a spot still reads the board, in spot radii.
    softness : float
        Standard deviation of that from beam to beam, in spot radii.
    stretch : float
        Of the recorded pitch: the head turns ``1 + stretch`` times as far.
    """

    T_head_lrf: RigidTransform
    cameras: dict
    mount: str = "head"
    model: CameraModel = field(default_factory=_camera)
    board: Board = field(default_factory=triangle_board)
    step: float = np.radians(0.5)
    pitch_step: float = np.radians(0.5)
    spot: tuple = (0.016, 0.0119)
    sigma_range: float = 0.010
    range_offset: float = 0.0
    sigma_px: float = 0.3
    bias: float = 0.0
    softness: float = 0.1
    stretch: float = 0.0


def bench(rng, cameras=("left", "right"), **settings):
    """A rig like the paper's with random mounting errors of some degrees and centimetres.

    Parameters
    ----------
    rng : numpy.random.Generator
    cameras : sequence of str
    **settings
        Of :class:`Bench`.

    Returns
    -------
    Bench
    """
    turn = Rotation.from_rotvec([0.0, *rng.normal(0, 0.02, 2)])
    head = RigidTransform.from_components([0.0, *rng.normal(0, 0.05, 2)], turn)
    poses = {}
    for i, name in enumerate(cameras):
        rotation = Rotation.from_rotvec(rng.normal(0, 0.03, 3)) * AHEAD
        centre = np.array([0.12 * (2 * i - 1), 0.03, 0.12]) + rng.normal(0, 0.01, 3)
        poses[name] = RigidTransform.from_components(-rotation.apply(centre), rotation)
    return Bench(head, poses, **settings)


def board_poses(rng, count, distances=(1.0, 2.5)):
    """Poses ``T_platform_board`` of boards ahead of the rig, facing it, turned every way in their plane."""
    poses = []
    for _ in range(count):
        spin = Rotation.from_rotvec([0, 0, rng.uniform(0, 2 * np.pi)])
        lean = Rotation.from_rotvec([*rng.uniform(-0.6, 0.6, 2), 0.0])
        face = Rotation.from_matrix([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]]) * lean * spin  # z towards the rig
        centre = np.array([rng.uniform(-0.35, 0.35), 1.0, rng.uniform(-0.1, 0.1)]) * rng.uniform(*distances)
        poses.append(RigidTransform.from_components(centre - face.apply([0.105, 0.127, 0.0]), face))
    return poses


def observe(bench, poses, rng, *, images=3, span=None, noise=1.0, reach=2):
    """Draw what the rig records of boards.

    Parameters
    ----------
    bench : Bench
    poses : list of RigidTransform
        ``T_platform_board``.
    rng : numpy.random.Generator
    images : int
        Images of each camera a placement, spread over the sweep.
    span : float, optional
        Pitch range of a sweep, radians; as far as the board reaches when left out. 0 is a single shot through the
        board's middle.
    noise : float
        Scales all errors; 0 gives exact observations (the edges stay quantised by the beams).
    reach : int
        Beams kept on either side of an edge, along and across the scan lines.

    Returns
    -------
    dict
        Keyword arguments of :class:`lrfcal_lib.solvers.joint_observations.JointObservations`.
    """
    parts = [_placement(bench, pose, rng, images, span, noise, reach) for pose in poses]
    out = {}
    for name in ("face", "beam", "view"):
        for key in parts[0][name]:
            out[f"{name}_{key}"] = np.concatenate([part[name][key] for part in parts])
        lengths = [len(part[name]["pitch"]) for part in parts]
        out[f"{name}_placement"] = np.repeat(np.arange(len(parts)), lengths)
    count = len(poses)
    return out | {
        "placements": np.arange(1, count + 1),
        "direction": np.where(np.arange(count) % 2, -1, 1) if span != 0 else np.zeros(count, int),
        "middle": np.array([part["middle"] for part in parts]),
        "edges": bench.board.edges,
        "corners": np.asarray(bench.board.corners, float),
        "cameras": tuple(bench.cameras),
        "mounts": (bench.mount,) * len(bench.cameras),
        "T_head_lrf": None,
    }


def _placement(bench, pose, rng, images, span, noise, reach):
    pitch = _pitches(bench, pose, span)
    true = pitch * (1 + bench.stretch)
    bearings = _bearings(bench, pose, true)
    hit, u, edge, r = _cast(bench, pose, true, bearings, rng, noise)
    line, beam = np.nonzero(hit)
    near = _near_edges(hit, u, reach)
    row, b = np.nonzero(near.any(axis=0))
    step = np.where(near[1][row, b], bench.step, bench.pitch_step)
    face = {
        "range": r[line, beam] + bench.range_offset + noise * bench.sigma_range * rng.standard_normal(len(line)),
        "bearing": bearings[beam], "pitch": pitch[line], "sigma": np.full(len(line), bench.sigma_range),
    }  # fmt: skip
    beams = {
        "bearing": bearings[b], "pitch": pitch[row], "hit": hit[row, b], "edge": edge[row, b],
        "radius": _radius(bench, r[row, b]), "background": np.zeros(len(row)),
        "step": step * r[row, b],
    }  # fmt: skip
    at = np.linspace(pitch[0], pitch[-1], images + 2)[1:-1]
    views = _views(bench, pose, at, rng, noise)
    return {"face": face, "beam": beams, "view": views, "middle": float(pitch.mean())}


def _pitches(bench, pose, span):
    corners = np.column_stack([bench.board.corners, np.zeros(len(bench.board.corners))])
    p = pose.apply(corners)
    up = np.arctan2(p[:, 2], p[:, 1])
    middle = np.arctan2(*p.mean(axis=0)[[2, 1]])
    half = span / 2 if span is not None else max(up.max() - middle, middle - up.min()) + 6 * bench.pitch_step
    steps = int(half / bench.pitch_step)
    return middle + bench.pitch_step * np.arange(-steps, steps + 1)


def _bearings(bench, pose, pitch):
    """Beams that pass the board or come near it."""
    corners = pose.apply(np.column_stack([bench.board.corners, np.zeros(len(bench.board.corners))]))
    p_head = tilt(corners[:, None], -pitch)
    p = bench.T_head_lrf.inv().apply(p_head.reshape(-1, 3))
    bearing = np.arctan2(p[:, 1], p[:, 0])
    first, last = (round(b / bench.step) for b in (bearing.min(), bearing.max()))
    return bench.step * np.arange(first - MARGIN, last + MARGIN + 1)


def _radius(bench, distance):
    return (bench.spot[0] + bench.spot[1] * distance) / 2


def _cast(bench, pose, pitch, bearings, rng, noise):
    """Which beams read the board, distance to the nearest edge outside, that edge, and the range to the plane."""
    ray = np.stack([np.cos(bearings), np.sin(bearings), 0 * bearings], axis=-1)
    ray = np.tile(ray, (len(pitch), 1, 1))
    angle = np.broadcast_to(pitch[:, None], ray.shape[:2])
    o = lrf_to_platform(np.zeros_like(ray), angle, bench.T_head_lrf)
    d = tilt(bench.T_head_lrf.rotation.apply(ray.reshape(-1, 3)).reshape(ray.shape), angle)
    inverse = pose.inv()
    o_board = inverse.apply(o.reshape(-1, 3)).reshape(o.shape)
    d_board = inverse.rotation.apply(d.reshape(-1, 3)).reshape(d.shape)
    r = -o_board[..., 2] / d_board[..., 2]
    x = o_board + r[..., None] * d_board
    lines = bench.board.lines()
    inside = x[..., :2] @ lines[:, :2].T + lines[:, 2]
    along = np.column_stack([-lines[:, 1], lines[:, 0], 0 * lines[:, 0]])
    slant = np.abs(d_board[..., 2:]) / np.linalg.norm(np.cross(d_board[..., None, :], along), axis=-1)
    distances = inside * slant
    radius = _radius(bench, r)[..., None]
    jitter = noise * bench.softness * radius[..., 0] * rng.standard_normal(r.shape)
    u, edge = distances.max(axis=-1), distances.argmax(axis=-1)
    second = np.sort(distances, axis=-1)[..., -2]
    hit = (u + jitter < bench.bias * radius[..., 0]) & (r > 0.2) & (r < 30)
    corner = second > -2 * radius[..., 0]  # where two edges cut the spot
    u = np.where(corner | (r < 0.2) | (r > 30), np.nan, u)
    return hit, u, edge, r


def _near_edges(hit, u, reach):
    """Beams within some beams of a change between board and background, across and along the scan lines (2, l, b)."""
    near = np.zeros((2, *hit.shape), bool)
    for axis in (0, 1):
        change = np.diff(hit, axis=axis)
        at = np.nonzero(change)
        for k in range(-reach + 1, reach + 1):
            index = list(at)
            index[axis] = np.clip(index[axis] + k, 0, hit.shape[axis] - 1)
            near[(axis, *index)] = True
    return near & np.isfinite(u)


def _views(bench, pose, at, rng, noise):
    """Poses of the board in the cameras, with errors drawn from what 0.3 px do to a pattern's corners."""
    true = np.concatenate([_seen(bench, T, pose, at) for T in bench.cameras.values()] or [np.zeros((0, 4, 4))])
    J = _corner_jacobians(true, bench.model)
    covariance = np.linalg.inv(np.einsum("vnik,vnil->vkl", J, J) / bench.sigma_px**2)
    error = noise * (np.linalg.cholesky(covariance) @ rng.standard_normal((len(true), 6, 1)))[..., 0]
    drawn = true.copy()
    drawn[:, :3, :3] = Rotation.from_rotvec(error[:, :3]).as_matrix() @ true[:, :3, :3]
    drawn[:, :3, 3] += error[:, 3:]
    camera, pitch = np.repeat(np.arange(len(bench.cameras)), len(at)), np.tile(at, len(bench.cameras))
    return {"camera": camera, "pitch": pitch, "pose": drawn, "covariance": covariance}


def _seen(bench, T_camera, pose, at):
    """``T_camera_board`` at each recorded pitch, shape (v, 4, 4)."""
    turn = np.zeros((len(at), 4, 4)) + np.eye(4)
    if bench.mount == "platform":
        return T_camera.as_matrix() @ turn @ pose.as_matrix()
    turn[:, :3, :3] = Rotation.from_rotvec(np.outer(-at * (1 + bench.stretch), [1.0, 0.0, 0.0])).as_matrix()
    return (T_camera * bench.T_head_lrf.inv()).as_matrix() @ turn @ pose.as_matrix()


def _corner_jacobians(T_camera_board, model):
    """Derivatives of the corners' pixels by the poses' increments ``[w, v]``, shape (v, k, 2, 6)."""
    turned = CORNERS @ np.swapaxes(T_camera_board[:, :3, :3], 1, 2)
    points = turned + T_camera_board[:, None, :3, 3]
    by_point = project_jacobians(points.reshape(-1, 3), model)[0].reshape(points.shape[:2] + (2, 3))
    return np.concatenate([np.cross(turned[:, :, None, :], by_point), by_point], axis=-1)
