"""Start values of the joint estimate from closed forms: cameras from planes, the axis from how
the cameras turn.
"""

from collections.abc import Iterator
from contextlib import suppress

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from lrfcal_lib.model import geometry
from lrfcal_lib.model.geometry import (
    DegenerateGeometry,
    polar_to_points,
    pose_array,
    pose_transform,
)
from lrfcal_lib.model.kinematics import TILT_AXIS, SourceFrame
from lrfcal_lib.model.observations import CameraObservations, JointObservations, thin
from lrfcal_lib.solvers.joint_model import JointState
from lrfcal_lib.solvers.plane_start import start_from_planes

START_SOFTNESS = 0.2  # spot radii
LEAST_TURN = np.radians(1.0)  # between two images of a camera for the axis
SAME_PITCH = np.radians(0.6)  # scan lines so near the pitch of an image are used with it
POINTS = 30  # a plane
VIEWS = 24  # a camera; closed forms do not get much better with more
FEWEST_VIEWS = 5


def start_states(obs: JointObservations) -> Iterator[list[JointState]]:
    """Start values to choose from, made one by one: each with those of the cameras' other minima.

    From the closed form of the axis, from the stated platform, from an axis along x
    through the mirror; with cameras from scan lines at the pitch of their images, or else from
    whole sweeps. Raises DegenerateGeometry when no placement gives the pose of a board.
    """
    if len(obs.face_range) == 0:
        raise DegenerateGeometry(
            "no ranges on the boards' faces: a start value needs them; give one as start="
        )
    direct = {}
    for camera, mount in enumerate(obs.mounts):
        if mount == "head":
            with suppress(DegenerateGeometry):
                direct[camera] = _camera(obs, camera)
    heads = [_axis_from_cameras(obs, direct), obs.T_head_lrf, RigidTransform.identity()]
    possible = False
    reasons = []
    for head in heads:
        if head is None:
            continue
        try:
            states = _states(obs, head, direct)
        except (DegenerateGeometry, np.linalg.LinAlgError) as error:
            reasons.append(str(error))
            continue
        possible = True
        yield states
    if not possible:
        every = "; ".join(dict.fromkeys(reasons))
        raise DegenerateGeometry(f"no start value for the joint estimate: {every}")


def _states(obs, head, known):
    """States with an axis: with the best pose of every camera, then with each other one of one
    camera. Poses of some are `known`.
    """
    minima = []
    for camera in range(len(obs.cameras)):
        minima.append(known[camera] if camera in known else _camera(obs, camera, head))
    best = [poses[0] for poses in minima]
    states = [state_of(obs, head, best)]
    for camera, poses in enumerate(minima):
        for pose in poses[1:]:
            states.append(state_of(obs, head, [*best[:camera], pose, *best[camera + 1 :]]))
    return states


def _camera(obs, camera, head=None):
    """Poses of a camera, the best one first, from its views of boards and points on these.

    From whole sweeps, joined by a roughly known axis; of a camera on the head also from scan lines
    at the pitch of its images, which needs no axis.
    """
    name = obs.cameras[camera]
    mine = np.flatnonzero(obs.view_camera == camera)
    if head is not None:
        mine = mine[np.unique(obs.view_placement[mine], return_index=True)[1]]
    views = []
    points = []
    for view in thin(mine, VIEWS):
        pitch = obs.view_pitch[view]
        rows = np.flatnonzero(obs.face_placement == obs.view_placement[view])
        if head is None:
            away = np.abs(obs.face_pitch[rows] - pitch)
            rows = rows[away <= min(away.min(initial=SAME_PITCH) + 1e-9, SAME_PITCH)]
        if len(rows) == 0:
            continue
        rows = thin(rows, POINTS)
        p = polar_to_points(obs.face_range[rows], obs.face_bearing[rows])
        if head is not None:
            frame = SourceFrame(head, obs.mounts[camera], pitch)
            p = frame.apply(p, obs.face_pitch[rows])
        points.append(p)
        views.append(view)
    if len(views) < (1 if head is not None else FEWEST_VIEWS):
        raise DegenerateGeometry(f"camera '{name}' never sees a board that the scans hit")
    seen = CameraObservations(
        None,
        name,
        plane_points=np.concatenate(points),
        plane_placement=np.repeat(np.arange(len(views)), [len(p) for p in points]),
        board_poses=obs.view_pose[views],
        board_covariance=obs.view_covariance[views],
    )
    return start_from_planes(seen)


def _axis_from_cameras(obs, poses):
    """The tilt axis from how a fixed board turns in the images of a camera that pitches, by
    least squares.
    """
    for camera, (T_camera_lrf, *_) in poses.items():
        views = np.flatnonzero(obs.view_camera == camera)
        views = views[np.lexsort((obs.view_pitch[views], obs.view_placement[views]))]
        placements = obs.view_placement[views]
        first = views[np.searchsorted(placements, np.unique(placements))]
        last = views[np.searchsorted(placements, np.unique(placements), side="right") - 1]
        turns = obs.view_pitch[last] - obs.view_pitch[first]
        if turns.max() <= LEAST_TURN:
            continue
        # the motions T_2 T_1^-1 are turns by -angle about one line in the camera
        T_camera_board = RigidTransform.from_matrix(obs.view_pose)
        motions = T_camera_board[last] * T_camera_board[first].inv()
        lrf = T_camera_lrf.inv()
        direction = lrf.rotation.apply(-turns @ motions.rotation.as_rotvec())
        A = (np.eye(3) - motions.rotation.as_matrix()).reshape(-1, 3)
        point = np.linalg.lstsq(A, motions.translation.ravel(), rcond=1e-3)[0]
        direction /= np.linalg.norm(direction)
        return geometry.head_from_axis(geometry.TiltAxis(direction, lrf.apply(point)))
    return None


def state_of(
    obs: JointObservations, head: RigidTransform, cameras: list[RigidTransform]
) -> JointState:
    """All unknowns from an axis and the cameras: boards from their first images."""
    poses = np.array([pose_array(T) for T in cameras])
    count = len(obs.placements)
    _, first = np.unique(obs.view_placement, return_index=True)
    boards = boards_in_images(obs, pose_array(head), poses, first)
    return JointState(
        head=pose_array(head),
        cameras=poses,
        sensor=np.array([0.0, 0.0, np.log(START_SOFTNESS), 0.0, 0.0]),
        boards=boards,
        sweeps=np.zeros((count, 2)),
        sides=np.zeros((count, len(obs.edges))),
    )


def boards_in_images(
    obs: JointObservations, head: np.ndarray, cameras: np.ndarray, views: np.ndarray
) -> np.ndarray:
    """``T_platform_board`` (n, 3, 4) from some views (n,), each by itself.

    `head` and `cameras` as in JointState.
    """
    camera = obs.view_camera[views]
    on_head = np.array([mount == "head" for mount in obs.mounts])[camera]
    pitch = np.where(on_head, obs.view_pitch[views], 0.0)
    turn = RigidTransform.from_rotation(Rotation.from_rotvec(np.outer(pitch, TILT_AXIS)))
    T_head_lrf = pose_transform(np.where(on_head[:, None, None], head, np.eye(3, 4)))
    T_camera_board = RigidTransform.from_matrix(obs.view_pose[views])
    boards = turn * T_head_lrf * pose_transform(cameras[camera]).inv() * T_camera_board
    return pose_array(boards)
