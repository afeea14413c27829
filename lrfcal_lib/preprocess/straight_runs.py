"""Straight runs in a trace of points: random sample consensus, the longest run first."""

import numpy as np

from lrfcal_lib.model.geometry import (
    fit_line,
    length_of,
    unit_vector,
)

FEWEST_POINTS = 5  # of a run
MOST_RUNS = 4  # on one hand of a board
LEAST_TURN = np.radians(
    8
)  # between neighbouring sides that end scan lines on the same hand
LONGEST_GAP = 5  # steps, or a tenth of the run
TRIALS = 300
REFINE_ROUNDS = 2


def straight_runs(
    points: np.ndarray, order: np.ndarray, tolerance: float, shortest: float
) -> list[np.ndarray]:
    """Split a trace into straight runs.

    Runs with fewer than five points, too short, or turned by less than 8 deg against a longer one
    (the same side, bent or frayed) are not returned.

    Parameters
    ----------
    points : ndarray, shape (n, 2)
        Metres.
    order : ndarray of int, shape (n,)
        Place along the trace (scan line or beam number).
    tolerance, shortest : float
        From the line, and of a run, metres.

    Returns
    -------
    list of ndarray of int
        The points of each run.
    """
    rng = np.random.default_rng(0)
    left = np.arange(len(points))
    runs: list[np.ndarray] = []
    directions: list[np.ndarray] = []
    for _ in range(2 * MOST_RUNS):
        if len(left) < FEWEST_POINTS or len(runs) == MOST_RUNS:
            break
        near = left[_consensus(points[left], tolerance, shortest / 2, rng)]
        run = _without_gaps(near, order)
        if len(run) < FEWEST_POINTS:
            break
        left = np.setdiff1d(left, run)
        _, direction, _ = fit_line(points[run])
        length = np.ptp(points[run] @ direction)
        cosines = [abs(direction @ other) for other in directions]
        if max(cosines, default=0.0) < np.cos(LEAST_TURN) and length >= shortest:
            runs.append(run)
            directions.append(direction)
    return runs


def _without_gaps(run, order):
    """The largest part of a run without a gap of more than a tenth of it (five steps at least)."""
    along = run[np.argsort(order[run], kind="stable")]
    gaps = np.diff(order[along]) > max(LONGEST_GAP, 0.1 * len(run))
    parts = np.split(along, np.flatnonzero(gaps) + 1)
    return np.sort(max(parts, key=len))


def _consensus(points, tolerance, apart, rng):
    """Which points lie near the line that most agree with, after two least-squares refinements."""
    a, b = points[rng.integers(len(points), size=(2, TRIALS))]
    along = b - a
    far = length_of(along) > apart
    if not far.any():
        return np.zeros(len(points), bool)
    normal = unit_vector(along[far, ::-1] * [-1, 1])
    distance = normal @ points.T - np.vecdot(normal, a[far])[:, None]
    # The sum of truncated squares ranks lines through the middle of a trace above those along its
    # rim.
    best = np.minimum((distance / tolerance) ** 2, 1).sum(axis=1).argmin()
    on = np.abs(distance[best]) < tolerance
    for _ in range(REFINE_ROUNDS):
        if on.sum() >= 2:
            centre, (x, y), _ = fit_line(points[on])
            on = np.abs((points - centre) @ [-y, x]) < tolerance
    return on
