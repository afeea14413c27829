"""Observations drawn directly from the noise models of beam, platform and cameras, without images.

A session of :mod:`lrfcal_lib.simulate.record` takes minutes; this takes milliseconds, for Monte-Carlo trials by the
hundred: sweeps of a whole rig (:func:`observe`), or single shots, one scan line and one image a placement
(:func:`draw_shots`). It returns plain arrays and knows no solver.
"""

from collections import defaultdict
from dataclasses import dataclass, field

import numpy as np
from scipy.ndimage import maximum_filter1d
from scipy.spatial.transform import RigidTransform, Rotation

from lrfcal_lib.model.board import Board, Chessboard, triangle_board
from lrfcal_lib.model.camera import CameraModel, pinhole, project_jacobians
from lrfcal_lib.model.geometry import polar_to_points, tilt

CORNERS = np.array([[0.04 + 0.03 * i, 0.04 + 0.03 * j, 0.0] for i in range(5) for j in range(6) if i + j < 7])
AHEAD = Rotation.from_matrix([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])  # axes of a camera, or a board, ahead of the LRF
MARGIN = 6  # beams beyond the board
REACH = 2  # beams kept on either side of an edge, along and across the scan lines
CLEAR = 1.3  # spot radii between a crossing and a second edge
FEWEST_BEAMS = 8
MOST_ROUNDS = 200


@dataclass(frozen=True, kw_only=True)
class Devices:
    """What beam and camera are, and how noisy."""

    model: CameraModel = field(default_factory=lambda: CameraModel(1280, 960, 1e3, 1e3, 639.5, 479.5, np.zeros(5)))
    board: Board = field(default_factory=triangle_board)  # A board without a pattern is seen as one with 23 corners
    step: float = np.radians(0.5)  # between beams, radians
    spot: tuple[float, float] = (0.016, 0.0119)  # diameter at the window (metres) and its growth (radians)
    sigma_range: float = 0.010  # metres
    sigma_px: float = 0.3  # of an image line across itself, and of one coordinate of a pattern corner
    bias: float = 0.0  # how far outside an edge the centre of a spot still reads the board, in spot radii
    softness: float = 0.1  # standard deviation of that from beam to beam, in spot radii

    def radius(self, ranges):
        """Of the spot, metres."""
        return (self.spot[0] + self.spot[1] * ranges) / 2


@dataclass(frozen=True)
class Bench(Devices):
    """Truth and noise of a rig to draw observations from; see also :class:`Devices`."""

    T_head_lrf: RigidTransform
    cameras: dict  # T_camera_lrf (mount 'head') or T_camera_platform
    mount: str = "head"  # one of head, platform
    pitch_step: float = np.radians(0.5)  # between scan lines, radians
    range_offset: float = 0.0  # metres
    stretch: float = 0.0  # of the recorded pitch: the head turns 1 + stretch times as far
    sigma_stop: float = 0.0  # standard deviation of the recorded pitch at stops for images, radians
    spread: float = 0.0  # standard deviation of the edge's log odds from side to side: backgrounds
    floor: float = 0.0  # least softness, in beam steps; real edges have none, the model of the joint estimate has


@dataclass(frozen=True, kw_only=True)
class ShotSetup(Devices):
    """What single shots are drawn from: devices like the paper's, boards at `distances` (metres)."""

    board: Board = field(default_factory=lambda: triangle_board(pattern=Chessboard(4, 5, 0.029, (0.03885, 0.03885))))
    softness: float = 0.03
    spread: float = 0.0  # standard deviation of `bias` from edge to edge of every placement: uneven backgrounds
    distances: tuple[float, float] = (1.0, 2.5)

    def bearings(self):
        """From 40 to 140 deg, radians, shape (B,)."""
        return np.radians(40) + self.step * np.arange(int(np.radians(100) / self.step + 1.5))


def bench(rng, cameras=("left", "right"), **settings):
    """A :class:`Bench` like the paper's with random mounting errors of some degrees and centimetres."""
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
    low, high = zip((0.0, 2 * np.pi), (-0.6, 0.6), (-0.6, 0.6), (-0.35, 0.35), (-0.1, 0.1), distances, strict=True)
    poses = []
    for spin, *lean, right, up, away in rng.uniform(low, high, (count, 6)):
        face = _facing(spin, lean)
        centre = np.array([right, 1.0, up]) * away
        poses.append(RigidTransform.from_components(centre - face.apply([0.105, 0.127, 0.0]), face))
    return poses


def observe(bench, poses, rng, *, images=3, span=None, noise=1.0):
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

    Returns
    -------
    dict
        Keyword arguments of :class:`lrfcal_lib.model.observations.JointObservations`.
    """
    parts, middle, count = defaultdict(list), [], len(poses)
    for number, pose in enumerate(poses):
        pitch, bearings = _grid(bench, pose, span)
        face, beam = _scan_lines(bench, pose, pitch, bearings, rng, noise)
        view = _views(bench, pose, np.linspace(pitch[0], pitch[-1], images + 2)[1:-1], rng, noise)
        for name, group in (("face", face), ("beam", beam), ("view", view)):
            for key, values in {**group, "placement": np.full(len(group["pitch"]), number)}.items():
                parts[f"{name}_{key}"].append(values)
        middle.append(float(pitch.mean()))
    return {name: np.concatenate(values) for name, values in parts.items()} | {
        "placements": np.arange(1, count + 1), "middle": np.array(middle),
        "direction": np.where(np.arange(count) % 2, -1, 1) if span != 0 else np.zeros(count, int),
        "edges": bench.board.edges, "corners": np.asarray(bench.board.corners, float),
        "cameras": tuple(bench.cameras), "mounts": (bench.mount,) * len(bench.cameras), "T_head_lrf": None,
    }  # fmt: skip


def _grid(bench, pose, span):
    """Recorded pitch of the scan lines over a board, and bearings of the beams that pass it or come near."""
    p = pose.apply(bench.board.points())
    up, middle = np.arctan2(p[:, 2], p[:, 1]), np.arctan2(*p.mean(axis=0)[[2, 1]])
    half = span / 2 if span is not None else max(up.max() - middle, middle - up.min()) + 6 * bench.pitch_step
    steps = int(half / bench.pitch_step)
    pitch = middle + bench.pitch_step * np.arange(-steps, steps + 1)
    p_lrf = bench.T_head_lrf.inv().apply(tilt(p[:, None], -pitch * (1 + bench.stretch)).reshape(-1, 3))
    bearing = np.arctan2(p_lrf[:, 1], p_lrf[:, 0])
    first, last = (round(b / bench.step) for b in (bearing.min(), bearing.max()))
    return pitch, bench.step * np.arange(first - MARGIN, last + MARGIN + 1)


def _scan_lines(bench, pose, pitch, bearings, rng, noise):
    """Readings of the face, and the beams within reach of where readings change between board and background."""
    true, R, head = pitch[:, None] * (1 + bench.stretch), pose.rotation.as_matrix(), bench.T_head_lrf
    rays = tilt(head.rotation.apply(polar_to_points(np.ones(len(bearings)), bearings)), true) @ R
    origin = (tilt(head.translation, true) - pose.translation) @ R
    distances, r = _beside(bench.board, origin, rays)
    radius, sensible = bench.radius(r), (r > 0.2) & (r < 30)
    u, edge = distances.max(axis=-1), distances.argmax(axis=-1)
    jitter = noise * np.hypot(bench.softness * radius, bench.floor * bench.step * r) * rng.standard_normal(r.shape)
    hit = (u + jitter < _bias_of_sides(bench, rng)[edge] * radius) & sensible
    # near to an edge across the scan lines, and along them
    changes = (np.diff(hit, axis=axis, append=hit.take([-1], axis)) for axis in (0, 1))
    across, along = (maximum_filter1d(c, 2 * REACH, axis, mode="constant") for axis, c in enumerate(changes))
    alone = np.sort(distances, axis=-1)[..., -2] <= -2 * radius  # elsewhere two edges cut the spot
    row, b = np.nonzero((across | along) & alone & sensible)
    step = np.where(along[row, b], bench.step, bench.pitch_step)
    line, beam = np.nonzero(hit)
    face = {
        "range": r[line, beam] + bench.range_offset + noise * bench.sigma_range * rng.standard_normal(len(line)),
        "bearing": bearings[beam], "pitch": pitch[line], "sigma": np.full(len(line), bench.sigma_range),
    }  # fmt: skip
    beams = {
        "bearing": bearings[b], "pitch": pitch[row], "hit": hit[row, b], "edge": edge[row, b],
        "radius": radius[row, b], "background": np.zeros(len(row)), "step": step * r[row, b],
    }  # fmt: skip
    return face, beams


def _bias_of_sides(bench, rng):
    """How far outside each edge of a placement a spot still reads the board, spot radii, (E,)."""
    bias = np.full(len(bench.board.edges), float(bench.bias))
    if bench.spread:
        x = np.sin(np.linspace(-1, 1, 4001) * np.pi / 2)[1:-1]
        share = (np.arccos(x) - x * np.sqrt(1 - x**2)) / np.pi  # of a disc, inside of the edge
        odds = np.log(share / (1 - share))
        own = np.interp(bias, x, odds) + bench.spread * rng.standard_normal(len(bias))
        bias = np.interp(-own, -odds, x)
    return bias


def _views(bench, pose, at, rng, noise):
    """Poses of the board in the cameras at recorded pitch angles, with errors."""
    true, head = [], at * (1 + bench.stretch)
    if bench.sigma_stop:  # one error for all cameras
        head = head + noise * bench.sigma_stop * rng.standard_normal(len(at))
    for camera in bench.cameras.values():
        turn = RigidTransform.from_rotation(Rotation.from_rotvec(np.outer(-head, [1.0, 0.0, 0.0])))
        back = bench.T_head_lrf.inv() * turn if bench.mount == "head" else turn * turn.inv()
        true.append((camera * back * pose).as_matrix())
    true = np.concatenate([*true, np.zeros((0, 4, 4))])
    drawn, covariance = _seen_poses(bench, true[:, :3], rng, noise)
    camera, pitch = np.repeat(np.arange(len(bench.cameras)), len(at)), np.tile(at, len(bench.cameras))
    pose = np.concatenate([drawn, true[:, 3:]], axis=1)
    return {"camera": camera, "pitch": pitch, "pose": pose, "covariance": covariance}


def draw_shots(setup, rng, trials, placements=20):
    """Draw calibration sessions of single shots: one scan line and one image a placement.

    Returns
    -------
    dict of ndarray
        ``T_camera_lrf`` (t, 3, 4), truth; ``ranges`` (t, p, B), metres, NaN off the board; ``lines`` (t, p, 2, 3) and
        ``edges`` (t, p, 2), undistorted image lines and numbers of the edges at the low and the high bearings;
        ``boards`` (t, p, 3, 4) and ``board_covariance`` (t, p, 6, 6), ``T_camera_board`` as the pattern shows it.

    Raises
    ------
    ValueError
        If hardly any board is crossed on two edges and seen by the camera.

    Notes
    -----
    A beam reads the board while its ray passes an edge line at less than `bias` radii outside, give or take the
    softness. Placements whose crossings come near a corner are drawn anew.
    """
    rotation = Rotation.from_rotvec(rng.normal(0, 0.03, (trials, 3))).as_matrix() @ AHEAD.as_matrix()
    centre = np.array([0.12, 0.03, 0.12]) + rng.normal(0, 0.01, (trials, 3))
    rig = np.concatenate([rotation, -rotation @ centre[..., None]], axis=-1)
    parts, missing = [], np.full(trials, placements)
    for _ in range(MOST_ROUNDS):
        who = np.repeat(np.arange(trials), 2 * missing)
        good, found = _candidates(setup, rng, rig[who])
        before = np.cumsum(good) - good
        rank = before - before[np.searchsorted(who, who)]  # among the good ones of its trial
        keep = good & (rank < missing[who])
        parts.append({"who": who[keep]} | {name: value[keep] for name, value in found.items()})
        missing = missing - np.bincount(who[keep], minlength=trials)
        if not missing.any():
            break
    else:
        raise ValueError(f"boards at {setup.distances} m are hardly ever crossed on two edges and seen by the camera")
    whole = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    order = np.argsort(whole.pop("who"), kind="stable")
    shaped = {name: value[order].reshape((trials, placements) + value.shape[1:]) for name, value in whole.items()}
    return {"T_camera_lrf": rig} | shaped


def _candidates(setup, rng, rig):
    """Which shots, one for each rig of a stack, are good, and the shots."""
    count, board, model, bearings = len(rig), setup.board, setup.model, setup.bearings()
    spin = rng.uniform(0, 2 * np.pi, (count, 1))[:, 0]
    turn = _facing(spin, rng.uniform(-0.6, 0.6, (count, 2))).as_matrix()
    away = rng.uniform(*setup.distances, count)
    centre = np.column_stack([rng.uniform(-0.35, 0.35, count) * away, away, rng.uniform(-0.12, 0.12, count)])
    shift = centre - turn @ np.append(board.corners.mean(axis=0), 0.0)
    u, ranges = _beside(board, -(shift[:, None] @ turn), polar_to_points(np.ones(len(bearings)), bearings) @ turn)
    radius = setup.radius(ranges)
    own = setup.spread * rng.standard_normal((count, 1, u.shape[-1])) if setup.spread else 0.0
    soft = (setup.bias + setup.softness * rng.standard_normal(ranges.shape)) * radius
    hit = (u - own * radius[..., None]).max(axis=-1) < soft
    hit &= ranges > 0
    ends = np.stack([hit.argmax(axis=1), hit.shape[1] - 1 - hit[:, ::-1].argmax(axis=1)], axis=1)
    across = np.take_along_axis(u / radius[..., None], ends[..., None], axis=1)
    edges = across.argmax(axis=-1)
    good = (hit.sum(axis=1) >= FEWEST_BEAMS) & (ends[:, 0] > 0) & (ends[:, 1] < hit.shape[1] - 1)
    good &= (edges[:, 0] != edges[:, 1]) & (np.sort(across, axis=-1)[..., -2] < -CLEAR).all(axis=1)
    pose = np.concatenate([rig[:, :, :3] @ turn, rig[:, :, :3] @ shift[..., None] + rig[:, :, 3:]], axis=-1)
    corners = board.corners @ np.swapaxes(pose[..., :2], 1, 2) + pose[:, None, :, 3]
    uv = pinhole(corners, model)
    good &= ((uv > 0) & (uv < [model.width, model.height])).all(axis=(1, 2)) & (corners[..., 2] > 0).all(axis=1)
    boards, covariance = _seen_poses(setup, pose, rng, 1.0)
    noisy = np.where(hit, ranges + setup.sigma_range * rng.standard_normal(ranges.shape), np.nan)
    lines = board.lines()[edges] @ np.linalg.inv(model.matrix @ pose[..., [0, 1, 3]])  # normals out of the board
    lines /= np.linalg.norm(lines[..., :2], axis=-1, keepdims=True)
    lines[..., 2] += setup.sigma_px * rng.standard_normal(edges.shape)
    return good, {"ranges": noisy, "lines": lines, "edges": edges, "boards": boards, "board_covariance": covariance}


def _facing(spin, lean):
    """Rotation of boards that face the LRF, leant about their x and y and then turned in their plane, radians."""
    lean, spin = np.asarray(lean), np.asarray(spin)
    leant = Rotation.from_rotvec(np.concatenate([lean, np.zeros(lean.shape[:-1] + (1,))], axis=-1))
    return AHEAD * leant * Rotation.from_rotvec(spin[..., None] * np.array([0, 0, 1.0]))


def _beside(board, origin, rays):
    """Distances between rays (board frame) and the lines of edges (..., E), positive outside; ranges to its plane."""
    ranges = -origin[..., 2] / rays[..., 2]
    at, lines = origin + ranges[..., None] * rays, board.lines()
    inside = at[..., :2] @ lines[:, :2].T + lines[:, 2]
    across = rays[..., :2] @ lines[:, :2].T  # ray along the edge's normal; its part along z is the other cosine
    return inside * np.abs(rays[..., 2:]) / np.hypot(across, rays[..., 2:]), ranges


def _seen_poses(devices, true, rng, noise):
    """Poses (n, 3, 4) of boards as their pattern tells them, and their covariances."""
    corners = CORNERS if devices.board.pattern is None else devices.board.pattern.points()
    turned = corners @ np.swapaxes(true[..., :3], -1, -2)
    points = turned + true[:, None, :, 3]
    by_point = project_jacobians(points.reshape(-1, 3), devices.model)[0].reshape(points.shape[:2] + (2, 3))
    J = np.concatenate([np.cross(turned[:, :, None], by_point), by_point], axis=-1)
    J = J.reshape(len(true), 2 * len(corners), 6)
    covariance = np.linalg.inv(np.swapaxes(J, -1, -2) @ J) * devices.sigma_px**2
    error = noise * (np.linalg.cholesky(covariance) @ rng.standard_normal((len(true), 6, 1)))[..., 0]
    rotation = Rotation.from_rotvec(error[:, :3]).as_matrix() @ true[..., :3]
    return np.concatenate([rotation, true[..., 3:] + error[:, 3:, None]], axis=-1), covariance
