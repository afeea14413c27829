"""Speed and consistency of the joint estimate: against GTSAM (where installed), scipy, and its own bound.

All of them solve the same residuals from the same start value: ranges, views, and for every beam near an edge the
Gaussian that its likelihood is at the solution (mean and variance of its margin). Only the first row is the whole job
of `solve_joint`: start values from nothing, then the likelihood itself. Run with ``make bench``.
"""

import time
from dataclasses import replace

import numpy as np
import pandas as pd
from bench import seconds
from joint_draws import draw
from scipy.optimize import least_squares
from scipy.spatial.transform import RigidTransform, Rotation

from lrfcal_lib.evaluate.monte_carlo import consistency, monte_carlo
from lrfcal_lib.fit.least_squares import Block, minimise, whiten
from lrfcal_lib.fit.residuals import (
    AXIS_COLUMNS,
    LEAST_STEP,
    Unknowns,
    assemble,
    beam_terms,
    edge_distance,
    edge_shift,
    face_block,
    gather,
    move_state,
    ray_columns,
    rays,
    view_block,
)
from lrfcal_lib.model.geometry import cross, pose_transform
from lrfcal_lib.solvers.joint import best_start, solve_joint

try:
    import gtsam
except ImportError:
    gtsam = None

COLUMNS = ["what", "value", "unit", "against", "times_faster"]
FACE, BEAMS = 40, 30
SENSOR = ("range_offset", "edge_log_odds")


def thinned(obs, **most):
    """Observations with at most so many rows of each group a placement, evenly picked."""
    masks = {}
    for name, count in most.items():
        place = getattr(obs, f"{name}_placement")
        masks[name] = np.zeros(len(place), bool)
        for p in range(len(obs.placements)):
            rows = np.flatnonzero(place == p)
            masks[name][rows[np.linspace(0, len(rows) - 1, min(count, len(rows))).round().astype(int)]] = True
    return obs.keep(**masks)


def problem(count):
    """A drawn session, its solution, and the Gaussians of its beams there."""
    obs, _, _ = draw(np.random.default_rng(0), count)
    obs = thinned(obs, face=FACE, beam=BEAMS)
    found = solve_joint(obs)
    unknowns = Unknowns(len(obs.cameras), len(obs.edges), sensor=SENSOR)
    data = gather(obs)
    margin = margins(found.state, data, unknowns)[0]
    sigma = np.where(data.beam["used"], data.beam["radius"], 1.0) * np.exp(found.state.sensor[2])
    _, score, information, _ = beam_terms(margin, sigma, data.beam["hit"])
    information = np.maximum(information, 1.0) * data.beam["used"]
    target = margin - score / np.maximum(information, 1.0)
    start = best_start(obs, found.unknowns, data.sweep_sigma)[1]
    start = replace(start, sensor=np.where(np.arange(5) == 2, found.state.sensor, start.sensor))
    return obs, replace(data, beam=data.beam | {"target": target, "root": np.sqrt(information)}), unknowns, start


def margins(state, data, unknowns):
    """How far inside the place where readings flip the beams lie (p, n), and the Jacobian."""
    group = data.beam
    ray = rays(state, data, group)
    u, by_o, by_d, by_t, a, t, _ = edge_distance(state, data, group, ray)
    shift, slope = edge_shift(state.sensor[1], group["radius"], group["background"])
    head, parts = ray_columns(-by_o, -by_d, ray)
    board = np.concatenate([cross(t, -by_t) + cross(a, by_o), by_o], axis=-1)
    return shift - u, assemble(unknowns, axis=head, parts=parts, board=board, edge_log_odds=slope[..., None])


def gaussian_blocks(state, data, unknowns):
    """Ranges, beams as Gaussians, and views."""
    margin, J = margins(state, data, unknowns)
    beams = Block(margin - data.beam["target"], J, data.beam["root"])
    return [face_block(state, data, unknowns), beams, view_block(state, data, unknowns)]


def ours(data, unknowns, start):
    """The joint estimate's own core on the Gaussian problem."""
    return minimise(
        lambda s: gaussian_blocks(s, data, unknowns), start, lambda s, d: move_state(s, d, unknowns),
        shared=unknowns.shared, tolerance=1e-4,
    )[0]  # fmt: skip


def by_scipy(data, unknowns, start):
    """scipy's dense trust region with a numeric Jacobian, increments about the start value."""
    count, c = len(start.boards), unknowns.shared

    def state_of(x):
        return move_state(start, (x[:c], x[c:].reshape(count, -1)), unknowns)

    def residuals(x):
        return np.concatenate([whiten(b, False)[0].ravel() for b in gaussian_blocks(state_of(x), data, unknowns)])

    return state_of(least_squares(residuals, np.zeros(c + count * unknowns.own), method="trf", x_scale="jac").x)


def one_placement(data, p):
    """The data of one placement without its padding."""
    groups = {}
    for name in ("face", "beam", "view"):
        group = getattr(data, name)
        groups[name] = {key: value[p : p + 1, group["used"][p]] for key, value in group.items()}
    return replace(data, **groups, middle=data.middle[p : p + 1], direction=data.direction[p : p + 1])


HEAD, SENSOR_KEY, FIRST_CAMERA, FIRST_BOARD = 0, 1, 2, 100


def by_gtsam(pieces, data, unknowns, start):
    """GTSAM's Levenberg-Marquardt with one vectorised Python factor a placement."""
    eyes = [FIRST_CAMERA + i for i in range(len(start.cameras))]
    boards = [FIRST_BOARD + i for i in range(len(start.boards))]
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    poses = [start.head, *start.cameras, *start.boards]
    for key, pose in zip([HEAD, *eyes, *boards], poses, strict=True):
        values.insert(key, gtsam.Pose3(gtsam.Rot3(pose[:, :3]), pose[:, 3]))
    values.insert(SENSOR_KEY, start.sensor[:2])
    for board, piece in zip(boards, pieces, strict=True):
        graph.add(placement_factor([HEAD, SENSOR_KEY, *eyes, board], piece, unknowns, start))
    graph.add(gauge_factor(start))
    found = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    state = state_at(found, [HEAD, SENSOR_KEY, *eyes, boards[0]], start)
    return replace(state, boards=np.stack([found.atPose3(key).matrix()[:3] for key in boards]))


def state_at(values, keys, start):
    """The state of one placement from GTSAM's values."""
    head, sensor, *eyes, board = keys
    poses = [values.atPose3(key).matrix()[:3] for key in (head, *eyes, board)]
    sensors = np.r_[values.atVector(sensor), start.sensor[2:]]
    state = replace(start, head=poses[0], cameras=np.stack(poses[1:-1]), boards=poses[-1][None])
    return replace(state, sensor=sensors, sweeps=start.sweeps[:1])


def placement_factor(keys, piece, unknowns, start):
    """All residuals of one placement as one factor."""
    c = len(start.cameras)

    def error(_, values, jacobians):
        state = state_at(values, keys, start)
        parts = [whiten(b, jacobians is not None) for b in gaussian_blocks(state, piece, unknowns)]
        if jacobians is not None:
            J = np.concatenate([part[1][0] for part in parts])
            wide = np.zeros((len(J), 6))
            wide[:, AXIS_COLUMNS] = J[:, :4]
            jacobians[0], jacobians[1] = local(wide, state.head), J[:, 4 + 6 * c : 6 + 6 * c]
            for i in range(c):
                jacobians[2 + i] = local(J[:, 4 + 6 * i : 10 + 6 * i], state.cameras[i])
            jacobians[-1] = local(J[:, -6:], state.boards[0])
        return np.concatenate([part[0][0] for part in parts])

    rows = sum(getattr(piece, name)["used"].size * n for name, n in (("face", 1), ("beam", 1), ("view", 6)))
    return gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(rows), keys, error)


def gauge_factor(start):
    """Holds the turn about the axis and the shift along it, which no data show."""

    def error(_, values, jacobians):
        pose = values.atPose3(HEAD).matrix()
        if jacobians is not None:
            jacobians[0] = local(np.eye(6)[[0, 3]], pose)
        turn = Rotation.from_matrix(pose[:3, :3] @ start.head[:, :3].T).as_rotvec()
        return np.array([turn[0], pose[0, 3] - start.head[0, 3]])

    return gtsam.CustomFactor(gtsam.noiseModel.Isotropic.Sigma(2, 1e-3), [HEAD], error)


def local(J, pose):
    """Columns by increments in the destination frame to those by GTSAM's local ones."""
    R = pose[:3, :3]
    return np.asfortranarray(np.concatenate([J[:, :3] @ R, J[:, 3:] @ R], axis=1))


def apart(a, b):
    """Largest difference of the cameras' poses."""
    return float(np.abs(a.cameras - b.cameras).max())


def against_gtsam(count=100):
    """The whole job, and its core against GTSAM."""
    obs, data, unknowns, start = problem(count)
    whole = seconds(lambda: solve_joint(obs))
    core = seconds(lambda: ours(data, unknowns, start))
    size = f"{count} placements x {FACE} ranges, {BEAMS} beams, 6 views"
    if gtsam is None:
        yield f"joint estimate, start values included, {size}", 1000 * whole, "ms", "GTSAM is not installed", np.nan
        return
    pieces = [one_placement(data, p) for p in range(count)]
    theirs = seconds(lambda: by_gtsam(pieces, data, unknowns, start))
    other = by_gtsam(pieces, data, unknowns, start)
    assert apart(ours(data, unknowns, start), other) < 1e-5, "GTSAM and we end in different places"
    against = "GTSAM, its iterations only"
    yield f"joint estimate, start values included, {size}", 1000 * whole, "ms", against, theirs / whole
    yield "its core on Gaussian residuals, same start", 1000 * core, "ms", against, theirs / core


def against_scipy(count=10):
    """The core against scipy with a dense numeric Jacobian, on a small problem."""
    _, data, unknowns, start = problem(count)
    core = seconds(lambda: ours(data, unknowns, start))
    begin = time.perf_counter()
    other = by_scipy(data, unknowns, start)
    theirs = time.perf_counter() - begin
    assert apart(ours(data, unknowns, start), other) < 1e-5, "scipy and we end in different places"
    yield f"its core, {count} placements", 1000 * core, "ms", "scipy trf, numeric Jacobian", theirs / core


def far_starts(count=100):
    """Share of wrong start values (60 degrees, half a metre) that end at the same answer, on both mounts."""
    for mount in ("head", "platform"):
        obs, truth, _ = draw(np.random.default_rng(1), 12, mount=mount)
        best, rng, same = solve_joint(obs), np.random.default_rng(2), 0
        for _ in range(count):
            turn, away = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 3)))
            wrong = RigidTransform.from_components(0.5 * away, Rotation.from_rotvec(np.radians(60) * turn))
            found = solve_joint(obs, wrong * pose_transform(truth.head))
            same += np.all(np.abs(found.solution.parameters - best.solution.parameters) < 0.01 * best.solution.sigma)
        yield f"far starts that reach the same answer, {mount}", same, f"of {count}", "", np.nan


def trials(count=100, placements=20, step_deg=0.5):
    """Errors against bound, coverage and normalised squared error at the paper's set-up, both mounts."""
    step = np.radians(step_deg)
    for mount in ("head", "platform"):
        result = monte_carlo(
            lambda rng, mount=mount: draw(rng, placements, mount=mount, pitch_step=step, floor=LEAST_STEP)[:2],
            lambda obs: solve_joint(obs, required=False),
            range(1000, 1000 + count),
        )
        print(f"\n{mount}, {placements} placements, {count} draws")
        shown = ["group", "unit", "rmse", "crb", "rmse_over_crb", "coverage", "nees", "nees_low", "nees_high", "failed"]
        print(consistency(result)[shown].round(3).to_string(index=False))


def main(consistent=True):
    rows = [row for part in (against_gtsam, against_scipy, far_starts) for row in part()]
    print(pd.DataFrame(rows, columns=COLUMNS).round(2).to_string(index=False))
    if consistent:
        trials()


if __name__ == "__main__":
    main()
