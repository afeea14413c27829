"""Placements that disagree with all others: a board pose gone wrong, a scan line on something else, a mistaken edge."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from lrfcal_lib.solvers.camera import edge_residuals_px, plane_residuals_m, solve_lines
from lrfcal_lib.solvers.start import starting_transform
from lrfcal_lib.solvers.zhang_pless import solve_zhang_pless


@dataclass(frozen=True)
class PlacementReport:
    """How well each placement agrees with a robust estimate.

    Attributes
    ----------
    placements : ndarray of int, shape (p,)
    rms : ndarray, shape (p,)
        Root mean square residual of the placement: metres from the plane, or pixels from the lines.
    limit : ndarray, shape (p,)
        What is still accepted.
    outlying : tuple of int
        Placements above their limit.
    inliers : tuple of int
    kind : str
        'planes' or 'lines'.
    """

    placements: np.ndarray
    rms: np.ndarray
    limit: np.ndarray
    outlying: tuple[int, ...]
    inliers: tuple[int, ...]
    kind: str


def find_outlying_placements(obs, kind="planes", T0=None, *, probability=0.999, rounds=10):
    """Find placements that disagree with the others, without being told how many there are.

    Parameters
    ----------
    obs : CameraObservations
    kind : {'planes', 'lines'}
        What is compared: point-plane distances or edge distances in the image.
    T0 : RigidTransform, optional
        Start value; a robust search over subsets of the placements (or many start rotations) when left out.
    probability : float
        A good placement is accepted with this probability, were the errors normal.
    rounds : int
        Rounds of estimating from the accepted placements and judging all again.

    Returns
    -------
    PlacementReport

    Raises
    ------
    ValueError
        For another `kind`.
    DegenerateGeometry
        When the observations do not determine the pose.

    Notes
    -----
    Residuals are compared with their own level, not with the stated noise: the median over the accepted placements of
    the mean square, divided by its expectation, sets the scale. A placement counts as many independent numbers as it
    has crossings, or two with planes (the distance and the slope of the scan: neighbouring points err together).
    """
    if kind not in ("planes", "lines"):
        raise ValueError(f"unknown kind {kind!r}: use 'planes' or 'lines'")
    T = (
        T0
        if T0 is not None
        else starting_transform(obs, kinds=("planes",) if kind == "planes" else ("planes", "lines"))
    )
    T = _solve(obs, kind, T, loss="cauchy")
    placements, mean, freedom = _placement_squares(obs, kind, T)
    keep = _accepted(mean, freedom, np.ones(len(mean), bool), probability)[0]
    for _ in range(rounds):
        T = _solve(obs.select(placements[keep]), kind, T)
        mean = _placement_squares(obs, kind, T)[1]
        found, limit = _accepted(mean, freedom, keep, probability)
        if np.array_equal(found, keep):
            break
        keep = found
    outlying, inliers = (tuple(int(x) for x in placements[flag]) for flag in (~keep, keep))
    return PlacementReport(placements, np.sqrt(mean), np.sqrt(limit), outlying, inliers, kind)


def _solve(obs, kind, T0, loss=None):
    if kind == "planes":
        return solve_zhang_pless(obs, T0, loss=loss, scale="auto", weighted=False).transform
    return solve_lines(obs, T0, loss=loss, scale="auto", weighted=False).transform


def _placement_squares(obs, kind, transform):
    """Mean square residual of each placement, and the independent numbers it stands for."""
    planes = kind == "planes"
    residuals = plane_residuals_m(obs, transform) if planes else edge_residuals_px(obs, transform)
    groups = obs.plane_placement if planes else obs.crossing_placement
    known = np.isfinite(residuals)
    placements, index = np.unique(groups[known], return_inverse=True)
    count = np.bincount(index)
    mean = np.bincount(index, residuals[known] ** 2) / count
    return placements, mean, np.full(len(mean), 2.0) if planes else count.astype(float)


def _accepted(mean, freedom, keep, probability):
    """Placements below the limit that the accepted ones set."""
    level = np.median((mean * freedom / chi2.median(freedom))[keep])
    limit = level * chi2.ppf(probability, freedom) / freedom
    return mean <= limit, limit
