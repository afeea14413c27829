"""What was recorded of one placement, moved into the frame that something is fixed to."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform

from lrfcal_lib.model.kinematics import AS_RECORDED, Corrections, SourceFrame
from lrfcal_lib.preprocess.board_in_scan import BoardScan, face_points
from lrfcal_lib.preprocess.edges_in_scan import ScanEdges
from lrfcal_lib.preprocess.prepared import Prepared


@dataclass(frozen=True)
class RecordedSource:
    """Points of one placement as recorded, moved into the frame that a camera is fixed to.

    Known errors of ranges and pitch are taken out first; they change where a point lies, but not
    how its noise turns.
    """

    placement: int
    frame: SourceFrame
    corrections: Corrections = AS_RECORDED

    def points(self, p_lrf: np.ndarray, pitch: np.ndarray) -> np.ndarray:
        """Measured points (n, 3) at their recorded pitch (n,), in the camera's source frame,
        metres.
        """
        corrected = self.corrections.pitch(self.placement, pitch)
        return self.frame.apply(self.corrections.points(p_lrf), corrected)

    def covariance(self, covariance: np.ndarray, pitch: np.ndarray) -> np.ndarray:
        """Covariances (n, 3, 3) of measured points, turned into the source frame."""
        R = self.frame.rotation(self.corrections.pitch(self.placement, pitch))
        return R @ covariance @ R.swapaxes(-1, -2)

    def by_pitch(self, p_lrf: np.ndarray, pitch: np.ndarray) -> np.ndarray:
        """Derivative (n, 3) of :meth:`points` by an error of the recorded pitch, metres a
        radian.
        """
        corrected = self.corrections.pitch(self.placement, pitch)
        return self.frame.by_pitch(self.corrections.points(p_lrf), corrected)

    def face(self, scan: BoardScan, count: int) -> dict[str, np.ndarray]:
        """At most `count` points of a board's face, with covariance, pitch and placement: columns
        by name.
        """
        columns = face_columns(scan, self.placement, count)
        pitch = columns["pitch"]
        return columns | {
            "points": self.points(columns["points"], pitch),
            "covariance": self.covariance(columns["covariance"], pitch),
        }


def face_columns(scan: BoardScan, placement: int, count: int) -> dict[str, np.ndarray]:
    """At most `count` points of a board's face as recorded, columns by name."""
    points, pitch, covariance = face_points(scan, count)
    return {
        "points": points,
        "covariance": covariance,
        "pitch": pitch,
        "placement": np.full(len(pitch), placement),
    }


def source_of(
    prepared: Prepared,
    camera: str,
    placement: int,
    T_head_lrf: RigidTransform,
    corrections: Corrections = AS_RECORDED,
) -> RecordedSource:
    """A placement in the frame that one of its cameras is fixed to.

    Parameters
    ----------
    prepared : Prepared
    camera : str
    placement : int
    T_head_lrf : RigidTransform
    corrections : Corrections

    Returns
    -------
    RecordedSource
    """
    mount = prepared.session.cameras[camera].mount
    image_pitch = 0.0
    if mount == "head":
        recorded = prepared.views[camera][placement].pitch
        image_pitch = float(corrections.pitch(placement, recorded))
    return RecordedSource(
        placement, SourceFrame(T_head_lrf, mount, image_pitch), corrections
    )


def in_platform(
    placement: int, T_head_lrf: RigidTransform, corrections: Corrections = AS_RECORDED
) -> RecordedSource:
    """A placement in the platform frame."""
    return RecordedSource(placement, SourceFrame(T_head_lrf, "platform"), corrections)


def platform_of(
    prepared: Prepared, T_head_lrf: RigidTransform | None = None
) -> RigidTransform:
    """The platform to use.

    Parameters
    ----------
    prepared : Prepared
    T_head_lrf : RigidTransform, optional

    Returns
    -------
    RigidTransform
        The one given, else the session's, else a tilt axis along x.
    """
    for T in (T_head_lrf, prepared.session.T_head_lrf):
        if T is not None:
            return T
    return RigidTransform.identity()


@dataclass(frozen=True)
class NamedSide:
    """A side of the scan that has the name of an edge.

    Attributes
    ----------
    name : str
        Of the board's edge.
    edges : ScanEdges
        That hold its points.
    rows : ndarray of int
        Which of them.
    across : bool
        Whether it was found across the scan lines.
    """

    name: str
    edges: ScanEdges
    rows: np.ndarray
    across: bool

    @property
    def points(self) -> np.ndarray:
        """LRF frame at their pitch, metres, shape (n, 3)."""
        return self.edges.points[self.rows]

    @property
    def pitch(self) -> np.ndarray:
        """As recorded, radians, shape (n,)."""
        return self.edges.pitch[self.rows]


def named_sides(
    prepared: Prepared, placement: int, variant: str = "half_step", stretch: float = 0.0
) -> Iterator[NamedSide]:
    """The sides of a placement that have names, one by one.

    Parameters
    ----------
    prepared : Prepared
    placement : int
    variant : {'half_step', 'last_beam'}
    stretch : float
        Share of an edge that the sweep must show.

    Yields
    ------
    NamedSide
    """
    along = prepared.edges[variant][placement]
    swept = prepared.swept[variant].get(placement)
    lengths = {}
    if stretch > 0:
        lengths = prepared.board.lengths()
    for number, name in prepared.names.get(placement, {}).items():
        across = number not in along.side
        edges = swept if across else along
        length = next((side.length for side in edges.sides if side.side == number), 0.0)
        if length >= stretch * lengths.get(name, 0.0):
            yield NamedSide(name, edges, np.flatnonzero(edges.side == number), across)
