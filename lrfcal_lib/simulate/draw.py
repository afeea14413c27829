"""Observations drawn directly from the noise models of beam, platform and cameras, without images.

A session of :mod:`lrfcal_lib.simulate.record` takes minutes; this takes milliseconds, for
Monte-Carlo trials by the hundred. It returns plain arrays and knows no solver. Single shots are in
:mod:`lrfcal_lib.simulate.shots`.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import maximum_filter1d
from scipy.spatial.transform import RigidTransform, Rotation
from scipy.special import logit

from lrfcal_lib.fit.edge_likelihood import disc_edge, disc_share
from lrfcal_lib.model.board import Board, triangle_board
from lrfcal_lib.model.camera import CameraModel, pinhole, project_jacobians
from lrfcal_lib.model.geometry import (
    AHEAD,
    apply_pose,
    bearings_of,
    carry,
    gradient_by_pose,
    move_pose,
    polar_to_points,
    pose_array,
    rotate_and_move,
)
from lrfcal_lib.model.kinematics import camera_at

# corners of a pattern that fills the triangle, metres, where the board has none
PLACES = [(i, j, 0) for i in range(5) for j in range(6) if i + j < 7]
CORNERS = np.array([0.04, 0.04, 0.0]) + 0.03 * np.array(PLACES)
MARGIN = 6  # beams beyond the board
REACH = 2  # beams kept on either side of an edge, along and across the scan lines


@dataclass(frozen=True, kw_only=True)
class Devices:
    """What beam and camera are, and how noisy."""

    model: CameraModel = CameraModel(1280, 960, 1e3, 1e3, 639.5, 479.5)
    # A board without a pattern is seen as one with 23 corners
    board: Board = triangle_board()
    step: float = np.radians(0.5)  # between beams, radians
    # diameter at the window (metres) and its growth (radians)
    spot: tuple[float, float] = (0.016, 0.0119)
    sigma_range: float = 0.010  # metres
    # of an image line across itself, and of one coordinate of a pattern corner
    sigma_px: float = 0.3
    # how far outside an edge the centre of a spot still reads the board, in spot radii
    bias: float = 0.0
    softness: float = 0.1  # standard deviation of that from beam to beam, in spot radii
    # least softness, in beam steps; real edges have none, the model of the joint estimate has
    floor: float = 0.0
    # uneven backgrounds: standard deviation of the edge from side to side, in log odds (of a
    # Bench), or of its bias in spot radii (of single shots)
    spread: float = 0.0

    def radius(self, ranges):
        """Of the spot, metres."""
        return (self.spot[0] + self.spot[1] * ranges) / 2

    def least_softness(self, ranges):
        """Standard deviation, in spot radii."""
        return self.floor * self.step * ranges / self.radius(ranges)

    def beside(self, pose, rays):
        """How far rays (LRF frame, (..., B, 3)) pass outside the lines of the edges of boards at
        poses ``T_lrf_board`` (..., 3, 4): spot radii (..., B, E).

        And the ranges (..., B) to the planes of the boards.
        """
        R = pose[..., :3]
        rays = rays @ R
        origin = -pose[..., None, :, 3] @ R
        ranges = -origin[..., 2] / rays[..., 2]
        at = origin + ranges[..., None] * rays
        lines = self.board.lines()
        normals = lines[:, :2].T
        inside = at[..., :2] @ normals + lines[:, 2]
        # ray along the edge's normal; its part along z is the other cosine
        across = rays[..., :2] @ normals
        z = rays[..., 2:]
        spot = self.radius(np.abs(ranges))[..., None]
        return inside * np.abs(z) / np.hypot(across, z) / spot, ranges


@dataclass(frozen=True)
class Bench(Devices):
    """Truth and noise of a rig to draw observations from; see also :class:`Devices`."""

    T_head_lrf: RigidTransform
    cameras: dict  # T_camera_lrf (mount 'head') or T_camera_platform
    mount: str = "head"  # one of head, platform
    pitch_step: float = np.radians(0.5)  # between scan lines, radians
    range_offset: float = 0.0  # metres
    stretch: float = 0.0  # of the recorded pitch: the head turns 1 + stretch times as far
    # standard deviation of the recorded pitch at the stop of an image, radians
    sigma_stop: float = 0.0


def bench(
    rng: np.random.Generator, cameras: Sequence[str] = ("left", "right"), **settings
) -> Bench:
    """A rig like the paper's, mounted wrongly by some degrees and centimetres.

    Parameters
    ----------
    rng : numpy.random.Generator
    cameras : sequence of str
        Their names.
    **settings
        Other attributes of :class:`Bench`.
    """
    turn = Rotation.from_rotvec([0.0, *rng.normal(0, 0.02, 2)])
    head = RigidTransform.from_components([0.0, *rng.normal(0, 0.05, 2)], turn)
    # the first camera on the left
    poses = {name: upright_camera(rng, 2 * i - 1) for i, name in enumerate(cameras)}
    return Bench(head, poses, **settings)


def upright_camera(rng, side, *shape):
    """Poses ``T_camera_lrf`` of cameras beside the LRF, left (-1) or right, mounted wrongly."""
    rotation = Rotation.from_rotvec(rng.normal(0, 0.03, (*shape, 3))) * AHEAD
    centre = rng.normal([0.12 * side, 0.03, 0.12], 0.01, (*shape, 3))
    return carry(rotation, centre)


def board_poses(
    rng: np.random.Generator, count: int, distances: tuple[float, float] = (1.0, 2.5)
) -> list[RigidTransform]:
    """Poses ``T_platform_board`` of boards ahead of the rig, facing it, turned in their plane.

    Parameters
    ----------
    rng : numpy.random.Generator
    count : int
    distances : tuple of float
        Least and largest, metres.
    """
    least, most = distances
    # turn in the plane, radians; lean about x and y, radians; to the right and up, of the distance
    low = [0.0, -0.6, -0.6, -0.35, -0.1, least]
    high = [2 * np.pi, 0.6, 0.6, 0.35, 0.1, most]
    spin, *lean, right, up, away = rng.uniform(low, high, (count, 6)).T
    centre = np.column_stack([right * away, away, up * away])
    return list(posed(spin, np.transpose(lean), centre, [0.105, 0.127, 0.0]))


def observe(
    bench: Bench,
    poses: Sequence[RigidTransform],
    rng: np.random.Generator,
    *,
    images: int = 3,
    span: float | None = None,
    noise: float = 1.0,
) -> dict:
    """Draw what the rig records of boards.

    Parameters
    ----------
    bench : Bench
    poses : sequence of RigidTransform
        ``T_platform_board``.
    rng : numpy.random.Generator
    images : int
        Images of each camera a placement, spread over the sweep.
    span : float, optional
        Pitch range of a sweep, radians; as far as the board reaches when left out. 0 is a single
        shot through the board's middle.
    noise : float
        Scales all errors; 0 gives exact observations (the edges stay quantised by the beams).

    Returns
    -------
    dict
        Keyword arguments of :class:`lrfcal_lib.model.observations.JointObservations`.
    """
    parts = []
    for number, pose in enumerate(poses):
        pitch, T_lrf_board, bearings = _grid(bench, pose, span)
        drawn = _scan_lines(bench, T_lrf_board, pitch, bearings, rng, noise)
        between = np.linspace(pitch[0], pitch[-1], images + 2)[1:-1]
        drawn |= _views(bench, pose, between, rng, noise)
        for kind in ("face", "beam", "view"):
            drawn[f"{kind}_placement"] = np.full(len(drawn[f"{kind}_pitch"]), number)
        drawn["middle"] = [pitch.mean()]
        parts.append(drawn)
    count = len(poses)
    return end_to_end(parts) | {
        "placements": np.arange(1, count + 1),
        "direction": np.resize([1, -1], count) * (span != 0),
        "edges": bench.board.edges,
        "corners": bench.board.known_corners(),
        "cameras": tuple(bench.cameras),
        "mounts": (bench.mount,) * len(bench.cameras),
    }


def end_to_end(parts):
    """Parts of a table, columns by name, as one."""
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def _grid(bench, pose, span):
    """Recorded pitch of the scan lines over a board, and bearings of the beams about it."""
    points = bench.board.points()
    p = pose.apply(points)
    up = np.arctan2(p[:, 2], p[:, 1])
    _, ahead, above = p.mean(axis=0)
    middle = np.arctan2(above, ahead)
    if span is None:
        span = 2 * (np.abs(up - middle).max() + 6 * bench.pitch_step)
    steps = int(span / 2 / bench.pitch_step)
    pitch = middle + bench.pitch_step * np.arange(-steps, steps + 1)
    true = pitch * (1 + bench.stretch)
    T_lrf_platform = camera_at(RigidTransform.identity(), "head", bench.T_head_lrf, true)
    T_lrf_board = pose_array(T_lrf_platform * pose)
    bearing = bearings_of(apply_pose(T_lrf_board, points))
    first = round(bearing.min() / bench.step) - MARGIN
    last = round(bearing.max() / bench.step) + MARGIN
    return pitch, T_lrf_board, bench.step * np.arange(first, last + 1)


def _scan_lines(bench, T_lrf_board, pitch, bearings, rng, noise):
    """Readings of the face, and the beams about where readings change to the background."""
    radii, r = bench.beside(T_lrf_board, polar_to_points(1.0, bearings))
    sensible = (r > 0.2) & (r < 30)
    edge = radii.argmax(axis=-1)
    soft = np.hypot(bench.softness, bench.least_softness(r))
    jitter = noise * soft * rng.standard_normal(r.shape)
    bias = np.full(radii.shape[-1], bench.bias)  # of each edge
    if bench.spread:
        bias, _ = disc_edge(rng.normal(logit(disc_share(bias)), bench.spread))
    hit = (radii.max(axis=-1) + jitter < bias[edge]) & sensible
    # near to an edge across the scan lines, and along them
    across, along = (
        maximum_filter1d(
            np.diff(hit, axis=axis, append=hit.take([-1], axis)),
            2 * REACH,
            axis,
            mode="constant",
        )
        for axis in (0, 1)
    )
    alone = np.sort(radii, axis=-1)[..., -2] <= -2  # elsewhere two edges cut the spot
    row, b = np.nonzero((across | along) & alone & sensible)
    beam_range = r[row, b]
    step = np.where(along[row, b], bench.step, bench.pitch_step)
    line, beam = np.nonzero(hit)
    faces = r[line, beam] + bench.range_offset
    return {
        "face_range": rng.normal(faces, noise * bench.sigma_range),
        "face_bearing": bearings[beam],
        "face_pitch": pitch[line],
        "face_sigma": np.full(len(line), bench.sigma_range),
        "beam_bearing": bearings[b],
        "beam_pitch": pitch[row],
        "beam_hit": hit[row, b],
        "beam_edge": edge[row, b],
        "beam_radius": bench.radius(beam_range),
        "beam_step": step * beam_range,
    }


def _views(bench, pose, at, rng, noise):
    """Poses of the board in the cameras at recorded pitch angles, with errors."""
    pitch = at * (1 + bench.stretch)  # of the head
    if bench.sigma_stop:  # one error for all cameras
        pitch = rng.normal(pitch, noise * bench.sigma_stop)
    still = RigidTransform.identity(len(pitch))
    T_source_platform = camera_at(still, bench.mount, bench.T_head_lrf, pitch)
    cameras = bench.cameras.values()
    poses = np.concatenate(
        [(camera * T_source_platform * pose).as_matrix() for camera in cameras]
    )
    poses[:, :3], covariance, _ = seen_poses(bench, poses[:, :3], rng, noise)
    return {
        "view_camera": np.repeat(np.arange(len(cameras)), len(at)),
        "view_pitch": np.tile(at, len(cameras)),
        "view_pose": poses,
        "view_covariance": covariance,
    }


def posed(spin, lean, centre, middle):
    """Poses of boards with their middle (board frame) at a centre (n, 3), which face the LRF but
    for a lean (n, 2) about x and y, and are turned in their plane by a spin (n,).
    """
    leant = np.column_stack([lean, 0 * spin])
    facing = AHEAD * Rotation.from_rotvec(leant) * Rotation.from_euler("z", spin[:, None])
    return carry(facing, middle, centre)


def seen_poses(devices, true, rng, noise):
    """Poses (n, 3, 4) of boards as their pattern tells them, their covariances, and the pixels
    (n, c, 2) of the pattern's corners behind them.
    """
    pattern = devices.board.pattern
    corners = CORNERS if pattern is None else pattern.points()
    turned, points = rotate_and_move(true, corners)
    by_point = project_jacobians(points, devices.model)[0]
    J = gradient_by_pose(turned[:, :, None], by_point).reshape(len(true), -1, 6)
    inverse = np.linalg.inv(J.mT @ J)
    errors_px = noise * devices.sigma_px * rng.standard_normal(J.shape[:2])
    pixels = pinhole(points, devices.model) + errors_px.reshape(len(true), -1, 2)
    poses = move_pose(true, np.matvec(inverse @ J.mT, errors_px))
    return poses, inverse * devices.sigma_px**2, pixels
