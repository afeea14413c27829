"""Trials of a study: the same drawn single shots to every method, errors against the truth."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from lrfcal_lib.evaluate.monte_carlo import (
    HALF_WIDTH,
    bound,
    joint_truth,
    observations,
    pose_errors,
)
from lrfcal_lib.model.geometry import (
    DegenerateGeometry,
    polar_to_points,
    pose_array,
    pose_transform,
)
from lrfcal_lib.model.observations import CameraObservations, JointObservations
from lrfcal_lib.preprocess.surfaces import row_ends
from lrfcal_lib.simulate.draw import REACH, draw_shots
from lrfcal_lib.simulate.scenarios import Scenario
from lrfcal_lib.solvers import solve_camera
from lrfcal_lib.solvers.joint import solve_joint
from lrfcal_lib.solvers.joint_model import Unknowns

FAR = np.radians(10.0)  # from the truth: another minimum, or nothing was determined
# of crossings: solved as one batch; whether the edge point is at the last beam
BATCHED = {"line_printed": True, "line": False, "wasielewski_strauss": False}
PLANES = ("zhang_pless_printed", "zhang_pless")
STUDIED = (*BATCHED, *PLANES, "three_planes", "joint")
DIGITS = 9
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
        """What tells it from the others of a study."""
        return f"{self.scenario.name}/{self.n_poses}/{self.first}"


def run_task(task: Task) -> list[dict]:
    """Draw the trials of a task and solve them by every method.

    Parameters
    ----------
    task : Task

    Returns
    -------
    list of dict
        A row for every trial and method: scenario, n_poses, trial, method, outcome ('ok', or why
        it failed), and where there is an estimate rotation (radians) and translation (metres)
        errors, the same as bound with unknown and with known sensor, and of the six numbers of the
        pose the mean squared error over the bound, and over the stated covariance, and how many lie
        in their 90 % intervals.
    """
    rng = np.random.default_rng([task.seed, task.n_poses, task.first])
    shots = draw_shots(task.scenario, rng, task.trials, task.n_poses)
    true = pose_transform(shots["T_camera_lrf"])
    turn_sigma, shift_sigma = task.scenario.start
    turn = Rotation.from_rotvec(turn_sigma * rng.standard_normal((task.trials, 3)))
    shift = shift_sigma * rng.standard_normal((task.trials, 3))
    T0 = RigidTransform.from_components(true.translation + shift, turn * true.rotation)

    sessions = [joint_session(shots, task.scenario, t) for t in range(task.trials)]
    sensor = task.scenario.sensor
    bounds = [bounds_of_camera(obs, truth, sensor) for obs, truth in sessions]
    rows = []
    for method in task.methods:
        if method in BATCHED:
            estimates = _batch(method, shots, task.scenario, T0)
        else:
            estimates = [
                _single(method, shots, task.scenario, t, T0[t], sessions[t][0])
                for t in range(task.trials)
            ]
        for t, estimate in enumerate(estimates):
            row = {
                "scenario": task.scenario.name,
                "n_poses": task.n_poses,
                "trial": task.first + t,
                "method": method,
            }
            rows.append(row | _judged(estimate, shots["T_camera_lrf"][t], bounds[t]))
    return rows


def _batch(method, shots, scenario, T0):
    """Pose, covariance and what went wrong, of every trial."""
    obs = observations(shots, scenario, last_beam=BATCHED[method])
    try:
        solution = solve_camera(obs, method, T0)
    except DegenerateGeometry as error:
        return [str(error)] * len(T0)
    poses = pose_array(solution.transform)
    converged = np.broadcast_to(solution.converged, len(poses))
    return list(zip(poses, solution.covariance, converged, strict=True))


def _single(method, shots, scenario, trial, T0, obs):
    """The same of one trial, or the words of the solver's refusal."""
    try:
        if method == "joint":
            solution = solve_joint(obs, axis=False, sensor=scenario.sensor)
            camera = solution.state.cameras[0]
            return camera, solution.solution.covariance[:6, :6], True
        planes = plane_observations(shots, scenario, trial)
        if method == "three_planes":
            found = solve_camera(planes, "zhang_pless", robust=True)
        else:
            found = solve_camera(planes, method, T0, search=False)
    except (DegenerateGeometry, np.linalg.LinAlgError) as error:
        return str(error)
    return pose_array(found.transform), found.covariance, bool(found.converged)


def _judged(estimate, true, bounds):
    """The columns of one estimate."""
    if isinstance(estimate, str):
        return {"outcome": f"refused: {estimate}"}
    pose, covariance, converged = estimate
    error = pose_errors(pose[None], true[None])[0]
    if not (np.isfinite(error).all() and np.isfinite(covariance).all()):
        return {"outcome": "not finite"}
    unknown, known = bounds
    turn = np.linalg.norm(error[:3])
    outcome = "ok"
    if turn > FAR:
        outcome = "more than 10 deg from the truth"
    elif not converged:
        outcome = "not converged"
    interval = HALF_WIDTH * np.sqrt(np.maximum(np.diagonal(covariance), 0))
    numbers = {
        "rotation": turn,
        "translation": np.linalg.norm(error[3:]),
        "bound_rotation": np.sqrt(np.trace(unknown[:3, :3])),
        "bound_translation": np.sqrt(np.trace(unknown[3:, 3:])),
        "known_rotation": np.sqrt(np.trace(known[:3, :3])),
        "known_translation": np.sqrt(np.trace(known[3:, 3:])),
        "over_bound": np.mean(error**2 / np.diagonal(unknown)),
        "nees": error @ np.linalg.pinv(covariance) @ error / 6,
        "covered": np.mean(np.abs(error) < interval),
    }
    rounded = {key: float(f"{value:.{DIGITS}g}") for key, value in numbers.items()}
    return {"outcome": outcome} | rounded


def plane_observations(shots: dict, scenario: Scenario, trial: int) -> CameraObservations:
    """All readings on the boards of one trial, as points of planes.

    Parameters
    ----------
    shots : dict of ndarray
        Of :func:`lrfcal_lib.simulate.draw.draw_shots`.
    scenario : Scenario
    trial : int
    """
    ranges = shots["ranges"][trial]
    placement, beam = np.nonzero(np.isfinite(ranges))
    rays = polar_to_points(1.0, scenario.bearings()[beam])
    along = rays[:, :, None] * rays[:, None, :]
    boards = np.tile(np.eye(4), (len(ranges), 1, 1))
    boards[:, :3] = shots["boards"][trial]
    return CameraObservations(
        scenario.model,
        plane_points=ranges[placement, beam, None] * rays,
        plane_covariance=scenario.sigma_range**2 * along + 1e-10 * np.eye(3),
        plane_placement=placement,
        placements=np.arange(len(ranges)),
        board_poses=boards,
        board_covariance=shots["board_covariance"][trial],
    )


def joint_session(shots: dict, scenario: Scenario, trial: int):
    """One trial as the joint estimate takes it, and its truth: (JointObservations, JointState).

    The LRF stands still, so its head and the platform are one frame.

    Parameters
    ----------
    shots : dict of ndarray
        Of :func:`lrfcal_lib.simulate.draw.draw_shots`.
    scenario : Scenario
    trial : int
    """
    count = len(shots["ranges"][trial])
    views = np.tile(np.eye(4), (count, 1, 1))
    views[:, :3] = shots["boards"][trial]
    obs = JointObservations(
        placements=np.arange(1, count + 1),
        middle=np.zeros(count),
        direction=np.zeros(count, int),
        **_readings(shots, scenario, trial),
        view_camera=np.zeros(count, int),
        view_pitch=np.zeros(count),
        view_pose=views,
        view_covariance=shots["board_covariance"][trial],
        view_placement=np.arange(count),
        edges=scenario.board.edges,
        corners=np.asarray(scenario.board.corners, float),
        cameras=("camera",),
        mounts=("head",),
        T_head_lrf=RigidTransform.identity(),
    )
    T_camera_lrf = pose_transform(shots["T_camera_lrf"][trial])
    boards = T_camera_lrf.inv() * pose_transform(shots["true_boards"][trial])
    truth = joint_truth(
        obs,
        RigidTransform.identity(),
        {"camera": T_camera_lrf},
        [boards[i] for i in range(count)],
        bias=scenario.bias,
        softness=scenario.softness,
    )
    return obs, truth


def _readings(shots, scenario, trial):
    """Readings of the boards, and the beams about the ends of their scan lines."""
    ranges = shots["ranges"][trial]
    bearings = scenario.bearings()
    hit = np.isfinite(ranges)
    placement, beam = np.nonzero(hit)
    _, first, last = row_ends(hit)
    near = np.arange(2 * REACH) - REACH  # beams about the end of a scan line
    beams = np.stack([first[:, None] + near, last[:, None] + 1 + near], axis=1)
    beams = np.clip(beams, 0, len(bearings) - 1)
    shape = beams.shape
    which = np.broadcast_to(np.arange(len(ranges))[:, None, None], shape).ravel()
    ends = np.take_along_axis(ranges, np.stack([first, last], axis=1), axis=1)
    at_end = np.broadcast_to(np.maximum(ends, LEAST_RANGE)[..., None], shape).ravel()
    return {
        "face_range": ranges[placement, beam],
        "face_bearing": bearings[beam],
        "face_pitch": np.zeros(len(beam)),
        "face_sigma": np.full(len(beam), scenario.sigma_range),
        "face_placement": placement,
        "beam_bearing": bearings[beams].ravel(),
        "beam_pitch": np.zeros(len(which)),
        "beam_hit": hit[which, beams.ravel()],
        "beam_edge": np.broadcast_to(shots["edges"][trial][..., None], shape).ravel(),
        "beam_radius": scenario.radius(at_end),
        "beam_background": np.zeros(len(which)),
        "beam_step": scenario.step * at_end,
        "beam_placement": which,
    }


def bounds_of_camera(obs, truth, sensor):
    """Cramer-Rao bounds (6, 6) of the camera, the boards' poses unknown in either: with these
    properties of the sensor unknown, and with all known. NaN where the data leave it open.
    """
    bounds = []
    for open_ in (sensor, ()):
        unknowns = Unknowns(1, len(obs.edges), axis=False, sensor=open_)
        try:
            bounds.append(bound(obs, truth, unknowns)[:6, :6])
        except DegenerateGeometry:
            bounds.append(np.full((6, 6), np.nan))
    return bounds
