"""Flat surfaces of a scanned cloud: planes that grow cell by cell as long as they stay flat."""

from contextlib import suppress
from dataclasses import replace

import numpy as np
from scipy.linalg import null_space
from scipy.ndimage import binary_erosion, label

from lrfcal_lib.calibrate.cloud import Cloud
from lrfcal_lib.calibrate.rig import CalibratedRig
from lrfcal_lib.fit.robust import TUKEY, robust_sigma
from lrfcal_lib.measure.features import FACING, Feature, fit_feature
from lrfcal_lib.model.geometry import (
    DegenerateGeometry,
    fit_plane,
    length_of,
)

SEED = 0.15  # metres about a point, where a plane begins
CELL = 0.1  # metres, side of the cells by which it grows
# metres by which a cell may be off, beside its noise: a picture stands 10 mm out
BENT = 0.003
LIMIT = 3.0  # standard deviations of the mean of a cell
FEWEST = 60  # points of a surface
IN_CELL = 3  # points that make a cell
ROUNDS = 8  # of growing and fitting again
# metres by which a surface without a middle may be off: its readings are mixed with what is beside
ALL_RIM = 0.006
SEEDS = 1500  # places at which a plane may begin


def planes_of(cloud: Cloud, rig: CalibratedRig) -> tuple[list[Feature], np.ndarray]:
    """The flat surfaces of a cloud.

    Parameters
    ----------
    cloud : Cloud
        Of one station, of n points.
    rig : CalibratedRig

    Returns
    -------
    planes : list of Feature
    of_point : ndarray of int, shape (n,)
        The number of the plane that a point lies on, -1 for none.
    """
    of_point = np.full(len(cloud.points), -1)
    planes: list[Feature] = []
    free = np.flatnonzero(np.isfinite(cloud.normals).all(axis=1))
    left = cloud.rows(free)
    for seed in range(0, len(of_point), max(1, len(of_point) // SEEDS)):
        if of_point[seed] >= 0:
            continue
        place = cloud.points[seed]
        rows = np.flatnonzero(left.normals @ cloud.normals[seed] > FACING)
        rows = rows[length_of(left.points[rows] - place) <= SEED]
        surface = free[_grown(left.points, left.normals, rows, place)]
        if len(surface) >= FEWEST:
            of_point[surface] = len(planes)
            inner = _inner(cloud.points, surface)
            plane = fit_feature(cloud, inner, rig)
            if len(inner) == len(surface):  # all rim: less certain
                rim = ALL_RIM**2 * np.outer(plane.axis, plane.axis)
                plane = replace(plane, noise=plane.noise + np.pad(rim, (0, 3)))
            planes.append(plane)
            free = free[of_point[free] < 0]
            left = cloud.rows(free)
    return planes, of_point


def _grown(points, normals, surface, seed):
    """Rows of the flat surface about a point (3,), grown from these rows."""
    with suppress(DegenerateGeometry):
        for _ in range(ROUNDS):
            if len(surface) < FEWEST / 2:
                break
            inner = points[_inner(points, surface)]
            normal, offset, _ = fit_plane(inner)
            sigma = robust_sigma(inner @ normal - offset)
            miss = points @ normal - offset
            near = np.flatnonzero(np.abs(miss) < TUKEY * sigma)
            near = near[np.abs(normals[near] @ normal) > FACING]
            with_seed = np.vstack([points[near], seed])
            before = len(surface)
            surface = near[_connected(with_seed, normal, miss[near], sigma)]
            if len(surface) == before:
                break
    return surface


def _connected(points, normal, miss, sigma):
    """Which points (n, 3) near a plane, without the last of them, are in the cells about the last
    that lie on the plane; `miss` is (n - 1,).
    """
    cell, shape = _cells(points, normal)
    size = np.prod(shape)
    count = np.maximum(np.bincount(cell[:-1], minlength=size), 1)
    mean = np.bincount(cell[:-1], miss, minlength=size) / count
    allowed = BENT + LIMIT * sigma / np.sqrt(count)
    flat = (count >= IN_CELL) & (np.abs(mean) < allowed)
    part = label(flat.reshape(shape))[0].ravel()[cell]
    return (part[:-1] == part[-1]) & (part[-1] > 0)


def _inner(points, surface):
    """Rows of a surface without the cells at its rim, where the spot meets what is beside it; all
    where little would be left.
    """
    part = points[surface]
    cell, shape = _cells(part, fit_plane(part)[0])
    full = np.bincount(cell, minlength=np.prod(shape)) >= IN_CELL
    inside = binary_erosion(full.reshape(shape), np.ones((3, 3)))
    inner = surface[inside.ravel()[cell]]
    return inner if len(inner) >= FEWEST else surface


def _cells(points, normal):
    """Numbers (n,) of the cells of points (n, 3) along a plane, and how many cells there are in
    both directions.
    """
    cell = np.rint(points @ null_space(normal[None]) / CELL).astype(int)
    cell -= cell.min(axis=0)
    shape = cell.max(axis=0) + 1
    return np.ravel_multi_index(cell.T, shape), shape
