"""Monte-Carlo trials of the joint estimate and of every method on single shots, beside bound and truth."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import pandas as pd
from scipy.spatial.transform import RigidTransform, Rotation
from scipy.special import logit
from scipy.stats import binom, chi2

from lrfcal_lib.fit.least_squares import reduced_hessian, whiten
from lrfcal_lib.fit.residuals import AXIS_COLUMNS, JointState, disc_share, gather, named_blocks
from lrfcal_lib.model.geometry import DegenerateGeometry, polar_to_points, pose_array, pose_transform
from lrfcal_lib.model.observations import CameraObservations
from lrfcal_lib.preprocess.board_in_scan import fit_lines, row_ends
from lrfcal_lib.solvers import solve_camera
from lrfcal_lib.solvers.joint import in_stated_gauge
from lrfcal_lib.solvers.lines import edge_bias

INTERVAL = 0.9
HALF_WIDTH = 1.6448536269514722  # standard normal: 90 % of it lies within
LIMITS = (0.005, 0.995)  # of what chance alone does
FEWEST_TRIALS = 10
SENSOR_GROUPS = {
    "range offset": ("range_offset", 1000.0, "mm"),
    "edge bias": ("edge_log_odds", 1.0, "log odds"),
    "edge softness": ("edge_log_softness", 1.0, "log"),
    "pitch scale": ("pitch_scale", 100.0, "%"),
    "pitch by direction": ("pitch_by_direction", np.degrees(1.0), "deg"),
}


@dataclass(frozen=True)
class Trials:
    """Errors of a solver over many draws.

    Attributes
    ----------
    names : tuple of str
        Of the k unknowns.
    seeds : ndarray of int, shape (t,)
        Of the trials that gave an estimate.
    errors : ndarray, shape (t, k)
        Increments that take the truth to the estimate.
    covariances : ndarray, shape (t, k, k)
        As the solver states them.
    bounds : ndarray, shape (t, k, k), or None
        Cramer-Rao bounds at the truth.
    failed : dict of int to str
        Seeds whose draw the solver refused, with its words.
    """

    names: tuple
    seeds: np.ndarray
    errors: np.ndarray
    covariances: np.ndarray
    bounds: np.ndarray | None = None
    failed: dict = field(default_factory=dict)


def joint_truth(obs, T_head_lrf, cameras, boards, *, range_offset=0.0, bias=0.0, softness=0.1, pitch_scale=0.0):
    """The truth behind drawn observations, in the form and gauge of the joint estimate.

    Parameters
    ----------
    obs : JointObservations
    T_head_lrf : RigidTransform
    cameras : dict of str to RigidTransform
        ``T_camera_lrf`` or ``T_camera_platform``; those that the observations name are taken.
    boards : list of RigidTransform
        ``T_platform_board`` of every placement.
    range_offset : float
        Metres.
    bias : float
        How far outside an edge a spot still reads the board, in spot radii, between -1 and 1.
    softness : float
        Standard deviation of that, in spot radii.
    pitch_scale : float
        The head turns ``1 + pitch_scale`` times as far as recorded.

    Returns
    -------
    JointState
    """
    poses = [pose_array(cameras[name]) for name in obs.cameras]
    log_odds = logit(disc_share(bias))
    state = JointState(
        pose_array(T_head_lrf),
        np.stack(poses) if poses else np.zeros((0, 3, 4)),
        np.array([range_offset, log_odds, np.log(softness), pitch_scale, 0.0]),
        np.zeros(len(obs.edges)),
        np.stack([pose_array(T) for T in boards]),
        np.zeros((len(boards), 2)),
        np.zeros((len(boards), len(obs.edges))),
    )
    return in_stated_gauge(state, obs)


def monte_carlo(draw, solve, seeds, *, bounds=True):
    """Solve many draws whose truth is known.

    Parameters
    ----------
    draw : callable
        ``rng -> (JointObservations, JointState)``: observations and the truth (:func:`joint_truth`).
    solve : callable
        ``JointObservations -> JointSolution``.
    seeds : iterable of int
        One generator each.
    bounds : bool
        Whether to compute the Cramer-Rao bound of every draw.

    Returns
    -------
    Trials

    Raises
    ------
    ValueError
        When every draw was refused, or the unknowns differ between draws.
    """
    rows, failed, names = [], {}, None
    for seed in seeds:
        obs, truth = draw(np.random.default_rng(seed))
        try:
            found = solve(obs)
        except DegenerateGeometry as error:
            failed[int(seed)] = str(error)
            continue
        names = names or found.solution.names
        if names != found.solution.names:
            raise ValueError(f"seed {seed} estimates {found.solution.names}, earlier ones {names}")
        limit = bound(obs, truth, found.unknowns) if bounds else None
        rows.append((int(seed), state_errors(found.state, truth, found.unknowns), found.solution.covariance, limit))
    if not rows:
        last = list(failed.values())[-1] if failed else "no seed given"
        raise ValueError(f"all {len(failed)} draws were refused, the last one: {last}")
    kept, errors, covariances, limits = (list(column) for column in zip(*rows, strict=True))
    limits = np.stack(limits) if bounds else None
    return Trials(names, np.array(kept), np.stack(errors), np.stack(covariances), limits, failed)


def state_errors(state, truth, unknowns):
    """Increments of the shared unknowns that take the truth to an estimate, shape (c,).

    Parameters
    ----------
    state, truth : JointState
        In the same gauge.
    unknowns : Unknowns
    """
    head = _increment(state.head, truth.head)[AXIS_COLUMNS]
    cameras = [_increment(a, b) for a, b in zip(state.cameras, truth.cameras, strict=True)]
    rest = (state.sensor - truth.sensor, state.size - truth.size)
    return np.concatenate([head, *cameras, *rest])[unknowns.mask]


def _increment(pose, true):
    """``[w, v]`` with ``R = exp(w) R_true`` and ``t = t_true + v``."""
    turn = pose_transform(pose).rotation * pose_transform(true).rotation.inv()
    return np.concatenate([turn.as_rotvec(), pose[:, 3] - true[:, 3]])


def bound(obs, truth, unknowns, **levels):
    """Cramer-Rao bound of the shared unknowns from the expected information at the truth.

    Nothing of the drawn values enters but which beams and views there are, so it checks the covariance that a solver
    takes from its own residuals. Board poses, and whatever else a placement owns, count as unknown.

    Parameters
    ----------
    obs : JointObservations
    truth : JointState
    unknowns : Unknowns
    **levels
        Noise levels of :class:`lrfcal_lib.fit.residuals.JointData`, e.g. ``face_scale=2.0``.

    Returns
    -------
    ndarray, shape (c, c)

    Raises
    ------
    DegenerateGeometry
        When the data leave a direction of the shared unknowns open.
    """
    data = replace(gather(obs), **levels)
    hessian = _information(truth, data, unknowns)
    total = np.sum(reduced_hessian(hessian, unknowns.shared), axis=0)
    scale = 1 / np.sqrt(np.maximum(np.diagonal(total), 1e-300))
    values, vectors = np.linalg.eigh(total * scale[:, None] * scale)
    if values[0] < 1e-11:
        names = unknowns.names(obs.cameras, obs.edges)
        open_ = ", ".join(names[i] for i in np.flatnonzero(np.abs(vectors[:, 0]) > 0.3))
        raise DegenerateGeometry(f"no bound: the data leave {open_} open")
    return (vectors / values) @ vectors.T * scale[:, None] * scale


def _information(truth, data, unknowns):
    """Expected information of each placement on all its unknowns, shape (p, k, k).

    The expectation over a beam near an edge is that over its two readings, weighted by how likely each is.
    """
    read, missed = (
        named_blocks(truth, replace(data, beam=data.beam | {"hit": np.full_like(data.beam["hit"], hit)}), unknowns)
        for hit in (True, False)
    )
    total = 0.0
    for name, block in read.items():
        J = whiten(block)[1]
        if name == "beam":
            chance = np.exp(-block.cost)[..., None]
            other = whiten(missed[name])[1]
            total = total + np.swapaxes(other, -1, -2) @ ((1 - chance) * other)
            J = np.sqrt(chance) * J
        total = total + np.swapaxes(J, -1, -2) @ J
    return total


def groups_of(names):
    """Unknowns in groups of one unit: dict of words to (indices, factor to that unit, unit)."""
    found = {}
    for i, name in enumerate(names):
        entry = _group(name)
        found.setdefault(entry[0], ([], *entry[1:]))[0].append(i)
    return found


def _group(name):
    if name.startswith("axis_"):
        return "axis direction", np.degrees(1.0), "deg"
    if name.startswith("offset_"):
        return "axis offset", 1000.0, "mm"
    if name.startswith("size_"):
        return "board size", 1000.0, "mm"
    for words, (key, factor, unit) in SENSOR_GROUPS.items():
        if name == key:
            return words, factor, unit
    camera, part = name.rsplit("_", 1)
    return (f"{camera} rotation", np.degrees(1.0), "deg") if part[0] == "r" else (f"{camera} translation", 1000.0, "mm")


def spread(covariance, names):
    """Standard deviation of each group of unknowns: root of the trace, in the group's unit.

    Parameters
    ----------
    covariance : ndarray, shape (k, k)
    names : tuple of str

    Returns
    -------
    dict of str to float
        E.g. ``{"axis direction": 0.05, "axis offset": 1.3}``, degrees and millimetres.
    """
    variance = np.diagonal(covariance)
    return {words: float(factor * np.sqrt(variance[i].sum())) for words, (i, factor, _) in groups_of(names).items()}


def consistency(trials, names=None):
    """How errors compare with the bound and with what the solver states, by group of unknowns and pooled.

    Parameters
    ----------
    trials : Trials
    names : bool, optional
        True: a row an unknown instead of a row a group.

    Returns
    -------
    DataFrame
        group, unit, rmse, crb (root of the mean trace of the bounds, or of the stated covariances where there are
        none), rmse_over_crb with the limits of chance, stated_over_crb, coverage of 90 % intervals with its limits,
        nees (mean normalised squared error by number of unknowns) with its limits, trials, failed. The last row pools
        all unknowns, each by its own bound.

    Raises
    ------
    ValueError
        With fewer than ten trials, or errors that are not finite.
    """
    count = len(trials.seeds)
    if count < FEWEST_TRIALS:
        raise ValueError(f"{count} trials say nothing about consistency: at least {FEWEST_TRIALS} are needed")
    if not (np.isfinite(trials.errors).all() and np.isfinite(trials.covariances).all()):
        bad = trials.seeds[~np.isfinite(trials.errors).all(axis=1)]
        raise ValueError(f"errors or covariances are not finite (seeds {bad.tolist()[:5]})")
    groups = {n: ([i], *_group(n)[1:]) for i, n in enumerate(trials.names)} if names else groups_of(trials.names)
    rows = [{"group": words} | _judge(trials, *entry) for words, entry in groups.items()]
    rows.append({"group": "all"} | _judge(trials, list(range(len(trials.names))), None, ""))
    table = pd.DataFrame(rows)
    table["trials"], table["failed"] = count, len(trials.failed)
    return table


def _judge(trials, index, factor, unit):
    """One row: a group in its unit, or (factor None) unknowns of many units, each in its own bounds."""
    e, C = trials.errors[:, index], trials.covariances[:, index][:, :, index]
    B = C if trials.bounds is None else trials.bounds[:, index][:, :, index]
    z = e / np.sqrt(np.diagonal(C, axis1=1, axis2=2))
    nees = np.mean(np.sum(e * np.linalg.solve(C, e[..., None])[..., 0], axis=-1)) / len(index)
    unit_of = 1 / np.sqrt(np.diagonal(B, axis1=1, axis2=2)) if factor is None else np.full(e.shape, factor)
    scaled = unit_of[:, :, None] * unit_of[:, None, :]
    rmse, crb, stated = (
        np.sqrt(np.mean(v)) for v in (np.sum((unit_of * e) ** 2, 1), _trace(B * scaled), _trace(C * scaled))
    )
    count, free = len(e), _freedom(np.mean(B * scaled, axis=0))
    seen = max(round(count * _freedom(_correlation(C))), 1)
    row = {"unit": unit, "rmse": rmse, "crb": crb, "rmse_over_crb": rmse / crb}
    row |= _span("rmse_over_crb", np.sqrt(chi2.ppf(LIMITS, count * free) / (count * free)))
    row |= {"stated_over_crb": stated / crb, "coverage": np.mean(np.abs(z) < HALF_WIDTH)}
    row |= _span("coverage", binom.ppf(LIMITS, seen, INTERVAL) / seen)
    return row | {"nees": nees} | _span("nees", chi2.ppf(LIMITS, count * len(index)) / (count * len(index)))


def _trace(stack):
    return np.trace(stack, axis1=-2, axis2=-1)


def _span(name, pair):
    return {f"{name}_low": pair[0], f"{name}_high": pair[1]}


def _freedom(C):
    """Independent numbers in a sum of squares of errors with covariance C (Satterthwaite)."""
    return np.trace(C) ** 2 / np.sum(C * C)


def _correlation(C):
    mean = np.mean(C, axis=0)
    s = np.sqrt(np.diagonal(mean))
    return mean / (s[:, None] * s)


UNIFORM = 1 / np.sqrt(12.0)
FACE = 24  # face points a placement


def observations(shots, setup, last_beam=False):
    """Drawn shots, as the preprocessing makes observations of a scan line.

    Parameters
    ----------
    shots : dict of ndarray
        Of :func:`lrfcal_lib.simulate.draw.draw_shots`.
    setup : ShotSetup
    last_beam : bool
        The last beam on the board instead of the half step to the first one off it.

    Returns
    -------
    CameraObservations
        With a leading trial axis: two crossings and 24 face points a placement.
    """
    ranges, bearings = shots["ranges"], setup.bearings()
    t, p, _ = ranges.shape
    flat = ranges.reshape(t * p, -1)
    lines, information = fit_lines(flat, bearings)
    _, first, last = row_ends(np.isfinite(flat))
    half = np.array([-0.5, 0.5]) * setup.step
    bearing = bearings[np.stack([first, last], axis=1)] + (0.0 if last_beam else half)
    points, turned, variance = _on_lines(lines, information, bearing, setup.sigma_range)
    noise = variance[..., None, None] * _outer(points / np.linalg.norm(points, axis=-1, keepdims=True))
    spacing = _outer(turned * setup.step * UNIFORM)
    radius = setup.radius(np.linalg.norm(points, axis=-1))
    found = {"points": points, "half_step": turned * half[:, None], "noise": noise, "covariance": noise + spacing}
    found |= {"radius": radius, "background": 0 * radius, "line_sigma": np.full(radius.shape, setup.sigma_px)}
    crossings = {f"crossing_{k}": v.reshape((t, 2 * p) + v.shape[2:]) for k, v in found.items()}
    return CameraObservations(
        setup.model, crossing_lines=shots["lines"].reshape(t, 2 * p, 3), crossing_placement=np.repeat(np.arange(p), 2),
        **crossings, **_faces(shots, setup),
    )  # fmt: skip


def _on_lines(lines, information, bearing, sigma):
    """Points of fitted lines at bearings (n, 2), how they move with the bearing, and their range variance."""
    ray = np.stack([np.cos(bearing), np.sin(bearing)], axis=-1)
    across = np.stack([-ray[..., 1], ray[..., 0]], axis=-1)
    r = 1 / np.sum(lines[:, None] * ray, axis=-1)
    slope = -(r**2) * np.sum(lines[:, None] * across, axis=-1)
    turned = slope[..., None] * ray + r[..., None] * across
    variance = r**4 * np.einsum("nei,nij,nej->ne", ray, np.linalg.inv(information) * sigma**2, ray)
    zero = np.zeros(r.shape + (1,))
    return polar_to_points(r, bearing), np.concatenate([turned, zero], axis=-1), variance


def _outer(v):
    return v[..., :, None] * v[..., None, :]


def _faces(shots, setup):
    """Face points of drawn shots for the plane method."""
    ranges, bearings = shots["ranges"], setup.bearings()
    t, p, _ = ranges.shape
    hit = np.isfinite(ranges)
    order = np.argsort(~hit, axis=-1, kind="stable")
    count = hit.sum(axis=-1)
    pick = np.minimum((np.linspace(0, 1, FACE) * (count[..., None] - 1)).round().astype(int), count[..., None] - 1)
    beam = np.take_along_axis(order, pick, axis=-1)
    points = polar_to_points(np.take_along_axis(ranges, beam, axis=-1), bearings[beam])
    rays = points / np.linalg.norm(points, axis=-1, keepdims=True)
    repeats = np.maximum(FACE / count, 1.0)  # a short line gives some of its points twice
    covariance = _outer(rays) * (setup.sigma_range**2 * repeats)[..., None, None, None] + 1e-10 * np.eye(3)
    return {
        "plane_points": points.reshape(t, p * FACE, 3), "plane_covariance": covariance.reshape(t, p * FACE, 3, 3),
        "plane_placement": np.repeat(np.arange(p), FACE), "board_poses": shots["boards"],
        "board_covariance": shots["board_covariance"],
    }  # fmt: skip


def solve_shots(shots, setup, T0):
    """All trials by every method.

    Parameters
    ----------
    shots : dict of ndarray
    setup : ShotSetup
    T0 : RigidTransform
        Start values, one a trial.

    Returns
    -------
    dict of str to Solution
        With a leading trial axis: line_last_beam (weighted), line, line_ml, zhang_pless.
    """
    half, last = observations(shots, setup), observations(shots, setup, last_beam=True)
    found = {"line_last_beam": solve_camera(last, "line", T0)}
    return found | {method: solve_camera(half, method, T0) for method in ("line", "line_ml", "zhang_pless")}


def shots_table(shots, setup, solutions):
    """Errors of every method over the trials.

    Parameters
    ----------
    shots : dict of ndarray
    setup : ShotSetup
    solutions : dict of str to Solution

    Returns
    -------
    DataFrame
        method, rotation_median_deg, rotation_rms_deg, translation_median_mm, translation_rms_mm, nees (mean normalised
        squared error of the pose over 6), bias_error (median absolute error of the edge bias in spot radii, NaN for
        methods without), converged (share).
    """
    truth = shots["T_camera_lrf"]
    rows = []
    for method, found in solutions.items():
        pose = found.transform.as_matrix()[:, :3]
        w = Rotation.from_matrix(pose[..., :3] @ np.swapaxes(truth[..., :3], -1, -2)).as_rotvec()
        v = pose[..., 3] - truth[..., 3]
        error = np.concatenate([w, v], axis=-1)
        angle, distance = np.degrees(np.linalg.norm(w, axis=-1)), 1000 * np.linalg.norm(v, axis=-1)
        spread = np.linalg.solve(found.covariance[..., :6, :6], error[..., None])[..., 0]
        row = {"method": method, "rotation_median_deg": np.median(angle), "rotation_rms_deg": _rms(angle)}
        row |= {"translation_median_mm": np.median(distance), "translation_rms_mm": _rms(distance)}
        bias = np.abs(edge_bias(found)[0] - setup.bias) if method == "line_ml" else np.array([np.nan])
        row |= {"nees": np.mean(np.sum(error * spread, axis=-1)) / 6, "bias_error": np.median(bias)}
        rows.append(row | {"converged": np.mean(found.converged)})
    return pd.DataFrame(rows)


def _rms(values):
    return float(np.sqrt(np.mean(values**2)))


def start_near(shots, rng, rotation=0.05, shift=0.05):
    """Start values some degrees and centimetres off the truth, a stack of RigidTransform."""
    truth = shots["T_camera_lrf"]
    turn = Rotation.from_rotvec(rng.normal(0, rotation, truth.shape[:1] + (3,)))
    moved = truth[..., 3] + rng.normal(0, shift, truth.shape[:1] + (3,))
    return RigidTransform.from_components(moved, turn * Rotation.from_matrix(truth[..., :3]))
