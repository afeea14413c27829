"""What a simulated session was made with, and the errors of calibrations against it."""

import os
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd
from scipy.spatial.transform import RigidTransform

from lrfcal_lib.calibrate.cameras import KnownAxis
from lrfcal_lib.calibrate.rig import CalibratedRig
from lrfcal_lib.fit.covariance import sigma_turn_shift
from lrfcal_lib.fit.result import Solution
from lrfcal_lib.model.board import Board
from lrfcal_lib.model.geometry import (
    axis_difference,
    axis_of,
    lrf_to_platform,
    tilt,
    transform_difference,
)
from lrfcal_lib.model.kinematics import platform_from_head
from lrfcal_lib.model.observations import PlatformObservations
from lrfcal_lib.session.files import naming, read_json
from lrfcal_lib.session.read import Session
from lrfcal_lib.session.stated import BoardStated, TransformStated, from_json


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
    pitch : dict of int to ndarray
        Of every scan line by placement, radians.
    stations : dict of int to RigidTransform
        ``T_room_platform`` by placement, of a recording from several places.
    lengths : tuple of dict
        Of the room: name, kind, metres, and corners of both ends in the frame of the room.
    setup : str
        Name of what it was simulated from, of :func:`lrfcal_lib.simulate.rig.load_setup`.
    """

    T_head_lrf: RigidTransform
    cameras: dict[str, RigidTransform]
    board: Board
    boards: dict[int, RigidTransform]
    pitch: dict[int, np.ndarray]
    stations: dict[int, RigidTransform]
    lengths: tuple[dict, ...]
    setup: str

    def on_board(
        self, T_platform_board: RigidTransform, p_lrf: np.ndarray, pitch: np.ndarray
    ) -> np.ndarray:
        """Points (n, 3) of scans at their true pitch (n,) on a board, or each on its own: x and y
        in its plane, metres, and a 1, as lines take them.
        """
        flat = T_platform_board.inv().apply(lrf_to_platform(p_lrf, pitch, self.T_head_lrf))
        flat[:, 2] = 1.0
        return flat

    def gauge(
        self, rig: CalibratedRig, placement: int, recorded: np.ndarray
    ) -> RigidTransform:
        """The turn about the tilt axis and then the shift along it that lead from a rig's platform
        frame to the true one, which no data can show.

        Parameters
        ----------
        rig : CalibratedRig
        placement : int
        recorded : ndarray
            Pitch of its scan lines, radians.
        """
        apart = self.T_head_lrf * rig.T_head_lrf.inv()
        turn = apart.rotation.as_rotvec()[0]
        turn += np.mean(self.pitch[placement] - rig.corrections.pitch(placement, recorded))
        along = RigidTransform.from_translation(apart.translation * [1, 0, 0])
        return along * platform_from_head(turn)


def read_truth(session: Session) -> Truth | None:
    """What a session was made with.

    Parameters
    ----------
    session : Session

    Returns
    -------
    Truth or None
        None for a recording.

    Raises
    ------
    SessionError
        If ``truth.json`` is damaged.
    """
    file = session.path / "truth.json"
    if not os.path.lexists(file):
        return None
    data = read_json(file, session.path)

    def by_placement(entries, key, read):
        return {int(number): read(entry[key]) for number, entry in entries.items()}

    with naming(f"{file} (simulate the session again)"):
        return Truth(
            T_head_lrf=_pose(data["T_head_lrf"]),
            cameras={
                name: _pose(entry.get("T_camera_lrf") or entry["T_camera_platform"])
                for name, entry in data["cameras"].items()
            },
            board=from_json(BoardStated, data["board"]),
            boards=by_placement(data["boards"], "T_platform_board", _pose),
            pitch=by_placement(data["sweeps"], "pitch_rad", np.array),
            stations=by_placement(data.get("stations", {}), "T_room_platform", _pose),
            lengths=tuple(data.get("lengths", ())),
            setup=data.get("setup", ""),
        )


def _pose(stated):
    """A transform that must be there, unlike those that a session may leave out."""
    return from_json(TransformStated, stated)


def camera_errors(solution: Solution, truth: Truth, camera: str) -> dict[str, float]:
    """Errors of a camera's pose against the truth.

    Parameters
    ----------
    solution : Solution
        Of it.
    truth : Truth
    camera : str

    Returns
    -------
    dict of str to float
        See :func:`beside_sigma`.
    """
    return beside_sigma(
        *transform_difference(solution.transform, truth.cameras[camera]),
        solution.trusted[:6, :6],
    )


def axis_errors(axis: KnownAxis, truth: Truth) -> dict[str, float]:
    """Errors of a tilt axis against the truth.

    Parameters
    ----------
    axis : KnownAxis
    truth : Truth

    Returns
    -------
    dict of str to float
        See :func:`beside_sigma`.
    """
    return beside_sigma(
        *axis_difference(axis_of(axis.T_head_lrf), axis_of(truth.T_head_lrf)),
        axis.covariance,
    )


def beside_sigma(turn: float, shift: float, covariance: np.ndarray) -> dict[str, float]:
    """A turn (radians) and a shift (metres) beside what their covariance promises.

    Parameters
    ----------
    turn, shift : float
    covariance : ndarray, shape (2 k, 2 k)
        Of turns, then shifts.

    Returns
    -------
    dict of str to float
        By column: rotation_error_deg, rotation_sigma_deg, rotation_pull (error over sigma: 1 is
        what a standard deviation promises), and the same of the translation in millimetres.
    """
    turn_sigma, shift_sigma = sigma_turn_shift(covariance)
    return {
        "rotation_error_deg": np.rad2deg(turn),
        "rotation_sigma_deg": np.rad2deg(turn_sigma),
        "rotation_pull": turn / turn_sigma,
        "translation_error_mm": 1000 * shift,
        "translation_sigma_mm": 1000 * shift_sigma,
        "translation_pull": shift / shift_sigma,
    }


def on_true_edges(observations: PlatformObservations, truth: Truth) -> PlatformObservations:
    """The same observations, the points of each side moved onto the board's true edge.

    With these points the edges are straight about the true axis at the recorded pitch: what an
    estimate is off then is no error of edge points or pitch.

    Parameters
    ----------
    observations : PlatformObservations
    truth : Truth

    Returns
    -------
    PlatformObservations
    """
    pitch = observations.edge_pitch
    placement = observations.edge_placement
    boards = RigidTransform.concatenate([truth.boards[p] for p in placement])
    flat = truth.on_board(boards, observations.edge_points, pitch)
    away = pd.DataFrame(np.abs(flat @ truth.board.lines().T))
    of_sides = away.groupby([placement, observations.edge_number]).transform("median")
    line = truth.board.lines()[of_sides.to_numpy().argmin(axis=1)]
    on_edge = flat - np.vecdot(flat, line)[:, None] * line
    on_edge[:, 2] = 0.0
    p_head = tilt(boards.apply(on_edge), -pitch)
    return replace(observations, edge_points=truth.T_head_lrf.inv().apply(p_head))
