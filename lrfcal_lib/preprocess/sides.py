"""Straight sides in a trace of points in a plane."""

from __future__ import annotations

import numpy as np

FEWEST_POINTS = 5
LEAST_TURN = np.radians(8)  # between neighbouring sides that end scan lines on the same hand


def straight_runs(points, order, tolerance, shortest, rng=None, most=4):
    """Split a trace into straight runs: random sample consensus, the longest run first.

    Parameters
    ----------
    points : ndarray, shape (n, 2)
        Metres.
    order : ndarray, shape (n,)
        Position along the trace (scan line or beam number).
    tolerance : float
        Distance from a line up to which a point belongs to it, metres.
    shortest : float
        Shortest length of a run, metres.
    rng : numpy.random.Generator, optional
    most : int
        Number of runs at most.

    Returns
    -------
    list of ndarray of int
        Indices of the points of each run. Runs with fewer than five points, too short, or turned by less
        than 8 deg against a longer one (the same side, bent or frayed) are not returned.
    """
    rng = np.random.default_rng(0) if rng is None else rng
    left, runs, directions = np.arange(len(points)), [], []
    for _ in range(2 * most):
        if len(left) < FEWEST_POINTS or len(runs) == most:
            break
        found = left[_consensus(points[left], tolerance, shortest / 2, rng)]
        found = _contiguous(found, order)
        if len(found) < FEWEST_POINTS:
            break
        left = np.setdiff1d(left, found)
        _, direction, along, _ = line_of(points[found])
        turned = [abs(direction @ d) < np.cos(LEAST_TURN) for d in directions]
        if np.ptp(along) >= shortest and all(turned):
            runs.append(found)
            directions.append(direction)
    return runs


def line_of(points):
    """Total least squares line in a plane.

    Parameters
    ----------
    points : ndarray, shape (n, 2)

    Returns
    -------
    centre, direction : ndarray, shape (2,)
    along, across : ndarray, shape (n,)
        Coordinates of the points along the line and their signed distances from it.
    """
    centre = points.mean(axis=0)
    direction = np.linalg.eigh((points - centre).T @ (points - centre))[1][:, 1]
    offset = points - centre
    return centre, direction, offset @ direction, offset[:, 1] * direction[0] - offset[:, 0] * direction[1]


def _consensus(points, tolerance, apart, rng, trials=300):
    """Indices of the points near the line that most points agree with, after two least-squares refinements."""
    a, b = points[rng.integers(len(points), size=trials)], points[rng.integers(len(points), size=trials)]
    length = np.linalg.norm(b - a, axis=1)
    far = length > apart
    if not far.any():
        return np.zeros(0, int)
    a, along = a[far], (b - a)[far] / length[far, None]
    normal = np.stack([-along[:, 1], along[:, 0]], axis=1)
    distance = normal @ points.T - np.sum(normal * a, axis=1)[:, None]
    # The sum of truncated squares ranks lines through the middle of a trace above those along its rim.
    best = np.minimum((distance / tolerance) ** 2, 1).sum(axis=1).argmin()
    on = np.abs(distance[best]) < tolerance
    for _ in range(2):
        if on.sum() < 2:
            break
        centre, direction, _, _ = line_of(points[on])
        offset = points - centre
        on = np.abs(offset[:, 1] * direction[0] - offset[:, 0] * direction[1]) < tolerance
    return np.flatnonzero(on)


def _contiguous(found, order):
    """The largest part of a run without a gap of more than a tenth of it (five steps at least)."""
    if len(found) == 0:
        return found
    found = found[np.argsort(order[found], kind="stable")]
    gap = max(5, 0.1 * len(found))
    part = np.cumsum(np.r_[0, np.diff(order[found]) > gap])
    return np.sort(found[part == np.bincount(part).argmax()])
