"""A scanner of the full circle at 0.5 to 1.1 m from 19 boards, one scan line and one image each: noise of 6 mm.

As in EdenShin/2D-Lidar_Camera_Calibration (a low-cost sensor with beams a degree apart), where random halves of the
placements and exchanged scans have ended in another minimum.
"""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from lrfcal_lib.model.camera import CameraModel
from lrfcal_lib.model.observations import CameraObservations, JointObservations

AHEAD = Rotation.from_matrix([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
FACING = Rotation.from_euler("x", 180, degrees=True)
COUNT = 19
NOISE = 0.006  # placements, metres
FEWEST_BEAMS = 9
ARRIVING = 0.8  # on a board; share of the beams that come back
HALF_BOARD = np.array([0.15, 0.20])  # metres


def near_scanner(rng, lean):
    """``T_camera_lrf`` and a CameraObservations of boards that lean by up to `lean` radians two ways."""
    T_camera_lrf = RigidTransform.from_components(
        rng.normal(0, 0.06, 3), Rotation.from_rotvec(rng.normal(0, 0.1, 3)) * AHEAD
    )
    bearings = np.radians(np.arange(0.0, 360.0))
    rays = np.stack([np.cos(bearings), np.sin(bearings), 0 * bearings], axis=1)
    points = []
    boards = []
    while len(boards) < COUNT:
        leant = Rotation.from_rotvec([*rng.uniform(-lean, lean, 2), 0.0])
        turn = (
            AHEAD.inv() * leant * Rotation.from_euler("z", rng.uniform(-0.3, 0.3)) * FACING
        )
        away = rng.uniform(0.5, 1.1)
        centre = np.array([rng.uniform(-0.25, 0.25) * away, away, rng.uniform(-0.08, 0.08)])
        T_lrf_board = RigidTransform.from_components(centre, turn)
        normal = turn.as_matrix()[:, 2]
        ranges = (normal @ centre) / (rays @ normal)
        on_board = T_lrf_board.inv().apply(ranges[:, None] * rays)[:, :2]
        hit = (ranges > 0) & (np.abs(on_board) < HALF_BOARD).all(axis=1)
        if hit.sum() < FEWEST_BEAMS:
            continue
        hit &= rng.random(len(hit)) < ARRIVING
        measured = ranges[hit] + NOISE * rng.standard_normal(hit.sum())
        points.append(measured[:, None] * rays[hit])
        boards.append((T_camera_lrf * T_lrf_board).as_matrix())
    numbers = np.arange(1, COUNT + 1)
    return T_camera_lrf, CameraObservations(
        CameraModel(640, 480, 500.0, 500.0, 320.0, 240.0),
        plane_points=np.concatenate(points),
        plane_covariance=np.tile(NOISE**2 * np.eye(3), (sum(map(len, points)), 1, 1)),
        plane_placement=np.repeat(numbers, [len(p) for p in points]),
        placements=numbers,
        board_poses=np.array(boards),
    )


def with_scans_exchanged(obs, rng, count=4):
    """The observations with the scans of some placements passed round among these."""
    some = rng.permutation(obs.placements)[:count]
    placement = obs.plane_placement.copy()
    for before, after in zip(some, np.roll(some, 1), strict=True):
        placement[obs.plane_placement == before] = after
    order = np.argsort(placement, kind="stable")
    return replace(
        obs, plane_placement=placement[order], plane_points=obs.plane_points[order]
    )


def as_rig(obs):
    """The same for the joint estimate: a camera on a head that never pitches."""
    n = len(obs.placements)
    points = obs.plane_points
    return JointObservations(
        placements=obs.placements,
        edges=("bottom", "right", "top", "left"),
        corners=np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]]) * HALF_BOARD,
        cameras=("camera",),
        mounts=("head",),
        T_head_lrf=RigidTransform.identity(),
        face_range=np.linalg.norm(points, axis=1),
        face_bearing=np.arctan2(points[:, 1], points[:, 0]),
        face_pitch=np.zeros(len(points)),
        face_sigma=np.full(len(points), NOISE),
        face_placement=np.searchsorted(obs.placements, obs.plane_placement),
        view_camera=np.zeros(n, int),
        view_pitch=np.zeros(n),
        view_pose=obs.board_poses,
        view_covariance=np.tile(1e-6 * np.eye(6), (n, 1, 1)),
        view_placement=np.arange(n),
    )
