"""The stages in order, each one call: prepare a session, then the cameras one by one, and
everything at once.
"""

import operator
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import astuple, dataclass, replace
from functools import partial
from itertools import product

import numpy as np

from lrfcal_lib.calibrate.cameras import (
    KnownAxis,
    PlatformCalibration,
    calibrate_cameras,
    calibrate_platform,
    stated_covariance,
    why_no_result,
)
from lrfcal_lib.calibrate.joint_observations import observe_joint
from lrfcal_lib.calibrate.naming import name_sides
from lrfcal_lib.calibrate.observe import (
    ONE_SCAN,
    observe,
    platform_observations,
)
from lrfcal_lib.calibrate.rig import CalibratedCamera, CalibratedRig
from lrfcal_lib.calibrate.rig_uncertainty import joint_uncertainty, uncertainty_one_by_one
from lrfcal_lib.fit.result import AXIS_NAMES, PlatformPrior, Solution
from lrfcal_lib.fit.robust import rms
from lrfcal_lib.model.geometry import DegenerateGeometry
from lrfcal_lib.model.kinematics import AS_RECORDED
from lrfcal_lib.model.observations import CameraObservations, JointObservations
from lrfcal_lib.model.problem import Problem, ProblemKind, Stage
from lrfcal_lib.preprocess.board_in_scan import LEAST_SWEEP
from lrfcal_lib.preprocess.edges_in_scan import VARIANTS
from lrfcal_lib.preprocess.prepared import PitchNoise, Prepared, prepare_scans
from lrfcal_lib.preprocess.survey import all_views, prepare_images
from lrfcal_lib.session.cache import cached
from lrfcal_lib.session.read import Session
from lrfcal_lib.session.workers import spread
from lrfcal_lib.solvers import METHODS, SHIPPED, best_method, row_of
from lrfcal_lib.solvers.joint import solve_again, solve_joint
from lrfcal_lib.solvers.joint_solution import JointSolution
from lrfcal_lib.solvers.pitch import PitchErrors, estimate_pitch_errors

LAPSE = 0.01  # share of beams about an edge that something else than the edge decides
PITCH_POINTS = 300  # of a placement's face, for the errors of its pitch
LEAST_SIDES = 8  # of all placements, for a spread of the edge bias from side to side


@dataclass(frozen=True)
class JointCalibration:
    """The joint calibration of a session.

    Attributes
    ----------
    prepared : Prepared
    solution : JointSolution
    settings : dict
        What was unknown, and why (see :func:`joint_settings`): keyword arguments of `solve_joint`.
    without : dict of int to JointSolution
        An estimate that has not seen the placement, by placement; filled by :func:`leave_out`.
    """

    prepared: Prepared
    solution: JointSolution
    settings: dict
    without: dict[int, JointSolution]

    @property
    def observations(self) -> JointObservations:
        """Those that took part."""
        return self.solution.observations

    def seen_by(
        self, camera: str, solution: JointSolution | None = None, **options
    ) -> CameraObservations:
        """Observations of a camera made with the platform, range offset and pitch of the joint
        estimate.

        Parameters
        ----------
        camera : str
        solution : JointSolution, optional
            Another estimate than the whole session's (without a placement).
        **options
            Of :func:`lrfcal_lib.calibrate.observe.observe`.
        """
        solution = solution or self.solution
        return observe(
            self.prepared,
            camera,
            "half_step",
            solution.T_head_lrf,
            solution.corrections,
            **options,
        )


@dataclass(frozen=True)
class Calibration:
    """Everything that a calibrated session holds.

    Attributes
    ----------
    prepared : Prepared
    platform : PlatformCalibration
    observations : dict of (str, str) to CameraObservations
        By camera and edge-point variant, made with the calibrated platform.
    solutions : dict of (str, str) to Solution
        By camera and method.
    problems : tuple of Problem
        Why a camera has no result by a method, or why there is no joint estimate.
    joint : JointCalibration or None
        Its cameras are in `solutions` as method 'joint', with observations of their own under that
        variant.
    """

    prepared: Prepared
    platform: PlatformCalibration
    observations: dict[tuple[str, str], CameraObservations]
    solutions: dict[tuple[str, str], Solution]
    problems: tuple[Problem, ...]
    joint: JointCalibration | None = None

    def why_not(self, method: str, camera: str | None = None) -> str:
        """Why a method has no result, of a camera where it takes them one by one; '' if it has
        one.
        """
        return why_no_result(self.problems, method, camera)

    def cameras(self, method: str) -> dict[str, Solution]:
        """What a method says of every camera that it has a result of."""
        return {
            camera: solution
            for (camera, name), solution in self.solutions.items()
            if name == method
        }

    def rig(self, method: str) -> CalibratedRig:
        """The rig as a method has it: its cameras, the axis that goes with them, and what is known
        to be wrong with ranges and pitch.

        What single sweeps of this session are off by (`corrections.sweeps`, by placement) is good
        for this session only; `load_calibration` reads the same rig without it.

        Parameters
        ----------
        method : str
            Of `solutions`.

        Returns
        -------
        CalibratedRig
        """
        session = self.prepared.session
        solved = self.cameras(method)
        cameras = {
            camera: CalibratedCamera(
                solution.transform,
                session.cameras[camera].mount,
                solution.model or self.prepared.models[camera],
            )
            for camera, solution in solved.items()
        }
        axis = self.platform.axes[self.platform.axis_with(method)]
        if method == "joint":
            corrections = self.joint.solution.corrections
            uncertainty = joint_uncertainty(self.joint.solution)
        else:
            corrections = AS_RECORDED
            noise = [scan.sigma_range for scan in self.prepared.scans.values()]
            uncertainty = uncertainty_one_by_one(
                axis.covariance,
                solved,
                admitted_offset=session.lrf.admitted_offset,
                sweep_sigma=astuple(self.prepared.pitch_noise),
                range_noise=np.median(noise) if noise else session.lrf.sigma_range,
            )
        return CalibratedRig(
            method=method,
            axis=axis,
            corrections=corrections,
            cameras=cameras,
            lrf=session.lrf,
            uncertainty=uncertainty,
            session=session.name,
        )


def calibrate(session: Session, methods: Iterable[str] = METHODS) -> Calibration:
    """All stages: preprocessing, platform, cameras, and the joint estimate of everything.

    Parameters
    ----------
    session : Session
    methods : iterable of str
        Of :data:`lrfcal_lib.solvers.METHODS`; all rows that are there when this is called by
        default.

    Returns
    -------
    Calibration

    Raises
    ------
    ValueError
        For a method that is not there.
    """
    methods = tuple(methods)
    if any(row_of(name) is not SHIPPED.get(name) for name in methods):
        return _calibrate.__wrapped__(session, methods)  # a row may change without its name
    return _calibrate(session, methods)


@cached
def _calibrate(session, methods):
    """As :func:`calibrate`, by methods that do not change."""
    prepared = prepare(session)
    cameras = partial(_one_by_one, prepared, methods)
    if not prepared.views:
        return cameras()
    joint = partial(joint_or_problem, prepared, all_views(prepared))
    at_once, calibration = spread(operator.call, [joint, cameras])
    return with_joint(calibration, at_once)


def _one_by_one(prepared, methods):
    """Calibrate the platform, then every camera."""
    platform = tilt_axis(prepared)
    axis = platform.transform("combined")
    observations = {
        (camera, variant): observe(prepared, camera, variant, axis)
        for camera, variant in product(prepared.views, (*VARIANTS, ONE_SCAN))
    }
    solutions, problems = calibrate_cameras(observations, methods)
    return Calibration(prepared, platform, observations, solutions, tuple(problems))


@cached
def prepare(session: Session) -> Prepared:
    """Preprocess scans and images of a session, and name the sides that scans cross.

    Parameters
    ----------
    session : Session

    Returns
    -------
    Prepared
        Placements that cannot be used are in its `problems`, with their reason.
    """
    ready = without(name_sides(prepare_images(prepare_scans(session))))
    errors = find_pitch_errors(ready)
    if errors is None:
        return ready
    wanted = errors.models[errors.wanted]
    noise = PitchNoise(rms(wanted.offset), rms(wanted.stretch))
    return replace(ready, pitch_noise=noise)


def without(prepared: Prepared) -> Prepared:
    """Drop the placements that are left out from everything but the images."""
    left_out = prepared.left_out
    scans = {p: scan for p, scan in prepared.scans.items() if p not in left_out}
    return replace(prepared, scans=scans)


def find_pitch_errors(prepared: Prepared) -> PitchErrors | None:
    """Ask the cameras that are fixed to the base whether the platform tells the truth about its
    pitch.

    Parameters
    ----------
    prepared : Prepared

    Returns
    -------
    PitchErrors or None
        None where no camera is fixed to the base, or too few placements are seen.
    """
    session = prepared.session
    fixed = [c for c in prepared.views if session.cameras[c].mount == "platform"]
    if not fixed:
        return None
    direction = {p: scan.sweep.direction for p, scan in prepared.scans.items()}
    middle = {p: np.mean(scan.sweep.pitch) for p, scan in prepared.scans.items()}
    observations = {c: observe(prepared, c, faces=PITCH_POINTS) for c in fixed}
    with suppress(DegenerateGeometry):
        return estimate_pitch_errors(observations, direction, middle)
    return None


def tilt_axis(prepared: Prepared) -> PlatformCalibration:
    """The tilt axis of a session by every method, see
    :func:`lrfcal_lib.calibrate.cameras.calibrate_platform`.

    Parameters
    ----------
    prepared : Prepared
        No cameras are needed.

    Returns
    -------
    PlatformCalibration
    """
    session = prepared.session
    observations = {
        variant: platform_observations(prepared, variant) for variant in VARIANTS
    }
    return calibrate_platform(
        observations,
        session.T_head_lrf,
        session.platform_sigma,
        prepared.pitch_noise.offset,
    )


def joint_settings(prepared: Prepared, observations: JointObservations) -> dict:
    """Which unknowns the data of a session ask for: keyword arguments of `solve_joint`.

    The axis and the scale of the pitch where something sweeps; a pitch error of every sweep where
    cameras on the base show that there is one; a spread of the edge bias where there are sides
    enough; the stated platform as a prior with its stated standard deviations.

    Parameters
    ----------
    prepared : Prepared
    observations : JointObservations
        Of it.

    Returns
    -------
    dict
    """
    session = prepared.session
    noise = prepared.pitch_noise
    sweeps = bool(
        largest_range(observations.face_pitch, observations.face_placement) > LEAST_SWEEP
    )
    sensor = ["range_offset", "edge_log_odds", "edge_log_softness"]
    if sweeps:  # a wrong scale that is held at zero goes into the axis
        sensor.append("pitch_scale")
    sides = np.unique([observations.beam_placement, observations.beam_edge], axis=1).shape[
        1
    ]
    settings = {
        "sensor": tuple(sensor),
        "noise": "estimate",
        "lapse": LAPSE,
        "sides": sides >= LEAST_SIDES,
        "axis": sweeps,
        "step_sigma": session.lrf.step_sigma,
    }
    if noise.offset:
        settings["sweep"] = "offset_stretch" if noise.stretch else "offset"
        settings["sweep_sigma"] = (noise.offset, noise.stretch or 0.01)
    if session.T_head_lrf is not None and sweeps:
        settings["prior"] = PlatformPrior(session.T_head_lrf, *session.platform_sigma)
    return settings


def largest_range(values: np.ndarray, groups: np.ndarray) -> float:
    """Largest range of the values of one group.

    Parameters
    ----------
    values, groups : ndarray, shape (n,)

    Returns
    -------
    float
        0 where there are none.
    """
    return max(
        (np.ptp(values[groups == group]) for group in np.unique(groups)), default=0.0
    )


@cached
def calibrate_jointly(prepared: Prepared, views=None) -> JointCalibration:
    """Estimate everything about a session's rig at once.

    Parameters
    ----------
    prepared : Prepared
    views : dict of str to list of BoardView, optional
        By camera; from all images when left out.

    Returns
    -------
    JointCalibration
        What the session does not determine is in `unobservable` and `warnings` of its solution, in
        words.

    Raises
    ------
    DegenerateGeometry
        When there is no start value, or most placements contradict each other.
    """
    observations = observe_joint(prepared, views or all_views(prepared))
    settings = joint_settings(prepared, observations)
    solution = solve_joint(observations, required=False, **settings)
    return JointCalibration(prepared, solution, settings, {})


def joint_or_problem(prepared: Prepared, views=None) -> JointCalibration | Problem:
    """As :func:`calibrate_jointly`, or the Problem that there is no joint estimate."""
    try:
        return calibrate_jointly(prepared, views)
    except DegenerateGeometry as error:
        return Problem(Stage.JOINT, ProblemKind.NO_RESULT, str(error), method="joint")


def with_joint(calibration: Calibration, joint: JointCalibration | Problem) -> Calibration:
    """Add the joint estimate to a calibration: its axis, its cameras, and observations made with
    them.

    Where the session does not determine the whole rig, only the problem is added.
    """
    if isinstance(joint, Problem):
        return replace(calibration, problems=(*calibration.problems, joint))
    platform = calibration.platform
    observations = dict(calibration.observations)
    solutions = dict(calibration.solutions)
    for camera in joint.observations.cameras:
        observations[camera, "joint"] = joint.seen_by(camera)
        solutions[camera, "joint"] = joint.solution.camera(camera)
    covariance = stated_covariance(platform.stated_sigma)
    if joint.settings["axis"]:  # scan lines of one pitch say nothing about it
        covariance = joint.solution.covariance(*AXIS_NAMES)
    axes = platform.axes | {"joint": KnownAxis(joint.solution.T_head_lrf, covariance)}
    return replace(
        calibration,
        platform=replace(platform, axes=axes),
        observations=observations,
        solutions=solutions,
        joint=joint,
    )


@cached
def leave_out(joint: JointCalibration, groups: int = 8) -> JointCalibration:
    """The estimate without each placement.

    Parameters
    ----------
    joint : JointCalibration
    groups : int
        Of placements that are left out together, one group in turn.

    Returns
    -------
    JointCalibration
        With `without` filled; placements whose absence leaves something open are missing there.
    """
    numbers = np.array(list(joint.solution.boards))
    estimates: dict = {}
    for group in range(min(groups, len(numbers))):
        out = numbers[group::groups]
        rest = joint.observations.select(np.setdiff1d(numbers, out))
        with suppress(DegenerateGeometry):
            estimates |= dict.fromkeys(out.tolist(), solve_again(rest, joint.solution))
    return replace(joint, without=estimates)


def handed_over(calibration: Calibration) -> str | None:
    """The method whose result goes into ``calibration.json`` and colours the cloud.

    Parameters
    ----------
    calibration : Calibration

    Returns
    -------
    str or None
        'joint' where that estimate converged and left nothing open; otherwise what
        :func:`lrfcal_lib.solvers.best_method` says. None where no camera was calibrated, or none
        could be judged.
    """
    joint = calibration.joint
    if joint and joint.solution.converged and not joint.solution.unobservable:
        return "joint"
    half_step = {
        camera: calibration.observations[camera, "half_step"]
        for camera in calibration.prepared.views
    }
    return best_method(half_step, calibration.solutions)
