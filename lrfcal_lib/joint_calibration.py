"""The joint calibration of a session: which unknowns its data ask for, the estimate, and what it says of new data."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lrfcal_lib.geometry import DegenerateGeometry
from lrfcal_lib.joint_pairing import all_views, observe_joint
from lrfcal_lib.pairing import observe
from lrfcal_lib.solvers.camera import edge_residuals_px, plane_residuals_m
from lrfcal_lib.solvers.joint import JointSolution, solve_again, solve_joint
from lrfcal_lib.solvers.joint_observations import JointObservations
from lrfcal_lib.solvers.outline_ml import EdgeModel
from lrfcal_lib.solvers.platform import PlatformPrior
from lrfcal_lib.solvers.platform_blocks import chart_parameters
from lrfcal_lib.solvers.pose import pose_array

LAPSE = 0.01  # share of beams about an edge that something else than the edge decides
LEAST_SWEEP = np.radians(1.0)  # of the scan lines' pitch, for the axis
LEAST_SIDES = 8  # of all placements, for a spread of the edge bias from side to side


@dataclass(frozen=True)
class JointCalibration:
    """The joint calibration of a session.

    Attributes
    ----------
    prepared : Prepared
    observations : JointObservations
        Those that took part.
    solution : JointSolution
    settings : dict
        What was unknown, and why (see :func:`joint_settings`): keyword arguments of `solve_joint`.
    without : dict of int to JointSolution
        An estimate that has not seen the placement, by placement; filled by :func:`leave_out`.
    """

    prepared: object
    observations: JointObservations
    solution: JointSolution
    settings: dict
    without: dict

    def axis_parameters(self):
        """The four numbers of the axis and their covariance (see `Solution.trusted`); zero where it was not unknown."""
        found = self.solution.covariance("axis_", "offset_")
        covariance = found if len(found) else np.zeros((4, 4))
        return chart_parameters(pose_array(self.solution.T_head_lrf)), covariance

    def seen_by(self, camera, solution=None, **options):
        """Observations of a camera made with the platform, range offset and pitch of the joint estimate.

        Parameters
        ----------
        camera : str
        solution : JointSolution, optional
            Another one than the whole session's (without a placement).
        **options
            Of :func:`lrfcal_lib.pairing.observe`.
        """
        solution = solution or self.solution
        return observe(self.prepared, camera, "half_step", solution.T_head_lrf, solution.correct, **options)

    def edge_model(self, placement=None):
        """What the estimate knows about how the sensor sees edges, from all placements but one.

        Parameters
        ----------
        placement : int, optional
            The one that must not have taken part.

        Returns
        -------
        EdgeModel
        """
        solution = self.without.get(placement, self.solution)
        sigma = dict(zip(solution.solution.names, solution.solution.trusted_sigma, strict=True))
        sensor = solution.sensor
        return EdgeModel(
            log_odds=sensor["edge_log_odds"],
            log_odds_sigma=float(sigma.get("edge_log_odds", 0.0)),
            spread=solution.data.side_sigma if solution.unknowns.sides else 0.0,
            softness=float(np.exp(sensor["edge_log_softness"])),
            range_offset=sensor["range_offset"],
            range_offset_sigma=float(sigma.get("range_offset", 0.0)),
            T_head_lrf=solution.T_head_lrf,
            correct=solution.correct,
        )


def joint_settings(prepared, observations):
    """Which unknowns the data of a session ask for.

    Parameters
    ----------
    prepared : Prepared
    observations : JointObservations

    Returns
    -------
    dict
        Keyword arguments of :func:`lrfcal_lib.solvers.joint.solve_joint`: the axis and the scale of
        the pitch where something sweeps; a pitch error of every sweep where cameras on the base show that there is one;
        a spread of the edge bias where there are sides enough; the stated platform as a prior with its stated standard
        deviations.
    """
    session, noise = prepared.session, prepared.pitch_noise
    sensor, axis = ["range_offset", "edge_log_odds", "edge_log_softness"], bool(sweep_span(observations) > LEAST_SWEEP)
    if axis:  # a wrong scale that is held at zero goes into the axis
        sensor.append("pitch_scale")
    sides = len(np.unique(observations.beam_placement * 100 + observations.beam_edge))
    settings = {"sensor": tuple(sensor), "noise": "estimate", "lapse": LAPSE, "sides": sides >= LEAST_SIDES}
    settings["axis"] = axis
    if noise.offset:
        settings["sweep"] = "offset_stretch" if noise.stretch else "offset"
        settings["sweep_sigma"] = (noise.offset, noise.stretch or 0.01)
    if session.T_head_lrf is not None and settings["axis"]:
        settings["prior"] = PlatformPrior(session.T_head_lrf, *session.platform_sigma)
    return settings


def sweep_span(observations):
    """Largest pitch range of the scan lines on one board, radians."""
    places, pitch = observations.face_placement, observations.face_pitch
    return float(max((np.ptp(pitch[places == i]) for i in np.unique(places)), default=0.0))


def calibrate_jointly(prepared, views=None):
    """Estimate everything about a session's rig at once.

    Parameters
    ----------
    prepared : Prepared
    views : dict of str to list of BoardView, optional
        The board in all images; see :func:`lrfcal_lib.joint_pairing.all_views`.

    Returns
    -------
    JointCalibration
        What the session does not determine is in `solution.unobservable` and `solution.warnings`, in words.

    Raises
    ------
    DegenerateGeometry
        When there is no start value, or most placements contradict each other.
    """
    observations = observe_joint(prepared, all_views(prepared) if views is None else views)
    settings = joint_settings(prepared, observations)
    solution = solve_joint(observations, required=False, **settings)
    return JointCalibration(prepared, solution.observations, solution, settings, {})


def leave_out(joint, groups=8):
    """The estimate without each placement: groups of them are left out in turn.

    Parameters
    ----------
    joint : JointCalibration
    groups : int
        Placements are dealt out to so many groups; as many as there are placements leaves out one at a time.

    Returns
    -------
    JointCalibration
        With `without` filled; placements whose absence leaves something open are missing there.
    """
    numbers, found = np.array(list(joint.solution.boards)), {}
    for group in range(min(groups, len(numbers))):
        out = numbers[group::groups]
        try:
            solution = solve_again(joint.observations.select(np.setdiff1d(numbers, out)), joint.solution)
        except DegenerateGeometry:
            continue
        found |= {int(placement): solution for placement in out}
    return JointCalibration(joint.prepared, joint.observations, joint.solution, joint.settings, found)


def left_out_residuals(joint, camera):
    """Residuals of every placement under the estimate from all the others.

    Parameters
    ----------
    joint : JointCalibration
        With `without`.
    camera : str

    Returns
    -------
    edge_px, plane_m : ndarray
        As :func:`lrfcal_lib.evaluate.tables.left_out_residuals`: crossings of scan lines, and face points.
    """
    edges, planes = [np.zeros(0)], [np.zeros(0)]
    for placement, solution in joint.without.items():
        held = joint.seen_by(camera, solution).along().select([placement])
        edges.append(edge_residuals_px(held, solution.transforms[camera]))
        planes.append(plane_residuals_m(held, solution.transforms[camera]))
    return np.concatenate(edges), np.concatenate(planes)
