"""A prepared session as observations of the joint estimate: ranges, beams about the edges, boards in all images."""

from __future__ import annotations

import numpy as np

from lrfcal_lib.board import corners_of_lines
from lrfcal_lib.pairing import cells_of, thin
from lrfcal_lib.preprocess import image
from lrfcal_lib.preprocess.board_scan import face_points
from lrfcal_lib.preprocess.wide import side_lines
from lrfcal_lib.solvers.joint_lens import pose_by_intrinsics
from lrfcal_lib.solvers.joint_observations import JointObservations

FACE_POINTS = 150  # a placement: neighbouring ranges of a real device share their errors
CELLS_PER_EDGE = 160  # a placement, of each edge


def all_views(prepared):
    """The board in all images of a session, at every pitch, with the intrinsics and outline that are known by now.

    Parameters
    ----------
    prepared : Prepared

    Returns
    -------
    dict of str to list of BoardView
        By camera; images of no placement are left out. Where every placement has one image these are the prepared
        views.
    """
    session = prepared.session
    records = [r for r in session.images(purpose="board") if r.placement >= 0 and r.camera in prepared.views]
    known = sum(len(found) for found in prepared.views.values())
    if len(records) <= known or prepared.board.pattern is None:
        return {camera: list(found.values()) for camera, found in prepared.views.items()}
    options = {"picks": session.picks, "settled": prepared.views}  # sides of scans bear the names of that turn
    return image.survey(records, session.read_image, prepared.board, prepared.models, **options).views


def observe_joint(prepared, views=None, *, face_points=FACE_POINTS, cells=CELLS_PER_EDGE):
    """Everything that the joint estimate uses of a session.

    Parameters
    ----------
    prepared : Prepared
    views : dict of str to list of BoardView, optional
        See :func:`all_views`.
    face_points, cells : int
        At most so many ranges a placement and beams an edge.

    Returns
    -------
    JointObservations
        Of the placements that `prepared.problems` does not name.
    """
    views = all_views(prepared) if views is None else views
    placements = [p for p in prepared.scans if p not in prepared.problems]
    index = {p: i for i, p in enumerate(placements)}
    parts = {"face": _faces(prepared, index, face_points), "beam": _beams(prepared, index, cells)}
    parts["view"] = _views(views, index, prepared)
    found = {f"{group}_{key}": value for group, part in parts.items() for key, value in part.items()}
    session = prepared.session
    return JointObservations(
        placements=np.array(placements, int),
        direction=np.array([session.sweep_direction(p) for p in placements], int),
        middle=np.array([float(np.mean(prepared.scans[p].sweep.pitch)) for p in placements]),
        edges=tuple(prepared.board.edges),
        corners=_extent(prepared.board),
        cameras=tuple(views),
        mounts=tuple(session.cameras[c].mount for c in views),
        T_head_lrf=session.T_head_lrf,
        lens_covariance=np.stack([_lens(prepared.models[c]) for c in views]) if views else None,
        **found,
    )


def _extent(board):
    """Corners of the board, of its printed squares where nobody knows them: no beam is named after those."""
    if board.corners is not None or board.pattern is None:
        return board.known_corners()
    return corners_of_lines(side_lines(board.pattern, np.full(4, board.pattern.square)))


def _faces(prepared, index, count):
    out = {key: [np.zeros(0)] for key in ("range", "bearing", "pitch", "sigma")} | {"placement": [np.zeros(0, int)]}
    for placement, i in index.items():
        board = prepared.scans[placement]
        points, pitch, _ = face_points(board, count)
        out["range"].append(np.linalg.norm(points, axis=1))
        out["bearing"].append(np.arctan2(points[:, 1], points[:, 0]))
        out["pitch"].append(pitch)
        out["sigma"].append(np.full(len(pitch), board.sigma_range))
        out["placement"].append(np.full(len(pitch), i))
    return {key: np.concatenate(value) for key, value in out.items()}


def _beams(prepared, index, count):
    keys = ("bearing", "pitch", "hit", "edge", "radius", "background", "step", "placement")
    out, edges = {key: [] for key in keys}, list(prepared.board.edges)
    for placement, i in index.items():
        named = {side: edges.index(name) for side, name in prepared.names.get(placement, {}).items()}
        cells = cells_of(prepared, placement)
        for side, edge in named.items():
            rows = thin(np.flatnonzero(cells.side == side), count)
            for key in ("bearing", "pitch", "hit", "radius", "background"):
                out[key].append(getattr(cells, key)[rows])
            out["step"].append(cells.step[rows] * cells.range_m[rows])
            out["edge"].append(np.full(len(rows), edge))
            out["placement"].append(np.full(len(rows), i))
    kinds = {"hit": bool, "edge": int, "placement": int}
    return {key: np.concatenate(value) if value else np.zeros(0, kinds.get(key, float)) for key, value in out.items()}


def _lens(model):
    """Covariance of the intrinsics; zeros where they are stated without one."""
    return np.zeros((9, 9)) if model.covariance is None else np.asarray(model.covariance)


def _views(views, index, prepared):
    out = {"camera": [], "pitch": [], "pose": [], "covariance": [], "placement": [], "lens": []}
    pattern = prepared.board.pattern
    for number, found in enumerate(views.values()):
        for view in found:
            if view.T_camera_board is None or view.placement not in index:
                continue
            corners = np.zeros((0, 3)) if pattern is None or view.pixels is None else pattern.points()
            seen = corners if view.pixels is None else corners[np.isfinite(view.pixels).all(axis=1)]
            lens = pose_by_intrinsics(view.T_camera_board, seen, prepared.models[view.camera])
            row = (number, view.pitch, view.T_camera_board.as_matrix(), view.covariance, index[view.placement], lens)
            for key, value in zip(out, row, strict=True):
                out[key].append(value)
    shapes = {"pose": (0, 4, 4), "covariance": (0, 6, 6), "lens": (0, 6, 9)}
    whole = {"camera": int, "placement": int}
    arrays = {k: np.array(v) if v else np.zeros(shapes.get(k, (0,)), whole.get(k, float)) for k, v in out.items()}
    return arrays | {"pitch": np.nan_to_num(arrays["pitch"])}
