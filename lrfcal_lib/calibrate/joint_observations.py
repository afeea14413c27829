"""What the joint estimate uses of a session: ranges, beams about edges, poses in images."""

import numpy as np
from scipy.spatial.transform import RigidTransform

from lrfcal_lib.calibrate.observe import FACE_POINTS, stack
from lrfcal_lib.model.camera import LENS, CameraModel, project_jacobians
from lrfcal_lib.model.geometry import (
    bearings_of,
    gradient_by_pose,
    length_of,
)
from lrfcal_lib.model.observations import JointObservations, thin
from lrfcal_lib.preprocess.board_in_image import BoardView
from lrfcal_lib.preprocess.board_in_scan import face_points
from lrfcal_lib.preprocess.edge_cells import edge_cells
from lrfcal_lib.preprocess.prepared import Prepared

CELLS_PER_EDGE = 160  # a placement
LEAST_CORNERS = 6  # of a pattern, for the derivative of its pose by the intrinsics


def observe_joint(
    prepared: Prepared, views: dict[str, list[BoardView]]
) -> JointObservations:
    """Everything that the joint estimate uses of a session.

    Parameters
    ----------
    prepared : Prepared
    views : dict of str to list of BoardView
        By camera; :func:`lrfcal_lib.preprocess.survey.all_views` or some of them.

    Returns
    -------
    JointObservations
    """
    session = prepared.session
    scans = prepared.scans
    lens_covariance = np.zeros((len(views), LENS, LENS))
    for number, camera in enumerate(views):
        known = prepared.models[camera].covariance
        if known is not None:
            lens_covariance[number] = known
    return JointObservations(
        placements=np.array(list(scans), int),
        direction=np.array([scan.sweep.direction for scan in scans.values()], int),
        middle=np.array([np.mean(scan.sweep.pitch) for scan in scans.values()]),
        edges=prepared.board.edges,
        # where nobody knows them, no beam is named after the sides of the printed squares
        corners=prepared.board.outline(),
        cameras=tuple(views),
        mounts=tuple(session.cameras[camera].mount for camera in views),
        T_head_lrf=session.T_head_lrf,
        lens_covariance=lens_covariance,
        **stack("face_", _ranges(scans)),
        **stack("beam_", _beams(prepared, scans)),
        **stack("view_", _views(prepared, views, list(scans))),
    )


def _ranges(scans):
    """Ranges to the faces of boards, of placements by row: columns by name."""
    for row, scan in enumerate(scans.values()):
        p_lrf, pitch, _ = face_points(scan, FACE_POINTS)
        yield {
            "range": length_of(p_lrf),
            "bearing": bearings_of(p_lrf),
            "pitch": pitch,
            "sigma": scan.sigma_range,
            "placement": row,
        }


def _beams(prepared, scans):
    """Beams about the named sides of placements, by row: columns by name."""
    for row, scan in enumerate(scans.values()):
        cells = edge_cells(scan, prepared.session.lrf)
        for side, name in scan.names.items():
            about = thin(cells[cells.side == side], CELLS_PER_EDGE)
            yield {
                "bearing": about.bearing,
                "pitch": about.pitch,
                "hit": about.hit,
                "radius": about.radius,
                "background": about.background,
                "step": about.step * about.range_m,
                "edge": prepared.board.edges.index(name),
                "placement": row,
            }


def _views(prepared, views, placements):
    """Poses of the board in all images, of cameras by number and placements by row: columns by
    name.
    """
    for number, (camera, of_camera) in enumerate(views.items()):
        for view in of_camera:
            if view.T_camera_board is None or view.placement not in placements:
                continue
            visible = np.zeros((0, 3))
            if view.pixels is not None:
                visible = prepared.board.pattern.points()[
                    np.isfinite(view.pixels).all(axis=1)
                ]
            yield {
                "pose": [view.T_camera_board.as_matrix()],
                "covariance": [view.covariance],
                "lens": [
                    pose_by_intrinsics(
                        view.T_camera_board, visible, prepared.models[camera]
                    )
                ],
                "camera": number,
                "pitch": np.nan_to_num(view.pitch),
                "placement": placements.index(view.placement),
            }


def pose_by_intrinsics(
    T_camera_board: RigidTransform, corners: np.ndarray, model: CameraModel
) -> np.ndarray:
    """How the pose of a board that fits given pixels changes with the intrinsics.

    Parameters
    ----------
    T_camera_board : RigidTransform
    corners : ndarray, shape (k, 3)
        Those of the pattern that were seen, board frame, metres.
    model : CameraModel

    Returns
    -------
    ndarray, shape (6, 9)
        Derivative of the increments ``[w, v]`` of T_camera_board; zeros with fewer than six
        corners.
    """
    if len(corners) < LEAST_CORNERS:
        return np.zeros((6, LENS))
    turned = T_camera_board.rotation.apply(corners)
    by_point, by_lens = project_jacobians(turned + T_camera_board.translation, model)
    by_pose = gradient_by_pose(turned[:, None], by_point)
    return -np.linalg.lstsq(by_pose.reshape(-1, 6), by_lens.reshape(-1, LENS))[0]
