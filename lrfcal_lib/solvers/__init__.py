"""Calibration methods of one camera: the same observations in, a `Solution` out.

A table of the methods and their choice; equations are in the modules of their residuals.
"""

from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from types import MappingProxyType

import numpy as np
from scipy import ndimage
from scipy.spatial.transform import RigidTransform
from scipy.special import chdtri

from lrfcal_lib.fit.residuals import (
    edge_residuals_px,
    line_block,
    plane_residuals_m,
    under_intrinsics,
)
from lrfcal_lib.fit.result import Solution
from lrfcal_lib.fit.robust import rms
from lrfcal_lib.model.geometry import DegenerateGeometry, apply_pose, pose_array
from lrfcal_lib.model.observations import CameraObservations
from lrfcal_lib.solvers import lines, plane_start, planes

# a good placement is accepted with this probability, were the errors normal
ACCEPTED = 0.999
# a plane's distance and the slope of the scan: neighbouring points err together
NUMBERS = 2
OUTLIER_ROUNDS = 11  # placements come and go no more after a few


@dataclass(frozen=True)
class Method:
    """A camera calibration method; to add one, put a row into `METHODS`.

    Attributes
    ----------
    uses : str
        What it needs of the observations: 'crossing', 'plane' or 'scene'.
    label : str
        For tables and figures.
    residual : callable
        ``residual(pose, obs) -> Block``: its residuals, two or more, at ``T_camera_source`` (...,
        3, 4).
    variant : str
        Of :func:`lrfcal_lib.calibrate.observe.observe`: 'half_step', 'last_beam' or 'one_scan'.
    estimate : callable
        What is done with the residual; least squares in the pose by default.
    options : dict
        Settings of its own, e.g. ``{"weighted": False}``: every residual counts the same.
    along : bool
        Without the edges found across the scan lines.
    """

    uses: str
    label: str
    residual: Callable
    variant: str = "half_step"
    estimate: Callable = lines.estimate_pose
    options: dict = field(default_factory=dict)
    along: bool = False


PLAIN = {"weighted": False}  # as published: every residual counts the same
METHODS = {
    "line_printed": Method(
        variant="one_scan",
        uses="crossing",
        label="lines as the paper prints them",
        residual=line_block,
        options=PLAIN,
    ),
    "line_last_beam": Method(
        variant="last_beam",
        uses="crossing",
        label="lines, last beam, all edges",
        residual=line_block,
        options=PLAIN,
        along=True,
    ),
    "line": Method(
        uses="crossing",
        label="lines, half step",
        residual=line_block,
    ),
    "zhang_pless_printed": Method(
        uses="plane",
        label="Zhang-Pless, unweighted",
        residual=planes.plane_block,
        estimate=planes.estimate_from_planes,
        options=PLAIN,
    ),
    "zhang_pless": Method(
        uses="plane",
        label="Zhang-Pless",
        residual=planes.plane_block,
        estimate=planes.estimate_from_planes,
    ),
    "zhang_pless_k": Method(
        uses="plane",
        label="Zhang-Pless with K",
        residual=planes.planes_and_pattern,
        estimate=planes.estimate_with_lens,
        options={"lens": 4},
    ),
    "zhang_pless_joint": Method(
        uses="plane",
        label="Zhang-Pless with K and lens",
        residual=planes.planes_and_pattern,
        estimate=planes.estimate_with_lens,
    ),
    "wasielewski_strauss": Method(
        uses="crossing",
        label="Wasielewski-Strauss, in space",
        residual=lines.distance_block,
        options=PLAIN,
    ),
    "bauermann": Method(
        uses="scene",
        label="after Bauermann, outline corners",
        residual=lines.point_block,
    ),
}
SHIPPED = MappingProxyType(dict(METHODS))  # without rows that others put there later
CANDIDATES = (
    "zhang_pless",
    "line",
)  # the better one is handed over where no joint estimate is


def starting_transform(obs: CameraObservations) -> RigidTransform:
    """Start values of ``T_camera_source`` from planes, or else from lines.

    Parameters
    ----------
    obs : CameraObservations

    Returns
    -------
    RigidTransform
        One, or a stack with the best one first.

    Raises
    ------
    DegenerateGeometry
        When no way determines the pose, with the reason of each.
    """
    reasons = []
    for way in (plane_start.start_from_planes, lines.start_from_lines):
        try:
            return way(obs)
        except DegenerateGeometry as error:
            reasons.append(f"{way.__name__.removeprefix('start_from_')}: {error}")
    raise DegenerateGeometry("no start value, give T0. " + " | ".join(reasons))


def row_of(method: str) -> Method:
    """The Method of a name as `METHODS` has it now; ValueError for a name that is not there."""
    if method not in METHODS:
        raise ValueError(f"unknown method {method!r}: use one of {', '.join(METHODS)}")
    return METHODS[method]


def solve_camera(
    observations: CameraObservations,
    method: str,
    T0: RigidTransform | None = None,
    *,
    search: bool = True,
    **options,
) -> Solution:
    """The pose of a camera by one of the methods.

    Parameters
    ----------
    observations : CameraObservations
        Of one session, or of many trials at once: arrays with a leading axis.
    method : str
        Of `METHODS`.
    T0 : RigidTransform, optional
        Start value of ``T_camera_source``, one or one a trial; found by :func:`starting_transform`
        when left out.
    search : bool
        A single T0 competes with the start value found: the better minimum is handed back. False:
        T0 is near it.
    **options
        ``robust`` (a loss of single crossings, points or whole placements, see
        :func:`lrfcal_lib.fit.least_squares.minimise`); ``weighted`` (False: every residual counts
        the same, True: by the propagated noise); ``max_iterations``.

    Returns
    -------
    Solution
        Its covariance knows the noise of single points; `covariance_placements` also covers what
        all of a placement have in common. Trials that are degenerate do not converge; nothing is
        raised for them.

    Raises
    ------
    DegenerateGeometry
        With fewer observations than the method needs, or when they leave a motion open.
    ValueError
        For an unknown method.
    """
    row = row_of(method)
    obs = observations.along() if row.along else observations
    obs.require(row.uses)
    options = {"method": method, "uses": row.uses} | row.options | options
    points = getattr(obs, f"{row.uses}_points")
    starts = [] if T0 is None else [pose_array(T0)]
    if T0 is None or (search and T0.single and points.ndim == 2):
        try:
            starts += [*pose_array(starting_transform(obs)).reshape(-1, 3, 4)]
        except DegenerateGeometry:
            if T0 is None:
                raise
    minima = []
    problems = []
    for pose in starts:
        trials = np.broadcast_shapes(points.shape[:-2], pose.shape[:-2])
        start = np.broadcast_to(pose, trials + (3, 4))
        try:
            minima.append(row.estimate(row.residual, obs, start, **options))
        except (DegenerateGeometry, np.linalg.LinAlgError) as error:
            problems.append(error)
    if not minima:
        raise problems[0]
    return minima[0] if len(minima) == 1 else best_minimum(obs, row, minima)


def left_out(
    obs: CameraObservations, judge: CameraObservations, method: str, full: Solution
) -> Iterator[tuple[CameraObservations, Solution]]:
    """Calibrations from all placements but one, and what that one shows.

    Parameters
    ----------
    obs, judge : CameraObservations
        Of the same placements: what `method` works on, and what it is judged on.
    method : str
        Of `METHODS`.
    full : Solution
        The calibration from all placements, the start of each solve.

    Yields
    ------
    CameraObservations, Solution
        Placements whose absence leaves the camera open are missing.
    """
    for placement in judge.all_placements:
        with suppress(DegenerateGeometry):
            rest = obs.select(np.setdiff1d(obs.all_placements, placement))
            yield (
                judge.select([placement]),
                solve_camera(rest, method, full.transform, search=False),
            )


def left_out_residuals(
    pairs: Iterable[tuple[CameraObservations, Solution]],
) -> tuple[np.ndarray, np.ndarray]:
    """Residuals of every placement under a calibration from all the others.

    Parameters
    ----------
    pairs : iterable of (CameraObservations, Solution)
        As of :func:`left_out`.

    Returns
    -------
    edges, planes : ndarray, shapes (n,), (m,)
        Of crossings, pixels, and of face points, metres.
    """
    edges = [np.zeros(0)]
    planes = [np.zeros(0)]
    for held, solution in pairs:
        seen = under_intrinsics(held, solution)
        edges.append(edge_residuals_px(seen, solution.transform))
        planes.append(plane_residuals_m(seen, solution.transform))
    return np.concatenate(edges), np.concatenate(planes)


def best_method(
    observations: dict[str, CameraObservations], solutions: dict[tuple[str, str], Solution]
) -> str | None:
    """Of `CANDIDATES` the method with the least product of its left-out edge and plane errors.

    A method that fits its own feature and fails on the other one (lines bent by a wide laser spot,
    say) loses.

    Parameters
    ----------
    observations : dict of str to CameraObservations
        By camera, with half-step crossings.
    solutions : dict of (str, str) to Solution
        By camera and method.

    Returns
    -------
    str or None
        None where none of them can be judged on placements left out.

    Notes
    -----
    A rule of thumb, made after the two sessions it was first used on had been seen. It picks one
    winner by a margin that may be within the noise (53.0 against 58.1 px mm on the LMS400
    recording).
    """
    errors = []
    for method in CANDIDATES:
        of_cameras = [[np.nan, np.nan]]  # of none
        for camera, obs in observations.items():
            if (camera, method) in solutions:
                pairs = left_out(obs, obs.along(), method, solutions[camera, method])
                of_cameras.append([*map(rms, left_out_residuals(pairs))])
        known = np.ma.masked_invalid(of_cameras)
        errors.append(known.mean(axis=0).filled(np.nan))
    table = np.array(errors)
    judging = ~np.isnan(table).all(axis=0)  # where no edge was seen, planes judge alone
    score = np.prod(table[:, judging], axis=1)
    if not judging.any() or np.isnan(score).all():
        return None
    return CANDIDATES[np.nanargmin(score)]


def best_minimum(obs, row, minima):
    """The best of several Solutions, with another one as `rival` that explains the data nearly as
    well.
    """
    squares = [_misses(obs, row, solution.transform) ** 2 for solution in minima]
    sizes = plane_start.sizes_of_minima(np.array(squares))
    poses = np.array([pose_array(solution.transform) for solution in minima])
    depths = apply_pose(poses, getattr(obs, f"{row.uses}_points"))[..., 2]
    before = np.mean(depths < 0, axis=1) <= 0.5  # most of the board is ahead of the camera
    best, *others = plane_start.far_apart(poses, np.lexsort([sizes, ~before]))
    nearly = (before == before[best]) & (sizes <= plane_start.NEARLY * sizes[best])
    for other in others:
        if nearly[other]:
            return replace(minima[best], rival=minima[other].transform)
    return minima[best]


def _misses(obs, row, transform):
    """Distances or pixels by which observations miss at a pose."""
    if row.uses != "plane":
        return row.residual(pose_array(transform), obs).residuals
    misses = plane_residuals_m(obs, transform)
    return misses[np.isfinite(misses)]


def find_outlying_placements(obs: CameraObservations) -> tuple[list[int], dict[int, float]]:
    """Find placements whose planes disagree with the others', without being told how many there
    are.

    Parameters
    ----------
    obs : CameraObservations

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
    Residuals are compared with their own level, not with the stated noise: the median over the
    accepted placements of the mean square, divided by its expectation, sets the scale.
    """
    plain = partial(solve_camera, method="zhang_pless", weighted=False)
    T = plain(obs, robust=True).transform
    placements = np.intersect1d(obs.placements, obs.plane_placement)
    accepted = np.ones(len(placements), bool)
    for number in range(OUTLIER_ROUNDS):
        squares = plane_residuals_m(obs, T) ** 2
        mean = ndimage.mean(squares, obs.plane_placement, placements)
        level = np.median(mean[accepted]) / chdtri(NUMBERS, 0.5)
        before = accepted
        accepted = mean <= level * chdtri(NUMBERS, 1 - ACCEPTED)
        if number > 0 and np.array_equal(before, accepted):
            break
        T = plain(obs.select(placements[accepted]), T0=T, search=False).transform
    rest = placements[~accepted].tolist()
    errors = np.sqrt(mean[~accepted]).tolist()
    return placements[accepted].tolist(), dict(zip(rest, errors, strict=True))
