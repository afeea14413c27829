"""Monte-Carlo trials of the joint estimate, beside bound and truth."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from scipy.spatial.transform import RigidTransform
from scipy.special import logit
from scipy.stats import binom, chi2

from lrfcal_lib.evaluate.tables import unit_of
from lrfcal_lib.fit.axis_chart import AXIS_COLUMNS
from lrfcal_lib.fit.covariance import (
    covariance_of,
    dyads,
    name_words,
    null_space,
    sigma_of,
    solve_each,
)
from lrfcal_lib.fit.edge_likelihood import disc_share
from lrfcal_lib.fit.robust import rms
from lrfcal_lib.model.geometry import (
    DegenerateGeometry,
    length_of,
    pose_array,
    pose_step,
    pose_transform,
)
from lrfcal_lib.model.observations import JointObservations
from lrfcal_lib.solvers.joint import in_stated_gauge
from lrfcal_lib.solvers.joint_model import JointState, Unknowns, undisturbed
from lrfcal_lib.solvers.joint_solution import expected_information

INTERVAL = 0.9
HALF_WIDTH = 1.6448536269514722  # standard normal: 90 % of it lies within
LIMITS = (0.005, 0.995)  # of what chance alone does
FEWEST_TRIALS = 10
MOST_SIGMA = 3e5  # standard deviations of one alone, in a direction that is left open
LARGE = 0.3  # share of its largest component, of those that are named
GROUPS = {  # in names of unknowns, one after the other: what they are together
    r"^axis_.*": "axis direction",
    r"^offset_.*": "axis offset",
    r"^edge_log_odds$": "edge bias",
    r"^edge_log_softness$": "edge softness",
    r"_r[xyz]$": " rotation",
    r"_t[xyz]$": " translation",
    r"_": " ",
}
LOGARITHMS = {"edge bias": "log odds", "edge softness": "log"}  # their units


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
    bounds : ndarray, shape (t, k, k)
        Cramer-Rao bounds at the truth.
    failed : dict of int to str
        Seeds whose draw the solver refused, with its words.
    """

    names: tuple
    seeds: np.ndarray
    errors: np.ndarray
    covariances: np.ndarray
    bounds: np.ndarray
    failed: dict


def joint_truth(
    obs,
    T_head_lrf,
    cameras,
    boards,
    *,
    range_offset=0.0,
    bias=0.0,
    softness=0.1,
    pitch_scale=0.0,
):
    """The truth behind drawn JointObservations, as a JointState in the joint estimate's gauge.

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
    bias, softness : float
        How far outside an edge a spot still reads the board, between -1 and 1, and the standard
        deviation of that, in spot radii.
    pitch_scale : float
        The head turns ``1 + pitch_scale`` times as far as recorded.
    """
    poses = np.array([pose_array(cameras[name]) for name in obs.cameras]).reshape(-1, 3, 4)
    sensor = np.array(
        [range_offset, logit(disc_share(bias)), np.log(softness), pitch_scale, 0.0]
    )
    boards = pose_array(RigidTransform.concatenate(boards))
    state = undisturbed(obs, pose_array(T_head_lrf), poses, sensor, boards)
    return in_stated_gauge(state, obs)


def monte_carlo(draw: Callable, solve: Callable, seeds: Iterable[int]) -> Trials:
    """Solve many draws whose truth is known: :class:`Trials`.

    Parameters
    ----------
    draw : callable
        ``rng -> (JointObservations, JointState)``: observations and the truth
        (:func:`joint_truth`).
    solve : callable
        ``JointObservations -> JointSolution``.
    seeds : iterable of int
        One generator each.

    Raises
    ------
    ValueError
        When every draw was refused.
    """
    rows = []
    failed = {}

    for seed in seeds:
        obs, truth = draw(np.random.default_rng(seed))
        try:
            joint = solve(obs)
        except DegenerateGeometry as error:
            failed[seed] = str(error)
            continue

        errors = state_errors(joint.state, truth, joint.unknowns)
        limit = bound(obs, truth, joint.unknowns)
        rows.append((seed, errors, joint.solution.covariance, limit))
    if not rows:
        last = next(reversed(failed.values()), "no seed given")
        raise ValueError(f"all {len(failed)} draws were refused, the last one: {last}")
    seeds, errors, covariances, bounds = map(np.array, zip(*rows, strict=True))
    return Trials(joint.solution.names, seeds, errors, covariances, bounds, failed)


def state_errors(state: JointState, truth: JointState, unknowns: Unknowns) -> np.ndarray:
    """Increments (c,) of the shared unknowns that take the truth to an estimate.

    Parameters
    ----------
    state, truth : JointState
        In one gauge.
    unknowns : Unknowns
    """
    head = pose_step(pose_transform(truth.head), pose_transform(state.head))
    cameras = pose_step(pose_transform(truth.cameras), pose_transform(state.cameras))
    steps = [head[AXIS_COLUMNS], cameras.ravel(), state.sensor - truth.sensor]
    return np.concatenate(steps)[unknowns.mask]


def bound(obs: JointObservations, truth: JointState, unknowns: Unknowns) -> np.ndarray:
    """Cramer-Rao bound of the shared unknowns from the expected information at the truth.

    Nothing of the drawn values enters but which beams and views there are, so it checks the
    covariance that a solver takes from its own residuals. Board poses, and whatever else a
    placement owns, count as unknown.

    Parameters
    ----------
    obs : JointObservations
    truth : JointState
    unknowns : Unknowns

    Returns
    -------
    ndarray, shape (c, c)

    Raises
    ------
    DegenerateGeometry
        When the data leave a direction of the shared unknowns open.
    """
    total = np.sum(expected_information(obs, truth, unknowns), axis=0)
    scale = 1 / np.sqrt(np.maximum(np.diagonal(total), 1e-300))
    left = null_space(total, scale, MOST_SIGMA)
    if len(left):
        open_ = name_words(left[0] / scale, unknowns.names(obs.cameras), LARGE)
        raise DegenerateGeometry(f"no bound: the data leave {open_} open")
    return covariance_of(total, scale, lost=())


def groups_of(names: Sequence[str]) -> dict[str, tuple[pd.Index, str, float]]:
    """Unknowns in groups of one unit: dict of words to (indices, unit, factor to that unit)."""
    words = pd.Series(names).replace(GROUPS, regex=True)
    groups = {}
    for group, index in words.groupby(words, sort=False).groups.items():
        unit, factor = unit_of(names[index[0]])
        groups[group] = index, LOGARITHMS.get(group, unit), factor
    return groups


def spread(covariance: np.ndarray, names: Sequence[str]) -> dict[str, float]:
    """Standard deviation of each group of unknowns in its unit: root of the trace of covariance.

    Parameters
    ----------
    covariance : ndarray, shape (c, c)
    names : sequence of str
        Of the unknowns.
    """
    variance = np.diagonal(covariance)
    return {
        words: factor * np.sqrt(variance[index].sum())
        for words, (index, _, factor) in groups_of(names).items()
    }


def consistency(trials: Trials) -> pd.DataFrame:
    """How errors compare with the bound and with what the solver states, by group and pooled.

    Parameters
    ----------
    trials : Trials

    Returns
    -------
    DataFrame
        Columns group, unit, rmse, crb (root of the mean trace of the bounds), rmse_over_crb,
        coverage of 90 % intervals, nees (mean normalised squared error by number
        of unknowns), limits of chance of three of them (_low, _high), trials, failed. The last row
        pools all unknowns, each by its own bound.

    Raises
    ------
    ValueError
        With fewer than ten trials, or errors that are not finite.
    """
    count = len(trials.seeds)
    if count < FEWEST_TRIALS:
        raise ValueError(
            f"{count} trials say nothing about consistency: at least {FEWEST_TRIALS} are needed"
        )
    bad = ~np.isfinite(trials.errors.sum(axis=1) + trials.covariances.sum(axis=(1, 2)))
    if bad.any():
        raise ValueError(
            f"errors or covariances are not finite (seeds {trials.seeds[bad].tolist()[:5]})"
        )
    groups = groups_of(trials.names) | {
        "all": (slice(None), "", 1 / sigma_of(trials.bounds))
    }
    rows = [
        {"group": words, "unit": unit} | _judge(trials, index, factor)
        for words, (index, unit, factor) in groups.items()
    ]
    return pd.DataFrame(rows).assign(trials=count, failed=len(trials.failed))


def _judge(trials, index, factor):
    """One row: a group of unknowns, each by a factor to its unit."""
    e = trials.errors[:, index]
    C = trials.covariances[:, index][..., index]
    B = trials.bounds[:, index][..., index]
    mean = np.mean(C, axis=0)
    seen = max(round(len(e) * _freedom(mean / dyads(sigma_of(mean)))), 1)
    unit = np.broadcast_to(factor, e.shape)
    B = B * dyads(unit)
    crb = np.sqrt(np.mean(np.linalg.trace(B)))
    rmse = rms(length_of(unit * e))
    free = len(e) * _freedom(np.mean(B, axis=0))
    row = {
        "rmse": rmse,
        "crb": crb,
        "rmse_over_crb": rmse / crb,
        "coverage": np.mean(np.abs(e) < HALF_WIDTH * sigma_of(C)),
        "nees": np.mean(e * solve_each(C, e)),
    }
    row["rmse_over_crb_low"], row["rmse_over_crb_high"] = np.sqrt(
        chi2.ppf(LIMITS, free) / free
    )
    row["coverage_low"], row["coverage_high"] = binom.ppf(LIMITS, seen, INTERVAL) / seen
    row["nees_low"], row["nees_high"] = chi2.ppf(LIMITS, e.size) / e.size
    return row


def _freedom(C):
    """Independent numbers in a sum of squares of errors with covariance C (Satterthwaite)."""
    return np.trace(C) ** 2 / np.sum(C * C)
