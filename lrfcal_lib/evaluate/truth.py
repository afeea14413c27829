"""The truth of a simulated session. Nothing else in the library reads it."""

from __future__ import annotations

import os
from dataclasses import dataclass

import numpy as np
import pandas as pd
from scipy.spatial.transform import RigidTransform

from lrfcal_lib.board import Board
from lrfcal_lib.geometry import axis_difference, axis_of, lrf_to_platform, transform_difference
from lrfcal_lib.prepared import VARIANTS
from lrfcal_lib.session import board_from_json, transform_from_json
from lrfcal_lib.session.common import naming, read_json


@dataclass(frozen=True)
class Truth:
    """What a simulated session was made with.

    Attributes
    ----------
    T_head_lrf : RigidTransform
    cameras : dict of str to RigidTransform
        ``T_camera_lrf`` of a camera on the head, ``T_camera_platform`` of one on the base.
    board : Board
    boards : dict of int to RigidTransform
        ``T_platform_board`` by placement.
    pitch : dict of int to ndarray, shape (n_scan_lines,)
        Of every scan line, radians.
    """

    T_head_lrf: RigidTransform
    cameras: dict
    board: Board
    boards: dict
    pitch: dict


def read_truth(session):
    """The truth of a session, None for a recording.

    Parameters
    ----------
    session : Session

    Returns
    -------
    Truth or None

    Raises
    ------
    SessionError
        If ``truth.json`` is damaged.
    """
    file = session.path / "truth.json"
    if not os.path.lexists(file):
        return None
    data = read_json(file, session.path)
    with naming(f"{file} (simulate the session again)"):
        return Truth(
            transform_from_json(data["T_head_lrf"]),
            {name: _camera(entry) for name, entry in data["cameras"].items()},
            board_from_json(data["board"]),
            {int(n): transform_from_json(entry["T_platform_board"]) for n, entry in data["boards"].items()},
            {int(n): np.asarray(entry["pitch_rad"], float) for n, entry in data["sweeps"].items()},
        )


def _camera(entry):
    return transform_from_json(entry["T_camera_lrf"] if "T_camera_lrf" in entry else entry["T_camera_platform"])


def camera_errors(solution, truth, camera):
    """Rotation (degrees) and translation error (millimetres) of a camera, NaN without truth."""
    if truth is None:
        return {}
    angle, distance = transform_difference(solution.transform, truth.cameras[camera])
    return {"rotation_error_deg": np.rad2deg(angle), "translation_error_mm": 1000 * distance}


def axis_errors(T_head_lrf, truth):
    """Direction (degrees) and offset error (millimetres) of a tilt axis, NaN without truth."""
    if truth is None:
        return np.nan, np.nan
    angle, offset = axis_difference(axis_of(T_head_lrf), axis_of(truth.T_head_lrf))
    return np.rad2deg(angle), 1000 * offset


def edge_point_table(prepared, truth):
    """Bias of each rule for the edge point against the true edge, across the edge within the board's plane.

    Parameters
    ----------
    prepared : Prepared
    truth : Truth

    Returns
    -------
    DataFrame
        variant, edge, n, bias_mm (positive outside the board), sd_mm.
    """
    rows = []
    for variant in VARIANTS:
        misses = {edge: [] for edge in truth.board.edges}
        for placement, names in prepared.names.items():
            found = prepared.edges[variant][placement]
            for side, edge in names.items():
                misses[edge].append(_miss(found, found.side == side, edge, truth, placement))
        for edge, parts in misses.items():
            miss = 1000 * np.concatenate([*parts, np.zeros(0)])
            bias, spread = (miss.mean(), miss.std(ddof=1)) if len(miss) > 1 else (np.nan, np.nan)
            rows.append((variant, edge, len(miss), bias, spread))
    return pd.DataFrame(rows, columns=["variant", "edge", "n", "bias_mm", "sd_mm"])


def _miss(found, rows, edge, truth, placement):
    """Signed distances of edge points from the true edge, metres."""
    pitch = truth.pitch[placement][found.line[rows]]
    p_platform = lrf_to_platform(found.points[rows], pitch, truth.T_head_lrf)
    p_board = truth.boards[placement].inv().apply(p_platform)
    line = truth.board.lines()[truth.board.edges.index(edge)]
    return p_board[:, :2] @ line[:2] + line[2]
