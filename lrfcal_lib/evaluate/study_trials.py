"""Trials of a study: the same drawn single shots to every method, errors against the truth."""

import hashlib
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform

from lrfcal_lib.evaluate.monte_carlo import (
    HALF_WIDTH,
    bound,
    joint_truth,
)
from lrfcal_lib.fit.covariance import dyads, sigma_of
from lrfcal_lib.model.geometry import (
    POSE_UNITS,
    DegenerateGeometry,
    length_of,
    move_pose,
    polar_to_points,
    pose_step,
    pose_transform,
)
from lrfcal_lib.model.observations import CameraObservations, JointObservations
from lrfcal_lib.preprocess.board_in_scan import fit_lines
from lrfcal_lib.preprocess.edges_in_scan import UNIFORM, crossings_of
from lrfcal_lib.preprocess.surfaces import row_ends
from lrfcal_lib.session.cluster import source_digest
from lrfcal_lib.simulate.draw import REACH
from lrfcal_lib.simulate.shots import Scenario, draw_shots
from lrfcal_lib.solvers import solve_camera
from lrfcal_lib.solvers.joint import solve_joint
from lrfcal_lib.solvers.joint_model import Unknowns

FAR = 10.0  # deg from the truth: another minimum, or nothing was determined
# of crossings, solved as one batch; others trial by trial
BATCHED = ("line_printed", "line", "line_robust", "wasielewski_strauss")
STUDIED = (
    *BATCHED,
    "zhang_pless_printed",
    "zhang_pless",
    "zhang_pless_k",
    "three_planes",
    "joint",
)
# of `solve_camera`; without a start value the minimal solution is searched for
OPTIONS: dict[str, dict] = {
    "line_robust": {"method": "line", "robust": True},
    "three_planes": {"method": "zhang_pless", "T0": None, "robust": True},
}
LEAST_RANGE = 0.05  # metres: noise may make a near one negative


@dataclass(frozen=True)
class Task:
    """Some trials of a scenario: a unit of work that can go to any process."""

    scenario: Scenario
    methods: tuple[str, ...]
    n_poses: int
    seed: int
    first: int  # number of the first trial
    trials: int

    @property
    def key(self):
        """Tells it from any other, and from the same with another version of this library."""
        return hashlib.sha256(f"{source_digest()} {self}".encode()).hexdigest()[:24]


def run_task(task: Task) -> list[dict]:
    """Draw the trials of a task and solve them by every method.

    Parameters
    ----------
    task : Task

    Returns
    -------
    list of dict
        A row for every trial and method: scenario, what was varied of it, n_poses, trial, method,
        outcome ('ok', or why it failed), and where there is an estimate its errors rotation_deg and
        translation_mm; where boards are looked at the same as bound with unknown (``_bound``) and
        with known sensor (``_known``), and of the six numbers of the pose the mean squared error
        over the bound, and over the stated covariance, and how many lie in their 90 % intervals.
    """
    scenario = task.scenario
    rng = np.random.default_rng([task.seed, task.n_poses, task.first])
    shots = draw_shots(scenario, rng, task.trials, task.n_poses)
    start = np.reshape(scenario.start, (2, 1, 1)) * rng.standard_normal((2, task.trials, 3))
    T0 = pose_transform(move_pose(shots["T_camera_lrf"], np.concatenate(start, axis=1)))

    sessions = []
    bounds = [{}] * task.trials
    if not scenario.corner:
        sessions = [joint_session(shots, scenario, t) for t in range(task.trials)]
        bounds = [bounds_of_camera(obs, truth, scenario.sensor) for obs, truth in sessions]
    rows = []
    for method in task.methods:
        if method in BATCHED:
            estimates = _batch(method, shots, scenario, T0)
        else:
            estimates = [
                _single(method, shots, scenario, t, T0[t], sessions[t][0])
                for t in range(task.trials)
            ]
        for t, estimate in enumerate(estimates):
            rows.append(
                {
                    "scenario": scenario.name,
                    **scenario.varied,
                    "n_poses": task.n_poses,
                    "trial": task.first + t,
                    "method": method,
                    **_judged(estimate, shots["T_camera_lrf"][t], bounds[t]),
                }
            )
    return rows


def _batch(method, shots, scenario, T0):
    """Pose, covariance and what went wrong, of every trial."""
    obs = crossing_observations(shots, scenario, last_beam=method == "line_printed")
    try:
        options = {"method": method, "T0": T0} | OPTIONS.get(method, {})
        solution = solve_camera(obs, **options)
    except DegenerateGeometry as error:
        return [str(error)] * len(T0)
    converged = np.broadcast_to(solution.converged, len(T0))
    return zip(solution.transform, solution.covariance, converged, strict=True)


def _single(method, shots, scenario, trial, T0, obs):
    """The same of one trial, or the words of the solver's refusal."""
    try:
        if method == "joint":
            found = solve_joint(obs, axis=False, sensor=scenario.sensor).camera("camera")
        else:
            planes = plane_observations(obs, shots["pattern_pixels"][trial], scenario)
            options = {"method": method, "T0": T0} | OPTIONS.get(method, {})
            found = solve_camera(planes, search=False, **options)
    except (DegenerateGeometry, np.linalg.LinAlgError) as error:
        return str(error)
    return found.transform, found.covariance[:6, :6], found.converged


def _judged(estimate, true, bounds):
    """The columns of one estimate."""
    if isinstance(estimate, str):
        return {"outcome": f"refused: {estimate}"}
    transform, covariance, converged = estimate
    error = pose_step(pose_transform(true), transform)
    if not (np.isfinite(error).all() and np.isfinite(covariance).all()):
        return {"outcome": "not finite"}
    row = {"outcome": "ok"} | _sizes(error)
    if row["rotation_deg"] > FAR:
        row["outcome"] = "more than 10 deg from the truth"
    elif not converged:
        row["outcome"] = "not converged"
    if not bounds:
        return row
    for end, sigma in bounds.items():
        row |= _sizes(sigma, end)
    return row | {
        "over_bound": np.mean((error / bounds["_bound"]) ** 2),
        "nees": error @ np.linalg.pinv(covariance) @ error / 6,
        "covered": np.mean(np.abs(error) < HALF_WIDTH * sigma_of(covariance)),
    }


def _sizes(step, end=""):
    """Lengths of the turn and the shift of a step (6,), by column."""
    turn, shift = length_of(np.split(POSE_UNITS * step, 2))
    return {f"rotation_deg{end}": turn, f"translation_mm{end}": shift}


def crossing_observations(
    shots: dict, scenario: Scenario, last_beam: bool = False
) -> CameraObservations:
    """Where scan lines meet edges of boards, or of corners, trials first.

    Parameters
    ----------
    shots : dict of ndarray
        Of :func:`lrfcal_lib.simulate.shots.draw_shots`.
    scenario : Scenario
    last_beam : bool
        Crossings are at the last beams on the board instead of half a beam step outside.
    """
    if scenario.corner:
        lines = shots["lines"]
        points = shots["points"]
        covariance = np.broadcast_to(
            scenario.sigma_range**2 * np.eye(3), (*points.shape, 3)
        )
    else:
        lines = np.tile(shots["lines"], (1, 1, scenario.scans, 1))
        points, covariance = _ends_of_lines(shots["ranges"], scenario, last_beam)
    sessions, placements = lines.shape[:2]
    lines = lines.reshape(sessions, -1, 3)
    count = lines.shape[1]
    return CameraObservations(
        scenario.model,
        crossing_points=points.reshape(lines.shape),
        crossing_covariance=covariance.reshape(*lines.shape, 3),
        crossing_lines=lines,
        crossing_line_sigma=np.full((sessions, count), scenario.sigma_px),
        crossing_placement=np.arange(count) * placements // count,
    )


def _ends_of_lines(ranges, setup, last_beam):
    """Where the lines fitted to scan lines (t, p, s, B) end, (t p s, 2, 3), and their
    covariances.
    """
    bearings = setup.bearings()
    ranges = ranges.reshape(-1, len(bearings))
    lines, of_line = fit_lines(ranges, bearings)
    ends = bearings[row_ends(np.isfinite(ranges))[1]]
    if not last_beam:
        ends = ends + np.array([-0.5, 0.5]) * setup.step
    points, noise, by_bearing = crossings_of(lines, setup.sigma_range**2 * of_line, ends.T)
    covariance = dyads(noise) + dyads(by_bearing * setup.step * UNIFORM)
    return points.swapaxes(0, 1), covariance.swapaxes(0, 1)


def plane_observations(
    obs: JointObservations, pixels, scenario: Scenario
) -> CameraObservations:
    """All readings of a session as points of planes, and its pattern corners.

    Parameters
    ----------
    obs : JointObservations
        Of :func:`joint_session`.
    pixels : ndarray, shape (p, c, 2)
        Of the pattern's corners.
    scenario : Scenario
    """
    rays = polar_to_points(1.0, obs.face_bearing)
    along = scenario.sigma_range**2 * dyads(rays)
    return CameraObservations(
        scenario.model,
        pattern_points=scenario.board.pattern.points(),
        pattern_pixels=pixels,
        pattern_sigma_px=scenario.sigma_px,
        plane_points=obs.face_range[:, None] * rays,
        plane_covariance=along + 1e-10 * np.eye(3),  # not quite without thickness
        plane_placement=obs.face_placement,
        board_poses=obs.view_pose,
        board_covariance=obs.view_covariance,
    )


def joint_session(shots: dict, scenario: Scenario, trial: int):
    """One trial as the joint estimate takes it, and its truth: (JointObservations, JointState).

    The LRF stands still, so its head and the platform are one frame.

    Parameters
    ----------
    shots : dict of ndarray
        Of :func:`lrfcal_lib.simulate.shots.draw_shots`.
    scenario : Scenario
    trial : int
    """
    count = len(shots["ranges"][trial])
    obs = JointObservations(
        placements=np.arange(1, count + 1),
        **_readings(shots, scenario, trial),
        view_pose=pose_transform(shots["boards"][trial]).as_matrix(),
        view_covariance=shots["board_covariance"][trial],
        view_placement=np.arange(count),
        edges=scenario.board.edges,
        corners=scenario.board.known_corners(),
        cameras=("camera",),
        mounts=("head",),
        T_head_lrf=RigidTransform.identity(),
    )
    T_camera_lrf = pose_transform(shots["T_camera_lrf"][trial])
    boards = T_camera_lrf.inv() * pose_transform(shots["true_boards"][trial])
    return obs, joint_truth(
        obs,
        obs.T_head_lrf,
        {"camera": T_camera_lrf},
        boards,
        bias=scenario.bias,
        softness=scenario.softness,
    )


def _readings(shots, scenario, trial):
    """Readings of the boards, and the beams about the ends of their scan lines."""
    bearings = scenario.bearings()
    ranges = shots["ranges"][trial].reshape(-1, len(bearings))
    hit = np.isfinite(ranges)
    line, beam = np.nonzero(hit)
    _, ends = row_ends(hit)
    # beams about either end of every scan line
    ended, end, number = np.indices((*ends.shape, 2 * REACH)).reshape(3, -1)
    last = ends[ended, end]
    near = np.clip(last + end + number - REACH, 0, len(bearings) - 1)
    distance = np.maximum(ranges[ended, last], LEAST_RANGE)
    placement = ended // scenario.scans
    return {
        "face_range": ranges[hit],
        "face_bearing": bearings[beam],
        "face_sigma": np.full(len(beam), scenario.sigma_range),
        "face_placement": line // scenario.scans,
        "beam_bearing": bearings[near],
        "beam_hit": hit[ended, near],
        "beam_edge": shots["edges"][trial][placement, end],
        "beam_radius": scenario.radius(distance),
        "beam_step": scenario.step * distance,
        "beam_placement": placement,
    }


def bounds_of_camera(obs, truth, sensor):
    """Cramer-Rao bounds (6,) of the camera's standard deviations, the boards' poses unknown in
    either: '_bound' with these properties of the sensor unknown, '_known' with none. NaN where the
    data leave it open.
    """
    bounds = {}
    for name, open_ in (("_bound", sensor), ("_known", ())):
        unknowns = Unknowns(1, len(obs.edges), axis=False, sensor=open_)
        bounds[name] = np.full(6, np.nan)
        with suppress(DegenerateGeometry):
            bounds[name] = sigma_of(bound(obs, truth, unknowns))[:6]
    return bounds
