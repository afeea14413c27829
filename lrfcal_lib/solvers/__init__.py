"""Calibration methods of one camera on one least-squares core: the same observations in, a `Solution` out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from scipy.stats import chi2

from lrfcal_lib.fit.residuals import edge_residuals_px, line_block, plane_residuals_m
from lrfcal_lib.model.geometry import DegenerateGeometry, pose_array
from lrfcal_lib.solvers import lines, planes


@dataclass(frozen=True)
class Method:
    """A camera calibration method; to add one, put a row into `METHODS`.

    Attributes
    ----------
    variant : str
        Of :func:`lrfcal_lib.calibrate.observe.observe`: 'half_step', 'last_beam' or 'one_scan'.
    uses : str
        What it needs of the observations: 'crossing', 'plane' or 'scene'.
    fewest : int
        Crossings, placements with planes, or scene points that it needs.
    label : str
        For tables and figures.
    residual : callable
        ``residual(pose, obs) -> Block``: its residuals, two or more, at ``T_camera_source`` (..., 3, 4).
    estimate : callable
        What is done with the residual; least squares in the pose by default.
    options : dict
        Settings of its own, e.g. ``{"weighted": False}``: every residual counts the same.
    along : bool
        Without the edges found across the scan lines.
    """

    variant: str
    uses: str
    fewest: int
    label: str
    residual: Callable
    estimate: Callable = lines.estimate_pose
    options: dict = field(default_factory=dict)
    along: bool = False


PLAIN = {"weighted": False}  # as published: every residual counts the same
METHODS = {
    "line_printed": Method("one_scan", "crossing", 6, "lines as the paper prints them", line_block, options=PLAIN),
    "line_last_beam": Method(
        "last_beam", "crossing", 6, "lines, last beam, all edges", line_block, options=PLAIN, along=True
    ),
    "line": Method("half_step", "crossing", 6, "lines, half step", line_block),
    "line_ml": Method("half_step", "crossing", 7, "lines, likelihood", lines.interval_block, lines.estimate_likely),
    "zhang_pless_printed": Method(
        "half_step", "plane", 3, "Zhang-Pless, unweighted", planes.plane_block, planes.estimate_from_planes, PLAIN
    ),
    "zhang_pless": Method("half_step", "plane", 3, "Zhang-Pless", planes.plane_block, planes.estimate_from_planes),
    "zhang_pless_k": Method(
        "half_step", "plane", 3, "Zhang-Pless with K", planes.planes_and_pattern, planes.estimate_with_lens, {"lens": 4}
    ),
    "zhang_pless_joint": Method(
        "half_step", "plane", 3, "Zhang-Pless with K and lens", planes.planes_and_pattern, planes.estimate_with_lens
    ),
    "wasielewski_strauss": Method(
        "half_step", "crossing", 6, "Wasielewski-Strauss, in space", lines.distance_block, options=PLAIN
    ),
    "bauermann": Method("half_step", "scene", 3, "after Bauermann, outline corners", lines.point_block),
}
STARTS = {
    "crossing": (planes.start_from_planes, lines.start_from_lines, lines.start_from_scene),
    "plane": (planes.start_from_planes,),
    "scene": (lines.start_from_scene, planes.start_from_planes, lines.start_from_lines),
}


def starting_transform(obs, uses="crossing"):
    """A start value of ``T_camera_source`` from whatever the observations hold, in the order that suits a method.

    Raises DegenerateGeometry when no way determines the pose, with the reason of each.
    """
    reasons = []
    for way in STARTS[uses]:
        try:
            return way(obs)
        except DegenerateGeometry as error:
            reasons.append(f"{way.__name__.removeprefix('start_from_')}: {error}")
    raise DegenerateGeometry("no start value, give T0. " + " | ".join(reasons))


def solve_camera(observations, method="line", T0=None, *, required=True, **options):
    """The pose of a camera by one of the methods.

    Parameters
    ----------
    observations : CameraObservations
        Of one session, or of many trials at once: arrays with a leading axis.
    method : str
        Of `METHODS`.
    T0 : RigidTransform, optional
        Start value of ``T_camera_source``, one or one a trial; found by :func:`starting_transform` when left out.
    required : bool
        False: report unobservable motions instead of raising.
    **options
        ``loss`` (None, 'huber' or 'cauchy') of single crossings, points or whole placements, with its ``scale``
        (standard deviations, or 'auto'); ``weighted`` (False: every residual counts the same, True: by the propagated
        noise); ``max_iterations``.

    Returns
    -------
    Solution
        Its covariance knows the noise of single points; `covariance_placements` also covers what all of a placement
        have in common. Trials that are degenerate do not converge; nothing is raised for them.

    Raises
    ------
    DegenerateGeometry
        With fewer observations than the method needs, or when they leave a motion open.
    ValueError
        For an unknown method.
    """
    if method not in METHODS:
        raise ValueError(f"unknown method {method!r}: use one of {', '.join(METHODS)}")
    row = METHODS[method]
    obs = observations.along() if row.along else observations
    anyway = row.uses == "plane" and not required
    obs.require(row.uses, 1 if anyway else row.fewest)
    if T0 is None:
        T0 = planes.start_from_planes(obs, required=False) if anyway else starting_transform(obs, row.uses)
    pose = pose_array(T0)
    trials = np.broadcast_shapes(getattr(obs, f"{row.uses}_points").shape[:-2], pose.shape[:-2])
    options = {"method": method, "uses": row.uses, "required": required} | row.options | options
    return row.estimate(row.residual, obs, np.broadcast_to(pose, trials + (3, 4)), **options)


@dataclass(frozen=True)
class PlacementReport:
    """How well each placement agrees with a robust estimate.

    `rms` (p,) are metres from the plane or pixels from the lines, `limit` (p,) what is still accepted; `outlying` and
    `inliers` are the placements above and below it.
    """

    placements: np.ndarray
    rms: np.ndarray
    limit: np.ndarray
    outlying: tuple[int, ...]
    inliers: tuple[int, ...]


ACCEPTED = 0.999  # a good placement is accepted with this probability, were the errors normal
KINDS = {
    "planes": ("zhang_pless", plane_residuals_m, "plane_placement"),
    "lines": ("line", edge_residuals_px, "crossing_placement"),
}


def find_outlying_placements(obs, kind="planes"):
    """Find placements that disagree with the others, without being told how many there are.

    Parameters
    ----------
    obs : CameraObservations
    kind : {'planes', 'lines'}
        What is compared: point-plane distances or edge distances in the image.

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
    if kind not in KINDS:
        raise ValueError(f"unknown kind {kind!r}: use 'planes' or 'lines'")
    method, residuals_of, groups = KINDS[kind]
    keep, some, options = None, obs, {"scale": "auto", "weighted": False}
    T = solve_camera(obs, method, loss="cauchy", **options).transform
    for _ in range(11):
        residuals = residuals_of(obs, T)
        known = np.isfinite(residuals)
        placements, index = np.unique(getattr(obs, groups)[known], return_inverse=True)
        count = np.bincount(index)
        mean = np.bincount(index, residuals[known] ** 2) / count
        freedom = np.full(len(mean), 2.0) if kind == "planes" else count.astype(float)
        judges = np.ones(len(mean), bool) if keep is None else keep
        level = np.median((mean * freedom / chi2.median(freedom))[judges])
        limit = level * chi2.ppf(ACCEPTED, freedom) / freedom
        before, keep = keep, mean <= limit
        if np.array_equal(before, keep):
            break
        some = obs.select(placements[keep])
        T = solve_camera(some, method, T, **options).transform
    outlying, inliers = (tuple(int(x) for x in placements[flag]) for flag in (~keep, keep))
    return PlacementReport(placements, np.sqrt(mean), np.sqrt(limit), outlying, inliers)
