"""Calibration methods of one camera on one least-squares core: the same observations in, a `Solution` out."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.special import chdtri

from lrfcal_lib.fit.residuals import line_block, plane_residuals_m
from lrfcal_lib.model.geometry import DegenerateGeometry, pose_array, transform_difference
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
    "scene": (planes.start_from_planes, lines.start_from_scene, lines.start_from_lines),
}


def starting_transform(obs, uses="crossing"):
    """Start values of ``T_camera_source`` (one, or a stack with the best one first) from what the observations hold.

    Raises DegenerateGeometry when no way determines the pose, with the reason of each.
    """
    reasons = []
    for way in STARTS[uses]:
        try:
            return way(obs)
        except DegenerateGeometry as error:
            reasons.append(f"{way.__name__.removeprefix('start_from_')}: {error}")
    raise DegenerateGeometry("no start value, give T0. " + " | ".join(reasons))


def solve_camera(observations, method="line", T0=None, *, search=True, **options):
    """The pose of a camera by one of the methods.

    Parameters
    ----------
    observations : CameraObservations
        Of one session, or of many trials at once: arrays with a leading axis.
    method : str
        Of `METHODS`.
    T0 : RigidTransform, optional
        Start value of ``T_camera_source``, one or one a trial; found by :func:`starting_transform` when left out.
    search : bool
        A single T0 competes with the start value found: the better minimum is handed back. False: T0 is near it.
    **options
        ``loss`` (None or 'cauchy') of single crossings, points or whole placements, with its ``scale``
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
    obs.require(row.uses, row.fewest)
    options, found, problem = {"method": method, "uses": row.uses} | row.options | options, [], None
    starts = [] if T0 is None else [pose_array(T0)]
    if T0 is None or (search and T0.single and getattr(obs, f"{row.uses}_points").ndim == 2):
        try:
            starts += [*pose_array(starting_transform(obs, row.uses)).reshape(-1, 3, 4)]
        except DegenerateGeometry:
            if T0 is None:
                raise
    for pose in starts:
        trials = np.broadcast_shapes(getattr(obs, f"{row.uses}_points").shape[:-2], pose.shape[:-2])
        try:
            found.append(row.estimate(row.residual, obs, np.broadcast_to(pose, trials + (3, 4)), **options))
        except (DegenerateGeometry, np.linalg.LinAlgError) as error:
            problem = problem or error
    if not found:
        raise problem
    return found[0] if len(found) == 1 else best_minimum(obs, row.uses, found)


def best_minimum(obs, uses, found):
    """The best of some Solutions, with another one as `rival` that explains the data nearly as well."""
    misses = [misses_of(obs, uses, solution.transform) for solution in found]
    before = np.array([lies_before(obs, uses, solution.transform) for solution in found])
    sizes = planes.sizes_of_minima(np.square(misses))
    order = np.lexsort([sizes, ~before])
    best = found[order[0]]
    nearly = (before == before[order[0]]) & (sizes <= planes.NEARLY * sizes[order[0]])
    alike = [found[i].transform for i in order if nearly[i]]
    far = (T for T in alike if transform_difference(T, best.transform)[0] > planes.SAME_TURN)
    return replace(best, rival=next(far, None))


def misses_of(obs, uses, transform):
    """Distances or pixels by which observations miss at a pose."""
    block = {"crossing": line_block, "scene": lines.point_block}.get(uses)
    misses = plane_residuals_m(obs, transform) if block is None else block(pose_array(transform), obs).residuals
    return misses[np.isfinite(misses)]


def lies_before(obs, uses, transform):
    """Whether a pose puts (most of) the board before the camera."""
    depth = transform.apply(getattr(obs, f"{uses}_points"))[:, 2]
    return bool(np.mean(depth < 0) <= 0.5)


ACCEPTED = 0.999  # a good placement is accepted with this probability, were the errors normal
NUMBERS = 2  # a plane's distance and the slope of the scan: neighbouring points err together


def find_outlying_placements(obs):
    """Find placements whose planes disagree with the others', without being told how many there are.

    Returns
    -------
    inliers : list of int
        Numbers of the placements that agree.
    outlying : dict of int to float
        Root mean square distances of the others' points from their planes, metres.

    Raises
    ------
    DegenerateGeometry
        When the observations do not determine the pose.

    Notes
    -----
    Residuals are compared with their own level, not with the stated noise: the median over the accepted placements of
    the mean square, divided by its expectation, sets the scale.
    """
    keep, some, options = None, obs, {"scale": "auto", "weighted": False}
    T = solve_camera(obs, "zhang_pless", loss="cauchy", **options).transform
    for _ in range(11):
        residuals = plane_residuals_m(obs, T)
        known = np.isfinite(residuals)
        placements, index, count = np.unique(obs.plane_placement[known], return_inverse=True, return_counts=True)
        mean = np.bincount(index, residuals[known] ** 2) / count
        level = np.median(mean if keep is None else mean[keep]) / chdtri(NUMBERS, 0.5)
        before, keep = keep, mean <= level * chdtri(NUMBERS, 1 - ACCEPTED)
        if np.array_equal(before, keep):
            break
        some = obs.select(placements[keep])
        T = solve_camera(some, "zhang_pless", T, search=False, **options).transform
    return placements[keep].tolist(), dict(zip(placements[~keep].tolist(), np.sqrt(mean[~keep]).tolist(), strict=True))
