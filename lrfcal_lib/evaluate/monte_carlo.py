"""Monte-Carlo trials of the joint estimate: are the errors as small as the data allow, and as large as it says?

Three numbers answer it. The root mean square error over the Cramer-Rao bound tells what the estimator wastes (1:
nothing). The share of 90 % intervals that hold the truth, and the mean normalised squared error (1 where covariances
are right), tell whether its own statement can be trusted. Each stands beside the limits within which trials by the
number drawn let it scatter.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import pandas as pd
from scipy.special import logit
from scipy.stats import binom, chi2

from lrfcal_lib.geometry import DegenerateGeometry
from lrfcal_lib.solvers.edge_likelihood import disc_share
from lrfcal_lib.solvers.joint import in_stated_gauge
from lrfcal_lib.solvers.joint_blocks import AXIS_COLUMNS, JointState, gather, named_blocks
from lrfcal_lib.solvers.least_squares import whiten
from lrfcal_lib.solvers.observability import reduced_hessian
from lrfcal_lib.solvers.pose import pose_array, pose_transform

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
        Noise levels of :class:`lrfcal_lib.solvers.joint_blocks.JointData`, e.g. ``face_scale=2.0``.

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
