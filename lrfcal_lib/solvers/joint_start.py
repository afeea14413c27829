"""Start values of the joint estimate: cameras from planes, about the stated axis.

Equations (4) to (6) and (16).
"""

from collections.abc import Iterator

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from lrfcal_lib.model.geometry import (
    DegenerateGeometry,
    polar_to_points,
    pose_array,
    pose_transform,
)
from lrfcal_lib.model.kinematics import SourceFrame, platform_from_head
from lrfcal_lib.model.observations import CameraObservations, JointObservations, thin
from lrfcal_lib.solvers.joint_model import JointState, undisturbed
from lrfcal_lib.solvers.plane_start import start_from_planes

START_SOFTNESS = 0.2  # spot radii
POINTS = 30  # a plane
VIEWS = 24  # a camera; closed forms do not get much better with more


def start_states(obs: JointObservations, axis: bool = True) -> Iterator[list[JointState]]:
    """Start values to choose from, made one by one: each with those of the cameras' other minima.

    From the stated platform, then from an axis along x through the mirror, which may turn
    backwards; with cameras from the planes of whole sweeps. Where the axis is no unknown, only the
    first. Raises DegenerateGeometry when no
    placement gives the pose of a board.
    """
    if len(obs.face_range) == 0:
        raise DegenerateGeometry(
            "no ranges on the boards' faces: a start value needs them; give one as start="
        )
    backwards = Rotation.from_euler("z", np.pi)
    heads = [RigidTransform.identity(), RigidTransform.from_rotation(backwards)]
    if obs.T_head_lrf is not None:
        heads.insert(0, obs.T_head_lrf)
    if not axis:
        heads = heads[:1]
    reasons = []
    for head in heads:
        try:
            yield _states(obs, head)
        except (DegenerateGeometry, np.linalg.LinAlgError) as error:
            reasons.append(str(error))
    if len(reasons) == len(heads):
        every = "; ".join(dict.fromkeys(reasons))
        raise DegenerateGeometry(f"no start value for the joint estimate: {every}")


def _states(obs, head):
    """States with an axis: with the best pose of every camera, then with each other one of one
    camera.
    """
    minima = [_camera(obs, camera, head) for camera in range(len(obs.cameras))]
    best = np.array([poses[0] for poses in minima])
    choices = [best]
    for camera, poses in enumerate(minima):
        for pose in poses[1:]:
            other = best.copy()
            other[camera] = pose
            choices.append(other)
    return [state_of(obs, pose_array(head), cameras) for cameras in choices]


def _camera(obs, camera, head):
    """Poses of a camera, the best one first, from its first views of boards and the sweeps over
    these, joined by a roughly known axis.
    """
    name = obs.cameras[camera]
    mine = np.flatnonzero(obs.view_camera == camera)
    first = mine[np.unique(obs.view_placement[mine], return_index=True)[1]]
    views = thin(first, VIEWS)
    placements = obs.view_placement[views]
    rows = np.concatenate(
        [thin(np.flatnonzero(obs.face_placement == p), POINTS) for p in placements]
    )
    if len(rows) == 0:
        raise DegenerateGeometry(f"camera '{name}' never sees a board that the scans hit")
    image = views[np.searchsorted(placements, obs.face_placement[rows])]
    frame = SourceFrame(head, obs.mounts[camera], obs.view_pitch[image])
    p_lrf = polar_to_points(obs.face_range[rows], obs.face_bearing[rows])
    seen = CameraObservations(
        None,
        name,
        plane_points=frame.points(p_lrf, obs.face_pitch[rows]),
        plane_placement=obs.face_placement[rows],
        placements=placements,
        board_poses=obs.view_pose[views],
        board_covariance=obs.view_covariance[views],
    )
    return pose_array(start_from_planes(seen))


def state_of(obs: JointObservations, head: np.ndarray, cameras: np.ndarray) -> JointState:
    """All unknowns from an axis and the cameras (as in JointState): boards from first images."""
    _, first = np.unique(obs.view_placement, return_index=True)
    boards = boards_in_images(obs, head, cameras)[first]
    sensor = np.array([0.0, 0.0, np.log(START_SOFTNESS), 0.0, 0.0])
    return undisturbed(obs, head, cameras, sensor, boards)


def boards_in_images(
    obs: JointObservations, head: np.ndarray, cameras: np.ndarray
) -> np.ndarray:
    """``T_platform_board`` (v, 3, 4) from the views, each by itself.

    `head` and `cameras` as in JointState.
    """
    on_head = obs.on_head[obs.view_camera]
    pitch = obs.view_pitch * on_head
    T_head_lrf = pose_transform(np.where(on_head[:, None, None], head, np.eye(3, 4)))
    T_platform_lrf = platform_from_head(pitch) * T_head_lrf
    T_platform_camera = T_platform_lrf * pose_transform(cameras[obs.view_camera]).inv()
    return pose_array(T_platform_camera * RigidTransform.from_matrix(obs.view_pose))
