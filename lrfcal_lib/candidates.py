"""Board poses that a rig could record next: a grid of them, and what LRF and cameras see of it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from lrfcal_lib.board import corners_of_lines
from lrfcal_lib.camera import project
from lrfcal_lib.geometry import tilt
from lrfcal_lib.solvers.pose import apply_pose, pose_transform
from lrfcal_lib.uncertainty import beams_to

FACING = np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])  # a board upright ahead of the LRF, its print towards it
LEANS = {"back": (-1, 0), "forward": (1, 0), "left": (0, -1), "right": (0, 1)}
MARGIN = 0.02  # of the image, that a board keeps from its border
STEEPEST = np.radians(60.0)  # incidence of beams and of lines of sight


@dataclass(frozen=True)
class Candidates:
    """Placements that could come next.

    Attributes
    ----------
    distance, bearing, elevation : ndarray, shape (n,)
        Of the board's middle from the LRF: metres, radians to the left and upwards.
    turn : ndarray, shape (n,)
        In the board's plane, anticlockwise as the rig sees it; 0 with the board's x to the right, radians.
    lean : ndarray, shape (n,)
        Out of the upright plane that faces the LRF, radians.
    towards : ndarray of str, shape (n,)
        'back' (the top farther away), 'forward', 'left', 'right'; '' upright.
    boards : ndarray, shape (n, 3, 4)
        ``T_platform_board``.
    pitches : ndarray, shape (n, k)
        Of the images, radians.
    """

    distance: np.ndarray
    bearing: np.ndarray
    elevation: np.ndarray
    turn: np.ndarray
    lean: np.ndarray
    towards: np.ndarray
    boards: np.ndarray
    pitches: np.ndarray

    def __len__(self):
        return len(self.distance)

    def take(self, rows):
        """Some of them."""
        return Candidates(**{name: value[rows] for name, value in vars(self).items()})


def board_grid(solution, distances, bearings, elevations, turns, leans):
    """All combinations of a grid of poses, visible or not.

    Parameters
    ----------
    solution : JointSolution
    distances, bearings, elevations, turns, leans : array_like
        See :class:`Candidates`; every lean above zero in four directions.

    Returns
    -------
    Candidates
        Without images.
    """
    poses = [(0.0, "")] * (0.0 in leans) + [(lean, way) for lean in leans if lean for way in LEANS]
    which = np.arange(len(poses))
    axes = np.meshgrid(distances, bearings, elevations, turns, which, indexing="ij")
    distance, bearing, elevation, turn, index = (a.ravel() for a in axes)
    lean = np.array([pose[0] for pose in poses])[index]
    towards = np.array([pose[1] for pose in poses])[index]
    way = np.array([LEANS.get(pose[1], (0, 0)) for pose in poses], float)[index]
    spin = Rotation.from_rotvec(turn[:, None] * [0.0, 0.0, 1.0])
    tip = Rotation.from_rotvec(np.column_stack([lean[:, None] * way, 0 * lean]))
    face = Rotation.from_euler("ZX", np.column_stack([bearing, elevation])) * Rotation.from_matrix(FACING) * tip * spin
    ahead = np.stack([-np.sin(bearing) * np.cos(elevation), np.cos(bearing) * np.cos(elevation), np.sin(elevation)], -1)
    middle = np.append(outline(solution).mean(axis=0), 0.0)
    head = solution.T_head_lrf
    rotation = (head.rotation * face).as_matrix()
    centre = head.apply(distance[:, None] * ahead)
    boards = np.concatenate([rotation, (centre - rotation @ middle)[..., None]], axis=-1)
    return Candidates(distance, bearing, elevation, turn, lean, towards, boards, np.zeros((len(distance), 0)))


def outline(solution):
    """Corners of the board, shape (e, 2), metres; with the sizes that were estimated."""
    lines = solution.data.lines.copy()
    lines[:, 2] -= solution.state.size
    return corners_of_lines(lines)


def visible(candidates, solution, models, field_of_view, pitch_limits, images):
    """Those whose board lies wholly in the view of LRF and cameras, with the pitch angles of their images.

    Parameters
    ----------
    candidates : Candidates
    solution : JointSolution
    models : dict of str to CameraModel
    field_of_view, pitch_limits : tuple of float
        First and last bearing, and pitch, radians.
    images : int
        Spread over the pitch angles at which every camera sees the board.

    Returns
    -------
    Candidates
    """
    corners = np.column_stack([outline(solution), np.zeros(len(solution.data.lines))])
    points = apply_pose(candidates.boards, corners)
    bearing, pitch, _ = beams_to(points, solution.T_head_lrf)
    inside = (bearing > field_of_view[0]) & (bearing < field_of_view[1])
    inside &= (pitch > pitch_limits[0]) & (pitch < pitch_limits[1])
    away = points - solution.T_head_lrf.translation
    normal = candidates.boards[:, None, :, 2]
    slant = -np.sum(away * normal, axis=-1) / np.linalg.norm(away, axis=-1)
    good = np.all(inside & (slant > np.cos(STEEPEST)), axis=1)
    candidates, points = candidates.take(good), points[good]
    lattice = np.linspace(*pitch_limits, max(3, 1 + round(np.ptp(pitch_limits) / np.radians(1.5))))
    seen = np.ones((len(points), len(lattice)), bool)
    for name in solution.transforms:
        seen &= _in_image(candidates, points, solution, name, models[name], lattice)
    some = seen.any(axis=1)
    low = lattice[np.argmax(seen[some], axis=1)]
    high = lattice[len(lattice) - 1 - np.argmax(seen[some][:, ::-1], axis=1)]
    images = images if any(solution.data.on_head) else 1
    share = np.linspace(0, 1, images) if images > 1 else np.array([0.5])
    pitches = low[:, None] + (high - low)[:, None] * share
    return replace(candidates.take(some), pitches=pitches)


def camera_poses(solution, name, pitch):
    """``T_camera_platform`` at pitch angles, as rotations (..., 3, 3) and translations (..., 3)."""
    number = list(solution.transforms).index(name)
    pose, head = solution.state.cameras[number], solution.state.head
    if not solution.data.on_head[number]:
        shape = np.shape(pitch)
        return np.broadcast_to(pose[:, :3], shape + (3, 3)), np.broadcast_to(pose[:, 3], shape + (3,))
    A = pose[:, :3] @ head[:, :3].T
    eye = np.broadcast_to(np.eye(3), np.shape(pitch) + (3, 3))
    back = np.swapaxes(tilt(eye, -np.asarray(pitch)[..., None]), -1, -2)
    return A @ back, np.broadcast_to(pose[:, 3] - A @ head[:, 3], np.shape(pitch) + (3,))


def _in_image(candidates, points, solution, name, model, lattice):
    """At which pitch angles a camera sees whole boards, shape (n, p)."""
    R, t = camera_poses(solution, name, lattice)
    p = np.einsum("pij,nkj->npki", R, points) + t[:, None, :]
    uv = project(p, model)
    # far outside the image the lens model folds back: only rays near the image count
    tangent = np.abs(p[..., :2] / np.where(p[..., 2:] > 0, p[..., 2:], np.nan))
    widest = 1.3 * np.array([model.width / model.fx, model.height / model.fy]) / 2
    border = MARGIN * np.array([model.width, model.height])
    inside = (uv > border) & (uv < [model.width, model.height] - border) & (tangent < widest)
    normal = np.einsum("pij,nj->npi", R, candidates.boards[:, :, 2])
    slant = -np.einsum("npki,npi->npk", p, normal) / np.linalg.norm(p, axis=-1)
    return np.all(inside.all(axis=-1) & (slant > np.cos(STEEPEST)), axis=2)


def own_placements(solution):
    """The placements of a solution as candidates, without images."""
    boards = solution.state.boards
    zero = np.zeros(len(boards))
    return Candidates(zero, zero, zero, zero, zero, np.full(len(boards), ""), boards, np.zeros((len(boards), 0)))


def placed(candidates, row):
    """``T_platform_board`` of a candidate."""
    return pose_transform(candidates.boards[row])


__all__ = ["Candidates", "board_grid", "camera_poses", "outline", "own_placements", "placed", "visible"]
