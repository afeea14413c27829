"""The tilt axis and the cameras, each by itself, from observations alone: no session is needed."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import partial
from itertools import product

import numpy as np
from scipy.spatial.transform import RigidTransform

from lrfcal_lib.fit.axis_chart import chart_parameters
from lrfcal_lib.fit.covariance import sigma_of
from lrfcal_lib.fit.result import Solution
from lrfcal_lib.model.geometry import (
    DegenerateGeometry,
    TiltAxis,
    head_from_axis,
    pose_array,
    unit_vector,
)
from lrfcal_lib.model.observations import CameraObservations, PlatformObservations
from lrfcal_lib.model.problem import Problem, ProblemKind, Stage
from lrfcal_lib.solvers import METHODS, row_of, solve_camera
from lrfcal_lib.solvers.platform import PlatformSolution, solve_platform, solve_projected

ASSUMED = np.radians(10.0), 0.1  # rad, m: how well an axis is known that nothing tells
UNKNOWN_AXIS = (
    "the tilt axis is neither stated nor determined by the sweeps, and taken to lie along x "
    "through the mirror: state the platform in session.json, or record sweeps of straight edges "
    "and images at several pitch angles"
)


@dataclass(frozen=True)
class KnownAxis:
    """A tilt axis, and how well it is known.

    Attributes
    ----------
    T_head_lrf : RigidTransform
    covariance : ndarray, shape (4, 4)
        Of `parameters`, radians and metres.
    """

    T_head_lrf: RigidTransform
    covariance: np.ndarray

    @property
    def parameters(self) -> np.ndarray:
        """Angles (radians) out of and within the scan plane, offsets (metres) within and across
        it, shape (4,).
        """
        return chart_parameters(pose_array(self.T_head_lrf))

    @property
    def sigma(self) -> np.ndarray:
        """Standard deviations of `parameters`, shape (4,)."""
        return sigma_of(self.covariance)


@dataclass(frozen=True)
class PlatformCalibration:
    """The tilt axis by every method, and the one to use.

    Attributes
    ----------
    axes : dict of str to KnownAxis
        By method: of `solutions`, 'stated' where the session states it, 'joint' where there is a
        joint estimate, and 'combined', the one to use: the stated platform, corrected by what the
        data know better. Rotation about the axis and shift along it, which no data can show, are
        the stated ones.
    solutions : dict of str to PlatformSolution
        ``projected_printed`` (the paper), ``projected_last_beam`` (the same in the chart used
        here), ``line_3d``.
    problems : tuple of Problem
        Why a method has no result.
    stated_sigma : tuple of float
        How well the stated one is known: direction (radians) and offset (metres).
    """

    axes: dict[str, KnownAxis]
    solutions: dict[str, PlatformSolution]
    problems: tuple[Problem, ...]
    stated_sigma: tuple[float, float]

    def axis_with(self, method: str) -> str:
        """Name of the axis that goes with the camera poses of a method."""
        return "joint" if method == "joint" else "combined"

    def why_not(self, method: str) -> str:
        """Why a method (or 'combined') has no result; '' if it has one."""
        return why_no_result(self.problems, method)

    def transform(self, method: str) -> RigidTransform:
        """``T_head_lrf`` of a method (also 'stated', 'combined' and 'joint')."""
        return self.axes[method].T_head_lrf


def calibrate_platform(
    observations: Mapping[str, PlatformObservations],
    T_stated: RigidTransform | None = None,
    stated_sigma: tuple[float, float] = ASSUMED,
    sigma_pitch: float = 0.0,
) -> PlatformCalibration:
    """Estimate the tilt axis by the paper's projected fits and by whitened 3D fits, and combine it
    with the stated one.

    Parameters
    ----------
    observations : dict of str to PlatformObservations
        Of the edge-point variants 'last_beam' and 'half_step'; no cameras are needed.
    T_stated : RigidTransform, optional
        ``T_head_lrf`` as it was measured by hand.
    stated_sigma : (float, float)
        Standard deviations of its direction (radians) and offset (metres).
    sigma_pitch : float
        Standard deviation of a recorded pitch, radians.

    Returns
    -------
    PlatformCalibration
        Where the platform is neither stated nor determined, 'combined' is an assumption, and so
        named in `problems`.
    """
    ways = [
        ("projected_printed", "last_beam", partial(solve_projected, printed=True)),
        ("projected_last_beam", "last_beam", partial(solve_projected)),
        ("line_3d", "half_step", partial(solve_platform, sigma_pitch=sigma_pitch)),
    ]
    solutions = {}
    axes = {}
    problems = []
    for method, variant, solve in ways:
        try:
            solution = solve(observations[variant], T_stated)
        except DegenerateGeometry as error:
            problems.append(_no_result(Stage.PLATFORM, method, str(error)))
        else:
            solutions[method] = solution
            axes[method] = KnownAxis(solution.T_head_lrf, solution.solution.trusted)
    estimated = axes.get("line_3d")
    if T_stated is not None:
        stated = KnownAxis(T_stated, stated_covariance(stated_sigma))
        axes["stated"] = stated
        axes["combined"] = stated if estimated is None else combine(estimated, stated)
    elif estimated is not None:
        axes["combined"] = estimated
    else:
        problems.append(_no_result(Stage.PLATFORM, "combined", UNKNOWN_AXIS))
        axes["combined"] = KnownAxis(RigidTransform.identity(), stated_covariance(ASSUMED))
    return PlatformCalibration(axes, solutions, tuple(problems), stated_sigma)


def calibrate_cameras(
    observations: Mapping[tuple[str, str], CameraObservations],
    methods: Iterable[str] = METHODS,
) -> tuple[dict[tuple[str, str], Solution], list[Problem]]:
    """Calibrate every camera by several methods.

    Parameters
    ----------
    observations : dict of (str, str) to CameraObservations
        By camera and edge-point variant.
    methods : iterable of str
        Of :data:`lrfcal_lib.solvers.METHODS`; all by default.

    Returns
    -------
    solutions : dict of (str, str) to Solution
        By camera and method.
    problems : list of Problem
        Why there is none.
    """
    solutions = {}
    problems = []
    cameras = dict.fromkeys(camera for camera, _ in observations)
    for camera, method in product(cameras, methods):
        variant = row_of(method).variant
        try:
            solutions[camera, method] = solve_camera(observations[camera, variant], method)
        except DegenerateGeometry as error:
            problems.append(_no_result(Stage.CAMERAS, method, str(error), camera))
    return solutions, problems


def why_no_result(
    problems: Iterable[Problem], method: str, camera: str | None = None
) -> str:
    """Why a method has no result, of a camera or without one; '' if it has one."""
    for problem in problems:
        if (problem.method, problem.camera) == (method, camera):
            return problem.words
    return ""


def _no_result(stage, method, words, camera=None):
    """A method that gives no answer."""
    return Problem(stage, ProblemKind.NO_RESULT, words, camera=camera, method=method)


def stated_covariance(sigma: tuple[float, float]) -> np.ndarray:
    """Covariance of a stated axis, shape (4, 4), from its two standard deviations."""
    return np.diag(np.repeat(np.square(sigma), 2))


def combine(estimated: KnownAxis, stated: KnownAxis) -> KnownAxis:
    """Weigh an estimated axis and the stated one by their covariances."""
    prior = stated.covariance
    gain = prior @ np.linalg.inv(prior + estimated.covariance)
    change = gain @ (estimated.parameters - stated.parameters)
    axis = axis_from_chart(stated.parameters + change)
    head = head_from_axis(axis, stated.T_head_lrf)
    return KnownAxis(head, prior - gain @ prior)


def axis_from_chart(parameters: np.ndarray) -> TiltAxis:
    """The axis of two angles and two offsets.

    Undoes :func:`lrfcal_lib.fit.axis_chart.chart_parameters`.
    """
    rise, sideways = np.tan(parameters[:2])
    away = parameters[2:]
    along = np.array([1.0, -sideways, rise])
    foot = np.r_[along[1:] @ away, -away]
    return TiltAxis(unit_vector(along), foot)
