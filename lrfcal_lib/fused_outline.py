"""Boards in the coloured cloud: the range finder tells where the plane is, the images where its edges are."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from lrfcal_lib.geometry import DegenerateGeometry, lrf_to_platform
from lrfcal_lib.preprocess.scan import face_points
from lrfcal_lib.reconstruct import measure_board

ALONG = np.linspace(0.0, 1.0, 9)  # places along the stretch of an edge


def fused_outline_of(joint, placement):
    """Measure the outline of a board whose size nobody knows: image edges on the plane of the cloud.

    Parameters
    ----------
    joint : JointCalibration
        Its estimate without the placement is used where there is one (see
        :func:`lrfcal_lib.joint_calibration.leave_out`).
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
