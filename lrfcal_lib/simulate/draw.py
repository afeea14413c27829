"""Single shots of boards drawn directly from the beam's and the camera's noise, for Monte-Carlo trials by the hundred.

Plain arrays; it knows no solver.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

from lrfcal_lib.board import Board, Chessboard, triangle_board
from lrfcal_lib.camera import CameraModel, pinhole, pinhole_jacobian
from lrfcal_lib.geometry import polar_to_points

AHEAD = np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])  # a camera that looks along y of the LRF
FACING = Rotation.from_matrix(AHEAD)  # board axes of a board that faces the LRF
CLEAR = 1.3  # spot radii between a crossing and a second edge
FEWEST_BEAMS = 8
MOST_ROUNDS = 200


def _board():
    return triangle_board(pattern=Chessboard(4, 5, 0.029, (0.03885, 0.03885)))


def _camera():
    return CameraModel(1280, 960, 1000.0, 1000.0, 639.5, 479.5, np.zeros(5))


@dataclass(frozen=True)
class ShotSetup:
    """What single shots are drawn from: the paper's devices.

    Attributes
    ----------
    step : float
        Between beams, radians.
    spot : tuple of float
        Diameter at the window (metres) and its growth (radians).
    sigma_range : float
        Metres.
    sigma_px : float
        Of an image line across itself, and of one coordinate of a pattern corner.
    bias : float
        How far outside an edge the centre of a spot still reads the board, in spot radii.
    softness : float
        Standard deviation of that from beam to beam, in spot radii.
    distances : tuple of float
        Of the board, metres.
    board : Board
        With a pattern.
    model : CameraModel
    """

    step: float = np.radians(0.5)
    spot: tuple[float, float] = (0.016, 0.0119)
    sigma_range: float = 0.010
    sigma_px: float = 0.3
    bias: float = 0.0
    softness: float = 0.03
    distances: tuple[float, float] = (1.0, 2.5)
    board: Board = field(default_factory=_board)
    model: CameraModel = field(default_factory=_camera)

    def bearings(self):
        """From 40 to 140 deg, radians, shape (B,)."""
        return np.radians(40) + self.step * np.arange(int(np.radians(100) / self.step + 1.5))

    def radius(self, ranges):
        """Of the spot, metres."""
        return (self.spot[0] + self.spot[1] * ranges) / 2


def draw_shots(setup, rng, trials, placements=20):
    """Draw calibration sessions of single shots: one scan line and one image a placement.

    Parameters
    ----------
    setup : ShotSetup
    rng : numpy.random.Generator
    trials, placements : int

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
    rig = _rigs(rng, trials)
    parts, missing = [], np.full(trials, placements)
    for _ in range(MOST_ROUNDS):
        who = np.repeat(np.arange(trials), 2 * missing)
        found = _candidates(setup, rng, rig[who])
        good = found.pop("good")
        rank = _rank(who, good)
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


def _rank(who, good):
    """Number of each good candidate among those of its trial."""
    count = np.cumsum(good) - good
    first = np.searchsorted(who, np.arange(who.max(initial=0) + 1))
    return count - count[first][who]


def _rigs(rng, trials):
    rotation = Rotation.from_rotvec(rng.normal(0, 0.03, (trials, 3))).as_matrix() @ AHEAD
    centre = np.array([0.12, 0.03, 0.12]) + rng.normal(0, 0.01, (trials, 3))
    return np.concatenate([rotation, -rotation @ centre[..., None]], axis=-1)


def _poses(setup, rng, count):
    """``T_lrf_board`` of boards that the scan plane cuts through: rotations and translations."""
    spin = Rotation.from_rotvec(np.array([0, 0, 1.0]) * rng.uniform(0, 2 * np.pi, (count, 1)))
    lean = Rotation.from_rotvec(np.column_stack([rng.uniform(-0.6, 0.6, (count, 2)), np.zeros(count)]))
    rotation = (FACING * lean * spin).as_matrix()
    away = rng.uniform(*setup.distances, (count, 1))
    centre = np.column_stack([rng.uniform(-0.35, 0.35, count), np.ones(count), np.zeros(count)]) * away
    centre[:, 2] = rng.uniform(-0.12, 0.12, count)
    middle = np.append(setup.board.corners.mean(axis=0), 0.0)
    return rotation, centre - rotation @ middle


def _candidates(setup, rng, rig):
    """One shot for each rig of a stack, and whether it is a good one."""
    rotation, translation = _poses(setup, rng, len(rig))
    u, ranges = _distances(setup, rotation, translation)
    radius = setup.radius(ranges)
    jitter = setup.softness * rng.standard_normal(ranges.shape)
    hit = (u.max(axis=-1) < (setup.bias + jitter) * radius) & (ranges > 0)
    first, last = hit.argmax(axis=1), hit.shape[1] - 1 - hit[:, ::-1].argmax(axis=1)
    ends, rows = np.stack([first, last], axis=1), np.arange(len(hit))[:, None]
    at = np.sort(u[rows, ends] / radius[rows, ends][..., None], axis=-1)
    edges = u[rows, ends].argmax(axis=-1)
    good = (hit.sum(axis=1) >= FEWEST_BEAMS) & (first > 0) & (last < hit.shape[1] - 1) & (edges[:, 0] != edges[:, 1])
    good &= (at[..., -2] < -CLEAR).all(axis=1)
    pose = np.concatenate([rig[:, :, :3] @ rotation, rig[:, :, :3] @ translation[..., None] + rig[:, :, 3:]], axis=-1)
    seen, boards, covariance = _pictures(setup, rng, pose)
    noisy = np.where(hit, ranges + setup.sigma_range * rng.standard_normal(ranges.shape), np.nan)
    lines = _image_lines(setup, rng, pose, edges)
    shot = {"ranges": noisy, "lines": lines, "edges": edges, "boards": boards, "board_covariance": covariance}
    return shot | {"good": good & seen}


def _distances(setup, rotation, translation):
    """Distances between rays and edge lines (n, B, E), positive outside, and ranges of the board's plane (n, B)."""
    rays = polar_to_points(np.ones(len(setup.bearings())), setup.bearings()) @ rotation
    origin = -np.sum(translation[:, :, None] * rotation, axis=1)
    ranges = -origin[:, None, 2] / rays[..., 2]
    at = origin[:, None] + ranges[..., None] * rays
    lines = setup.board.lines()
    inside = at[..., :2] @ lines[:, :2].T + lines[:, 2]
    across = rays[..., :2] @ lines[:, :2].T  # ray along the edge's normal; its part along z is the other cosine
    return inside * np.abs(rays[..., 2:]) / np.hypot(across, rays[..., 2:]), ranges


def _pictures(setup, rng, pose):
    """Whether the whole board is in the image, and the poses that its pattern tells, with their covariances."""
    board, model = setup.board, setup.model
    corners = pose[:, None, :, :2] @ board.corners[..., None] + pose[:, None, :, 3:]
    uv = pinhole(corners[..., 0], model)
    seen = ((uv > 0) & (uv < [model.width, model.height])).all(axis=(1, 2)) & (corners[:, :, 2, 0] > 0).all(axis=1)
    turned = board.pattern.points() @ np.swapaxes(pose[..., :3], -1, -2)
    by_point = pinhole_jacobian(turned + pose[:, None, :, 3], model)
    by_turn = np.cross(turned[:, :, None], by_point)
    J = np.concatenate([by_turn, by_point], axis=-1).reshape(len(pose), -1, 6)
    covariance = np.linalg.inv(np.swapaxes(J, -1, -2) @ J) * setup.sigma_px**2
    error = (np.linalg.cholesky(covariance) @ rng.standard_normal((len(pose), 6, 1)))[..., 0]
    rotation = Rotation.from_rotvec(error[:, :3]).as_matrix() @ pose[..., :3]
    return seen, np.concatenate([rotation, pose[..., 3:] + error[:, 3:, None]], axis=-1), covariance


def _image_lines(setup, rng, pose, edges):
    """Image lines (n, 2, 3) of two edges a board, shifted by their noise; unit normals point out of the board."""
    homography = setup.model.matrix @ pose[..., [0, 1, 3]]
    lines = setup.board.lines()[edges] @ np.linalg.inv(homography)
    lines /= np.linalg.norm(lines[..., :2], axis=-1, keepdims=True)
    lines[..., 2] += setup.sigma_px * rng.standard_normal(edges.shape)
    return lines
