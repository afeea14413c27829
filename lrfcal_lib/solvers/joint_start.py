"""Start values of the joint estimate from closed forms: cameras from planes, the axis from how the cameras turn."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from lrfcal_lib.fit.residuals import JointState
from lrfcal_lib.model.geometry import (
    DegenerateGeometry,
    TiltAxis,
    exp_rotation,
    head_from_axis,
    lrf_to_platform,
    polar_to_points,
    pose_array,
    tilt,
)
from lrfcal_lib.model.observations import CameraObservations
from lrfcal_lib.solvers.planes import start_from_planes

START_SOFTNESS = 0.2  # spot radii
LEAST_TURN = np.radians(1.0)  # between two images of a camera for the axis
SAME_PITCH = np.radians(0.6)  # scan lines so near the pitch of an image are used with it
POINTS = 30  # a plane
VIEWS = 24  # a camera; closed forms do not get much better with more
FEWEST_ANGLE_POINTS = 6  # on an edge, for its direction


def start_states(obs, T0=None):
    """Start values to choose from, made one by one.

    Parameters
    ----------
    obs : JointObservations
    T0 : RigidTransform, optional
        Rough ``T_head_lrf``.

    Yields
    ------
    JointState
        From the closed form of the axis, from T0, from the stated platform, from an axis along x through the mirror;
        with cameras from scan lines at the pitch of their images, then from whole sweeps.

    Raises
    ------
    DegenerateGeometry
        When no placement gives the pose of a board.
    """
    if len(obs.face_range) == 0:
        raise DegenerateGeometry("no ranges on the boards' faces: a start value needs them; give one as start=")
    reasons, made = [], 0
    direct = _cameras_at_image_pitch(obs)
    heads = [_axis_from_cameras(obs, direct), T0, obs.T_head_lrf, RigidTransform.identity()]
    for head in (h for h in heads if h is not None):
        for known in [direct, {}] if direct else [{}]:
            try:
                cameras = [
                    known[i] if i in known else _camera_from_sweeps(obs, i, head) for i in range(len(obs.cameras))
                ]
                state = state_of(obs, head, cameras)
            except (DegenerateGeometry, np.linalg.LinAlgError) as error:
                reasons.append(str(error))
                continue
            made += 1
            yield state
    if not made:
        raise DegenerateGeometry("no start value for the joint estimate: " + "; ".join(dict.fromkeys(reasons)))


def _planes(obs, camera, points, key, poses, covariance):
    """What :func:`start_from_planes` needs of observations."""
    return CameraObservations(
        None, obs.cameras[camera], plane_points=points, plane_placement=key, board_poses=poses,
        board_covariance=covariance,
    )  # fmt: skip


def _rows_of(obs):
    """Function from a placement's index to the rows of its face points."""
    order = np.argsort(obs.face_placement, kind="stable")
    ends = np.searchsorted(obs.face_placement[order], np.arange(len(obs.placements) + 1))
    return lambda placement: order[ends[placement] : ends[placement + 1]]


def _cameras_at_image_pitch(obs):
    """Poses of the cameras on the head from scan lines at the pitch of the image: they do not depend on the axis."""
    found, rows_of = {}, _rows_of(obs)
    for camera, mount in enumerate(obs.mounts):
        if mount != "head":
            continue
        points, key, views = [], [], []
        for view in _thin(np.flatnonzero(obs.view_camera == camera), VIEWS):
            mine = rows_of(obs.view_placement[view])
            away = np.abs(obs.face_pitch[mine] - obs.view_pitch[view])
            if len(mine) == 0 or away.min() > SAME_PITCH:
                continue
            rows = _thin(mine[away <= away.min() + 1e-9])
            points.append(polar_to_points(obs.face_range[rows], obs.face_bearing[rows]))
            key.append(np.full(len(rows), len(views)))
            views.append(view)
        if len(views) >= 5:
            data = (np.concatenate(points), np.concatenate(key), obs.view_pose[views], obs.view_covariance[views])
            found[camera] = _try_planes(obs, camera, *data)
    return {camera: pose for camera, pose in found.items() if pose is not None}


def _try_planes(obs, camera, *data):
    try:
        return start_from_planes(_planes(obs, camera, *data))
    except DegenerateGeometry:
        return None


def _thin(rows, count=None):
    count = POINTS if count is None else count
    return rows if len(rows) <= count else rows[np.linspace(0, len(rows) - 1, count).round().astype(int)]


def _camera_from_sweeps(obs, camera, head):
    """A camera from whole sweeps, joined by a roughly known axis."""
    points, key, rows_of = [], [], _rows_of(obs)
    mine = np.flatnonzero(obs.view_camera == camera)
    views = _thin(mine[np.unique(obs.view_placement[mine], return_index=True)[1]], VIEWS)
    views = [view for view in views if len(rows_of(obs.view_placement[view]))]
    for number, view in enumerate(views):
        rows = _thin(rows_of(obs.view_placement[view]))
        p = lrf_to_platform(polar_to_points(obs.face_range[rows], obs.face_bearing[rows]), obs.face_pitch[rows], head)
        if obs.mounts[camera] == "head":
            p = head.inv().apply(tilt(p, np.full(len(p), -obs.view_pitch[view])))
        points.append(p)
        key.append(np.full(len(rows), number))
    if not views:
        raise DegenerateGeometry(f"camera '{obs.cameras[camera]}' never sees a board that the scans hit")
    data = (np.concatenate(points), np.concatenate(key), obs.view_pose[views], obs.view_covariance[views])
    return start_from_planes(_planes(obs, camera, *data))


def _axis_from_cameras(obs, poses):
    """The tilt axis from how a fixed board turns in the images of a camera that pitches."""
    for camera, T_camera_lrf in poses.items():
        turns, ends = [], []
        for placement in range(len(obs.placements)):
            mine = np.flatnonzero((obs.view_camera == camera) & (obs.view_placement == placement))
            if len(mine) > 1:
                mine = mine[np.argsort(obs.view_pitch[mine])]
                turns.append(obs.view_pitch[mine[-1]] - obs.view_pitch[mine[0]])
                ends.append(obs.view_pose[mine[-1]] @ np.linalg.inv(obs.view_pose[mine[0]]))
        if turns and np.max(turns) > LEAST_TURN:
            return _axis_of_turns(np.array(turns), np.array(ends), T_camera_lrf)
    return None


def _axis_of_turns(turns, motions, T_camera_lrf):
    """Least squares axis of motions ``T_2 T_1^-1`` that are turns by ``-angle`` about one line in the camera."""
    rotvec = Rotation.from_matrix(motions[:, :3, :3]).as_rotvec()
    direction = -np.sum(rotvec * turns[:, None], axis=0)
    A = np.eye(3) - motions[:, :3, :3]
    point = np.linalg.lstsq(A.reshape(-1, 3), motions[:, :3, 3].ravel(), rcond=1e-3)[0]
    lrf = T_camera_lrf.inv()
    direction = lrf.rotation.apply(direction / np.linalg.norm(direction))
    return head_from_axis(TiltAxis(direction, lrf.apply(point)))


def state_of(obs, head, cameras):
    """All unknowns from an axis and the cameras: boards from their first images, or from the scans alone."""
    poses = np.stack([pose_array(T) for T in cameras]) if cameras else np.zeros((0, 3, 4))
    sensor = np.array([0.0, 0.0, np.log(START_SOFTNESS), 0.0, 0.0])
    count, edges = len(obs.placements), len(obs.edges)
    boards = _boards(obs, head, poses)
    return JointState(
        pose_array(head), poses, sensor, np.zeros(edges), boards, np.zeros((count, 2)), np.zeros((count, edges))
    )


def _boards(obs, head, cameras):
    """``T_platform_board`` of all placements, shape (p, 3, 4): of the first image, without one of the scan."""
    boards = np.zeros((len(obs.placements), 3, 4))
    seen, first = np.unique(obs.view_placement, return_index=True)
    if len(seen):
        boards[seen] = boards_in_images(obs, pose_array(head), cameras, first)
    for placement in np.setdiff1d(np.arange(len(boards)), seen):
        boards[placement] = pose_array(board_from_scan(obs, placement, head))
    return boards


def boards_in_images(obs, head, cameras, views):
    """``T_platform_board`` (n, 3, 4) from some views, each by itself; `head` and `cameras` as in JointState."""
    camera, pose = obs.view_camera[views], obs.view_pose[views]
    back = np.swapaxes(cameras[camera][..., :3], -1, -2)
    rotation = back @ pose[:, :3, :3]
    shift = (back @ (pose[:, :3, 3] - cameras[camera][..., 3])[..., None])[..., 0]
    on_head = np.array([mount == "head" for mount in obs.mounts])[camera]
    turn = exp_rotation(np.stack([obs.view_pitch[views], 0 * shift[:, 0], 0 * shift[:, 0]], axis=1))
    moved = turn @ head[:, :3] @ rotation
    at = (turn @ (shift @ head[:, :3].T + head[:, 3])[..., None])[..., 0]
    rotation = np.where(on_head[:, None, None], moved, rotation)
    return np.concatenate([rotation, np.where(on_head[:, None], at, shift)[..., None]], axis=-1)


def board_from_scan(obs, placement, head):
    """Pose of a board from its plane and where scans cross its edges.

    Parameters
    ----------
    obs : JointObservations
    placement : int
        Index.
    head : RigidTransform
        ``T_head_lrf``.

    Returns
    -------
    RigidTransform
        ``T_platform_board``.

    Raises
    ------
    DegenerateGeometry
        When fewer than two edges are crossed, or the scans span no plane.
    """
    face = obs.face_placement == placement
    p = polar_to_points(obs.face_range[face], obs.face_bearing[face])
    p = lrf_to_platform(p, obs.face_pitch[face], head)
    origin = lrf_to_platform(np.zeros((1, 3)), obs.face_pitch[face][:1], head)[0]
    centre = p.mean(axis=0)
    normal = np.linalg.svd(p - centre, full_matrices=False)[2][2]
    normal = normal * (-np.sign(normal @ (centre - origin)))  # the printed side faces the rig
    axes = np.stack([np.cross([0.0, 0.0, 1.0], normal), np.cross(normal, np.cross([0.0, 0.0, 1.0], normal)), normal])
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    rotation, shift = _turn_in_plane(obs, placement, head, axes, centre)
    rotation = Rotation.from_matrix(axes.T @ rotation)
    return RigidTransform.from_components(centre + axes.T @ np.append(shift, 0.0), rotation)


def _turn_in_plane(obs, placement, head, axes, centre):
    """Turn and shift of the outline within the plane, from points on its edges (last beams on the board)."""
    beams = (obs.beam_placement == placement) & obs.beam_hit
    ray = polar_to_points(np.ones(beams.sum()), obs.beam_bearing[beams])
    o = lrf_to_platform(np.zeros_like(ray), obs.beam_pitch[beams], head)
    d = lrf_to_platform(ray, obs.beam_pitch[beams], head) - o
    x = (o + (((centre - o) @ axes[2]) / (d @ axes[2]))[:, None] * d - centre) @ axes[:2].T
    edge, lines = obs.beam_edge[beams], obs.lines()
    angles = []
    for e in np.unique(edge):
        mine = x[edge == e]
        if len(mine) < FEWEST_ANGLE_POINTS:
            continue
        along = np.linalg.svd(mine - mine.mean(axis=0), full_matrices=False)[2][0]
        outwards = np.array([along[1], -along[0]])
        outwards *= np.sign(outwards @ mine.mean(axis=0)) or 1.0
        angles.append(np.arctan2(outwards[1], outwards[0]) - np.arctan2(lines[e, 1], lines[e, 0]))
    if len(angles) < 2:
        raise DegenerateGeometry(f"placement {obs.placements[placement]}: scans cross {len(angles)} edges, two needed")
    turn = np.angle(np.mean(np.exp(1j * np.array(angles))))
    c, s = np.cos(turn), np.sin(turn)
    R = np.array([[c, -s], [s, c]])
    normals = lines[edge, :2] @ R.T
    shift = np.linalg.lstsq(normals, np.sum(normals * x, axis=1) + lines[edge, 2], rcond=None)[0]
    full = np.eye(3)
    full[:2, :2] = R
    return full, shift
