"""The tilt axis of the platform, from two perpendicular edges swept at known pitch angles (eqs. 1-15).

Whatever pitching data can show are the 4 degrees of freedom of one line. The chart used here is the increment
``(w_y, w_z, v_y, v_z)`` of ``T_head_lrf`` (``R <- exp([0, w_y, w_z]) R``, ``t <- t + [0, v_y, v_z]``, head frame) at
the gauge of :func:`lrfcal_lib.geometry.head_from_axis`: w_y tilts the axis out of the scan plane, w_z turns it within
the scan plane (it cannot be told from the zero of the bearings), v_y and v_z shift it within and across the scan plane.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import RigidTransform

from lrfcal_lib.geometry import TiltAxis, axis_of, head_from_axis, paper_parameters
from lrfcal_lib.solvers.least_squares import solve
from lrfcal_lib.solvers.platform_blocks import (
    chart_parameters,
    degrees_of_freedom,
    move_platform,
    platform_blocks,
    prepare_boards,
)
from lrfcal_lib.solvers.pose import pose_array, pose_transform
from lrfcal_lib.solvers.solution import Solution

AXIS_NAMES = ("axis_out_of_scan_plane", "axis_in_scan_plane", "offset_in_scan_plane", "offset_across_scan_plane")
AXIS_WORDS = (
    "the tilt of the axis out of the scan plane",
    "the turn of the axis within the scan plane",
    "the offset of the axis within the scan plane",
    "the offset of the axis across the scan plane",
)
SIGMA_SKEW = np.radians(0.2)
GAUGE = ("rotation about the tilt axis", "translation along the tilt axis")


@dataclass(frozen=True)
class PlatformObservations:
    """Edge points (and face points) of boards swept by the pitching LRF.

    Attributes
    ----------
    points : ndarray, shape (n, 3)
        Edge points, LRF frame, metres.
    covariance : ndarray, shape (n, 3, 3)
    pitch : ndarray, shape (n,)
        Recorded pitch of their scan lines, radians.
    placement : ndarray of int, shape (n,)
    edge : ndarray of int, shape (n,)
        1 or 2: the two perpendicular edges of equations (7) to (14).
    face_points, face_covariance, face_pitch, face_placement : ndarray
        Points on the board's face, likewise; they may be empty.
    """

    points: np.ndarray
    covariance: np.ndarray
    pitch: np.ndarray
    placement: np.ndarray
    edge: np.ndarray
    face_points: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
    face_covariance: np.ndarray = field(default_factory=lambda: np.zeros((0, 3, 3)))
    face_pitch: np.ndarray = field(default_factory=lambda: np.zeros(0))
    face_placement: np.ndarray = field(default_factory=lambda: np.zeros(0, int))

    def __post_init__(self):
        for name in ("points", "covariance", "pitch", "face_points", "face_covariance", "face_pitch"):
            bad = ~np.isfinite(getattr(self, name))
            if bad.any():
                raise ValueError(f"{name} holds {int(bad.sum())} values that are not finite: leave such points out")
        if not np.isin(self.edge, (1, 2)).all():
            raise ValueError(f"edge must be 1 or 2 (the two perpendicular edges), got {np.unique(self.edge)}")


@dataclass(frozen=True)
class PlatformPrior:
    """A rough measurement of the axis.

    Attributes
    ----------
    T_head_lrf : RigidTransform
    sigma_direction : float
        Radians, of each of the two angles.
    sigma_offset : float
        Metres, of each of the two offsets.
    """

    T_head_lrf: RigidTransform
    sigma_direction: float
    sigma_offset: float


@dataclass(frozen=True)
class PlatformSolution:
    """The estimated tilt axis.

    Attributes
    ----------
    T_head_lrf : RigidTransform
        In the gauge of :func:`lrfcal_lib.geometry.head_from_axis`.
    axis : TiltAxis
    phi, ty : ndarray, shape (3,), and float
        The paper's parameters of the same axis. As ``ty -> 0``, phi_x loses its meaning.
    covariance : ndarray, shape (4, 4)
        Of ``(w_y, w_z, v_y, v_z)``, see the module; radians and metres. From the propagated noise.
    covariance_placements : ndarray, shape (4, 4), or None
        The same from the scatter over the placements; see :class:`lrfcal_lib.solvers.least_squares.Solution`.
    unobservable : tuple of str
        Motions that the data leave open. What no pitching data can show (`gauge`) is not counted.
    gauge : tuple of str
    skipped : dict of int to str
        Placements left out, with the reason.
    placements : ndarray of int, shape (p,)
        Placements used.
    skew, gap : ndarray, shape (p,)
        Deviation of the two edges from a right angle (radians), and their distance (metres), at the solution.
    solution : Solution
        Of the least squares problem (residuals, Jacobian, cost history, ...).
    """

    T_head_lrf: RigidTransform
    axis: TiltAxis
    phi: np.ndarray
    ty: float
    covariance: np.ndarray
    covariance_placements: np.ndarray | None
    unobservable: tuple[str, ...]
    gauge: tuple[str, ...]
    skipped: dict[int, str]
    placements: np.ndarray
    skew: np.ndarray
    gap: np.ndarray
    solution: Solution

    @property
    def sigma_direction(self):
        """Standard deviation of the direction, radians (root of the trace of its two angles)."""
        return float(np.sqrt(np.trace(self.solution.trusted[:2, :2])))

    @property
    def sigma_offset(self):
        """Standard deviation of the offset, metres (root of the trace of its two components)."""
        return float(np.sqrt(np.trace(self.solution.trusted[2:, 2:])))

    @property
    def converged(self):
        return self.solution.converged

    def __repr__(self):
        return f"PlatformSolution({self.solution.method}, {self.axis}, {len(self.placements)} placements)"


def start_head(T0=None, prior=None):
    """Start value of ``T_head_lrf``: given, or the prior's, or an axis through the LRF's origin along its x."""
    start = T0 if T0 is not None else prior.T_head_lrf if prior is not None else RigidTransform.identity()
    return head_from_axis(axis_of(start))


def solve_platform(
    obs,
    T0=None,
    prior=None,
    *,
    sigma_skew=SIGMA_SKEW,
    sigma_gap=0.002,
    sigma_pitch=0.0,
    use_face=True,
    loss=None,
    scale=1.0,
    max_iterations=100,
    required=True,
):
    """The tilt axis from 3D line fits, weighted by propagated noise.

    Parameters
    ----------
    obs : PlatformObservations
    T0 : RigidTransform, optional
        Start value of ``T_head_lrf``; see :func:`start_head`.
    prior : PlatformPrior, optional
        A rough measurement that enters with its weight.
    sigma_skew, sigma_gap : float
        Tolerances of the board: right angle of the two edges (radians) and their distance (metres). The
        perpendicularity and coplanarity of equations (13) and (14) are residuals with these weights.
    sigma_pitch : float
        Standard deviation of a recorded pitch, radians.
    use_face : bool
        Also require the face points to lie in the plane of edge 1.
    loss : {None, 'huber', 'cauchy'}
        Robust loss for single points, with `scale` (standard deviations, or 'auto').
    scale : float or 'auto'
    max_iterations : int
    required : bool
        False: report unobservable motions instead of raising.

    Returns
    -------
    PlatformSolution

    Raises
    ------
    DegenerateGeometry
        When no placement can be used, or when the data leave a motion of the axis open.

    Notes
    -----
    Equations (1) to (15) with total least squares lines instead of projected fits: every placement has a board of its
    own (pose, skew, gap: 8 unknowns, eliminated by a Schur complement), an edge point has two distances from its edge.
    A placement with one edge serves too when it has face points.
    """
    head = pose_array(start_head(T0, prior))
    data, boards, skipped = prepare_boards(obs, pose_transform(head), use_face)
    weights = (sigma_skew, sigma_gap, sigma_pitch)
    options = dict(
        names=AXIS_NAMES,
        method="platform_3d",
        read=lambda s: (pose_transform(s[0]), chart_parameters(s[0])),
        shared=4,
        loss=loss,
        scale=scale,
        max_iterations=max_iterations,
        words=axis_words,
        freedom=degrees_of_freedom(data, prior),
        limit=0.5,
        n_observations=int(data.used.sum() + data.face_used.sum()),
    )

    def evaluate(state):
        return platform_blocks(state, data, weights, prior)

    first = solve(evaluate, (head, boards, np.zeros((len(boards), 2))), move_platform, required=False, **options)
    gauge = head_from_axis(axis_of(first.transform))
    _, boards, _ = prepare_boards(obs, gauge, use_face)
    state = (pose_array(gauge), boards, np.zeros((len(boards), 2)))
    found = solve(evaluate, state, move_platform, required=required, earlier=[first.cost_history], **options)
    first = 2 * data.used.shape[1] + data.face_used.shape[1]
    skew, gap = (found.residuals[:, first : first + 2] * [sigma_skew, sigma_gap]).T
    return platform_solution(found, data.placements, skew, gap, skipped)


def platform_solution(found, placements, skew, gap, skipped):
    """Wrap a solved axis."""
    T = head_from_axis(axis_of(found.transform))
    phi, ty = paper_parameters(T)
    return PlatformSolution(
        T,
        axis_of(T),
        phi,
        ty,
        found.covariance,
        found.covariance_placements,
        found.unobservable,
        GAUGE,
        skipped,
        placements,
        skew,
        gap,
        found,
    )


def axis_words(direction):
    """A combination of the four motions of the axis in words."""
    large = [
        words
        for words, value in zip(AXIS_WORDS, direction, strict=True)
        if abs(value) > 0.3 * np.max(np.abs(direction))
    ]
    return " with ".join(large)
